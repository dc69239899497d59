"""YOLOv5s: CSP backbone, SPPF, PANet, three scales (the v6 layout, width 0.50, depth 0.33).

Published size at 80 classes: 7,235,389 parameters, 7,225,885 with batch norms folded into the
convolutions; 7,022,326 and 7,012,822 at one class.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

STRIDES = (8, 16, 32)
# (width, height) in px of the network's input, three a scale: the published ones (COCO at 640 px).
ANCHORS = (
    ((10, 13), (16, 30), (33, 23)),
    ((30, 61), (62, 45), (59, 119)),
    ((116, 90), (156, 198), (373, 326)),
)
SAME_BOX_IOU = 0.8  # boxes of one object that overlap more are averaged


class ConvBlock(nn.Module):
    """Convolution, batch norm, SiLU."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, padding: int | None = None
    ) -> None:
        super().__init__()
        padding = kernel // 2 if padding is None else padding
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03)

    def forward(self, x: Tensor) -> Tensor:
        return functional.silu(self.bn(self.conv(x)))

    def fuse(self) -> None:
        """Folds the batch norm into the convolution (inference only)."""
        if isinstance(self.bn, nn.BatchNorm2d):
            self.conv = fuse_conv_bn_eval(self.conv, self.bn)
            self.bn = nn.Identity()


class Bottleneck(nn.Module):
    """1x1 and 3x3 convolution, with the input added where `shortcut`."""

    def __init__(self, channels: int, shortcut: bool) -> None:
        super().__init__()
        self.reduce = ConvBlock(channels, channels, 1)
        self.expand = ConvBlock(channels, channels, 3)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        y = self.expand(self.reduce(x))
        return x + y if self.shortcut else y


