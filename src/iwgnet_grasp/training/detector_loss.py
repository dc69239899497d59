"""YOLOv5's loss: CIoU of boxes, binary cross entropy of objectness and classes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from iwgnet_grasp.networks.yolov5s import STRIDES, decode_boxes


@dataclass(frozen=True)
class LossWeights:
    box: float = 0.05
    objectness: float = 1.0
    classes: float = 0.5
    anchor_ratio: float = 4.0  # a box matches an anchor when no side differs by more
    balance: tuple[float, float, float] = (4.0, 1.0, 0.4)  # objectness at strides 8, 16, 32


@dataclass(frozen=True)
class Assignment:
    """The K cells of one scale that answer for boxes; a box has up to 3 anchors x 3 cells."""

    image: Tensor  # (K,) index in the batch
    anchor: Tensor  # (K,)
    row: Tensor  # (K,)
    column: Tensor  # (K,)
    box: Tensor  # (K, 4) centre x, y, width, height in px
    label: Tensor  # (K,)


def assign(
    targets: Tensor, anchors: Tensor, stride: int, shape: tuple[int, int], ratio: float
) -> Assignment:
    """Cross-grid assignment: the centre's cell and the two cells it lies nearest to.

    targets: (M, 6) image, class, centre x, y, width, height in px; anchors: (3, 2) px of this
    scale; shape: (rows, columns) of its grid. An anchor takes a box when neither width nor height
    differs by more than `ratio`, either way. Where several boxes want the same anchor of a cell,
    the one of the most similar size gets it: crossing parts often share their centre, and a cell
    that learned both would answer with the mean of the two.
    """
    size = targets[:, None, 4:6] / anchors[None]
    misfit = torch.maximum(size, 1 / size).amax(-1)  # (M, 3)
    target, anchor = (misfit < ratio).nonzero(as_tuple=True)
    boxes = targets[target]
    cell = boxes[:, 2:4] / stride  # in cells
    limit = torch.tensor([shape[1], shape[0]], device=cell.device)
    part = cell % 1.0
    steps = [torch.zeros_like(cell)]
    near = [torch.ones(len(cell), dtype=torch.bool, device=cell.device)]
    for axis in (0, 1):
        low = (part[:, axis] < 0.5) & (cell[:, axis] > 1.0)
        high = (part[:, axis] >= 0.5) & (cell[:, axis] < limit[axis] - 1)
        for mask, step in ((low, -1.0), (high, 1.0)):
            move = torch.zeros_like(cell)
            move[:, axis] = step
            steps.append(move)
            near.append(mask)
    where = torch.stack(near)  # (5, K)
    index = (cell.floor()[None] + torch.stack(steps))[where].long()
    order = where.nonzero()[:, 1]
    column = index[:, 0].clamp(0, shape[1] - 1)
    row = index[:, 1].clamp(0, shape[0] - 1)
    place = ((targets[target[order], 0].long() * 3 + anchor[order]) * shape[0] + row) * shape[1]
    place = place + column
    # By place, then by misfit: the first of a place is the one that fits best.
    ranking = misfit[target, anchor][order].argsort(stable=True)
    ranking = ranking[place[ranking].argsort(stable=True)]
    first = torch.ones(len(ranking), dtype=torch.bool, device=place.device)
    first[1:] = place[ranking][1:] != place[ranking][:-1]
    best = ranking[first]
    order = order[best]
    chosen = boxes[order]
    return Assignment(
        image=chosen[:, 0].long(),
        anchor=anchor[order],
        row=row[best],
        column=column[best],
        box=chosen[:, 2:6],
        label=chosen[:, 1].long(),
    )


def complete_iou(a: Tensor, b: Tensor) -> Tensor:
    """CIoU (Zheng et al. 2020) of boxes (K, 4) given as centre x, y, width, height -> (K,)."""
    a_low, a_high = a[:, :2] - a[:, 2:] / 2, a[:, :2] + a[:, 2:] / 2
    b_low, b_high = b[:, :2] - b[:, 2:] / 2, b[:, :2] + b[:, 2:] / 2
    common = (torch.minimum(a_high, b_high) - torch.maximum(a_low, b_low)).clamp(min=0).prod(-1)
    union = a[:, 2:].prod(-1) + b[:, 2:].prod(-1) - common + 1e-7
    iou = common / union
    hull = torch.maximum(a_high, b_high) - torch.minimum(a_low, b_low)
    distance = (a[:, :2] - b[:, :2]).square().sum(-1) / (hull.square().sum(-1) + 1e-7)
    shape = torch.atan(a[:, 2] / (a[:, 3] + 1e-7)) - torch.atan(b[:, 2] / (b[:, 3] + 1e-7))
    aspect = 4 / math.pi**2 * shape.square()
    with torch.no_grad():
        weight = aspect / (1 - iou + aspect + 1e-7)
    return iou - distance - weight * aspect


def detection_loss(
    maps: list[Tensor], targets: Tensor, anchors: Tensor, weights: LossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a batch and its terms (box, objectness, classes), each already weighted.

    maps: logits from YOLOv5s.forward; targets: (M, 6) from data.detection.collate, px of the same
    input; anchors: (3, 3, 2) px. Objectness learns the box's CIoU, as published.
    """
    zero = maps[0].new_zeros(())
    box, objectness, classes = zero, zero, zero
    for scale, logits in enumerate(maps):
        shape = (logits.shape[1], logits.shape[2])
        present = torch.zeros_like(logits[..., 4])
        match = assign(targets, anchors[scale], STRIDES[scale], shape, weights.anchor_ratio)
        if len(match.image):
            predicted = logits[match.image, match.row, match.column, match.anchor]
            cell = torch.stack([match.column, match.row], -1).to(logits)
            boxes = decode_boxes(predicted, cell, anchors[scale][match.anchor], STRIDES[scale])
            overlap = complete_iou(boxes, match.box)
            box = box + (1 - overlap).mean()
            present[match.image, match.row, match.column, match.anchor] = (
                overlap.detach().clamp(0).to(present.dtype)
            )
            count = logits.shape[-1] - 5
            if count > 1:
                wanted = functional.one_hot(match.label, count).to(logits)
                classes = classes + functional.binary_cross_entropy_with_logits(
                    predicted[:, 5:], wanted
                )
        objectness = objectness + weights.balance[
            scale
        ] * functional.binary_cross_entropy_with_logits(logits[..., 4], present)
    terms = {
        "box": weights.box * box,
        "objectness": weights.objectness * objectness,
        "classes": weights.classes * classes,
    }
    return sum(terms.values(), zero), {name: value.detach() for name, value in terms.items()}