class C3(nn.Module):
    """Cross-stage partial block: half of the channels pass by the bottlenecks."""

    def __init__(self, inputs: int, outputs: int, count: int, shortcut: bool = True) -> None:
        super().__init__()
        half = outputs // 2
        self.through = ConvBlock(inputs, half, 1)
        self.bypass = ConvBlock(inputs, half, 1)
        self.bottlenecks = nn.Sequential(*(Bottleneck(half, shortcut) for _ in range(count)))
        self.join = ConvBlock(2 * half, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.join(torch.cat((self.bottlenecks(self.through(x)), self.bypass(x)), 1))


class SPPF(nn.Module):
    """Spatial pyramid pooling, fast: three 5x5 max poolings in a row see 5, 9 and 13 cells."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.reduce = ConvBlock(inputs, inputs // 2, 1)
        self.join = ConvBlock(inputs * 2, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        maps = [self.reduce(x)]
        for _ in range(3):
            maps.append(functional.max_pool2d(maps[-1], 5, stride=1, padding=2))
        return self.join(torch.cat(maps, 1))


class YOLOv5s(nn.Module):
    """Object detector over `classes` classes."""

    def __init__(self, classes: int = 1) -> None:
        super().__init__()
        self.classes = classes
        self.register_buffer("anchors", torch.tensor(ANCHORS, dtype=torch.float32))
        self.stage2 = nn.Sequential(  # stride 4
            ConvBlock(3, 32, 6, 2, padding=2), ConvBlock(32, 64, 3, 2), C3(64, 64, 1)
        )
        self.stage3 = nn.Sequential(ConvBlock(64, 128, 3, 2), C3(128, 128, 2))  # stride 8
        self.stage4 = nn.Sequential(ConvBlock(128, 256, 3, 2), C3(256, 256, 3))  # stride 16
        self.stage5 = nn.Sequential(  # stride 32
            ConvBlock(256, 512, 3, 2), C3(512, 512, 1), SPPF(512, 512)
        )
        # PANet: top down, then bottom up.
        self.lateral5 = ConvBlock(512, 256, 1)
        self.down4 = C3(512, 256, 1, shortcut=False)
        self.lateral4 = ConvBlock(256, 128, 1)
        self.down3 = C3(256, 128, 1, shortcut=False)
        self.reduce3 = ConvBlock(128, 128, 3, 2)
        self.up4 = C3(256, 256, 1, shortcut=False)
        self.reduce4 = ConvBlock(256, 256, 3, 2)
        self.up5 = C3(512, 512, 1, shortcut=False)
        outputs = 3 * (5 + classes)
        self.heads = nn.ModuleList(nn.Conv2d(c, outputs, 1) for c in (128, 256, 512))
        self._initialise_biases()

    def _initialise_biases(self) -> None:
        # Prior of focal loss (section 3.3 there): 8 objects in a 640 px image, 0.6 a class.
        for head, stride in zip(self.heads, STRIDES, strict=True):
            bias = head.bias.detach().view(3, -1)
            bias[:, 4] += math.log(8 / (640 / stride) ** 2)
            bias[:, 5:] += math.log(0.6 / (self.classes - 0.99999))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Logits of each scale from (B, 3, H, W) in [0, 1], H and W multiples of 32.

        Three (B, H/s, W/s, 3, 5 + classes) float32 tensors for s = 8, 16, 32; the last dimension
        is x, y, w, h, objectness, classes. decode() makes boxes of them.
        """
        x3 = self.stage3(self.stage2(x))
        x4 = self.stage4(x3)
        top5 = self.lateral5(self.stage5(x4))
        top4 = self.lateral4(self.down4(torch.cat((_twice(top5), x4), 1)))
        p3 = self.down3(torch.cat((_twice(top4), x3), 1))
        p4 = self.up4(torch.cat((self.reduce3(p3), top4), 1))
        p5 = self.up5(torch.cat((self.reduce4(p4), top5), 1))
        maps = []
        for head, features in zip(self.heads, (p3, p4, p5), strict=True):
            logits = head(features).permute(0, 2, 3, 1)
            maps.append(logits.unflatten(-1, (3, 5 + self.classes)).float())
        return maps

    def fused(self) -> YOLOv5s:
        """A copy for inference with batch norms folded into the convolutions."""
        model = copy.deepcopy(self).eval()
        for module in model.modules():
            if isinstance(module, ConvBlock):
                module.fuse()
        return model


def decode_boxes(logits: Tensor, cell: Tensor, anchor: Tensor, stride: float) -> Tensor:
    """(..., 4) centre x, y and width, height in input px from the logits of cells (column, row).

    The centre may lie up to half a cell outside its cell, a side may be up to 4 anchors long.
    """
    t = logits[..., :4].sigmoid()
    center = (2 * t[..., :2] - 0.5 + cell) * stride
    return torch.cat((center, (2 * t[..., 2:4]) ** 2 * anchor), -1)


def decode(maps: list[Tensor], anchors: Tensor, least: float = 0.0) -> list[tuple[Tensor, Tensor]]:
    """Of each image the boxes (N, 4) as x1, y1, x2, y2 in input px and their scores (N, classes).

    A score is objectness x class probability; only boxes of an objectness above `least` are made.
    maps: from YOLOv5s.forward; anchors: (3, 3, 2) px.
    """
    images = []
    for image in range(len(maps[0])):
        boxes, scores = [], []
        for logits, anchor, stride in zip(maps, anchors, STRIDES, strict=True):
            present = logits[image, ..., 4].sigmoid() > least
            row, column, shape = present.nonzero(as_tuple=True)
            chosen = logits[image, row, column, shape]
            cell = torch.stack((column, row), -1).to(logits)
            xywh = decode_boxes(chosen, cell, anchor.to(logits)[shape], stride)
            half = xywh[:, 2:] / 2
            boxes.append(torch.cat((xywh[:, :2] - half, xywh[:, :2] + half), -1))
            probability = chosen[:, 4:].sigmoid()
            scores.append(probability[:, :1] * probability[:, 1:])
        images.append((torch.cat(boxes), torch.cat(scores)))
    return images


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of corner boxes (N, 4) and (M, 4) -> (N, M)."""
    width, height = (
        torch.minimum(a[:, None, axis + 2], b[None, :, axis + 2])
        - torch.maximum(a[:, None, axis], b[None, :, axis])
        for axis in (0, 1)
    )
    common = width.clamp(min=0) * height.clamp(min=0)
    area_a = (a[:, 2:] - a[:, :2]).prod(-1)
    area_b = (b[:, 2:] - b[:, :2]).prod(-1)
    return common / (area_a[:, None] + area_b[None] - common).clamp(min=1e-9)


def non_maximum_suppression(
    boxes: Tensor, scores: Tensor, score_threshold: float, iou_threshold: float, max_objects: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Soft-NMS (Bodla et al. 2017, linear) on one image's boxes (N, 4) and scores (N, classes).

    Returns boxes (K, 4), scores (K,) and classes (K,), K <= max_objects, by descending score. The
    best box stands; the score of another of its class that overlaps it by more than iou_threshold
    is multiplied by 1 - IoU, since crossing parts overlap as much as two answers for one part do.
    Those beyond SAME_BOX_IOU are the same part, and its box is their mean weighted by their scores:
    the errors of neighbouring cells and anchors are partly independent.
    """
    score, label = scores.max(-1)
    chosen = torch.nonzero(score > score_threshold).squeeze(1)
    chosen = chosen[score[chosen].argsort(descending=True, stable=True)][:1000]
    boxes, score, label = boxes[chosen], score[chosen], label[chosen]
    overlap = box_iou(boxes, boxes) * (label[:, None] == label[None])
    same = overlap > SAME_BOX_IOU
    kept: list[int] = []
    standing: list[float] = []
    left = score.clone()
    while len(kept) < min(max_objects, len(boxes)):
        best = int(left.argmax())
        if left[best] <= score_threshold:
            break
        kept.append(best)
        standing.append(float(left[best]))
        left = torch.where(overlap[best] > iou_threshold, left * (1 - overlap[best]), left)
        left[same[best]] = 0.0
        left[best] = 0.0
    weight = same[kept] * score
    mean = weight @ boxes / weight.sum(1, keepdim=True)
    return mean, score.new_tensor(standing), label[kept]


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
