"""YOLOv5s: its published size, its geometry, its loss against hand-computed values."""

import math

import pytest
import torch
from torch import nn

from iwgnet_grasp.networks.yolov5s import (
    ANCHORS,
    STRIDES,
    YOLOv5s,
    box_iou,
    decode,
    decode_boxes,
    non_maximum_suppression,
)
from iwgnet_grasp.training.detector_loss import (
    LossWeights,
    assign,
    complete_iou,
    detection_loss,
)


@pytest.fixture(scope="module")
def model() -> YOLOv5s:
    torch.manual_seed(0)
    return YOLOv5s(1).eval()


def parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize(
    ("classes", "published", "published_fused"),
    [(80, 7_235_389, 7_225_885), (1, 7_022_326, 7_012_822)],
)
def test_has_the_published_number_of_parameters(classes, published, published_fused):
    model = YOLOv5s(classes)
    assert parameters(model) == published
    assert parameters(model.fused()) == published_fused


def test_three_scales_with_three_anchors_a_cell(model):
    with torch.no_grad():
        maps = model(torch.rand(2, 3, 96, 160))
    assert [tuple(m.shape) for m in maps] == [(2, 96 // s, 160 // s, 3, 6) for s in STRIDES]


def test_folding_the_batch_norms_does_not_change_the_output(model):
    torch.manual_seed(1)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    image = torch.rand(1, 3, 64, 96)
    with torch.no_grad():
        for ours, fused in zip(model(image), model.fused()(image), strict=True):
            torch.testing.assert_close(fused, ours, rtol=1e-3, atol=1e-4)


def test_zero_logits_decode_to_the_anchor_in_the_middle_of_the_cell():
    cell, anchor = torch.tensor([3.0, 5.0]), torch.tensor([30.0, 61.0])
    box = decode_boxes(torch.zeros(4), cell, anchor, 16)
    assert box.tolist() == [3.5 * 16, 5.5 * 16, 30.0, 61.0]


def test_decoded_box_may_leave_its_cell_by_half_and_grow_to_four_anchors():
    anchor = torch.tensor([10.0, 10.0])
    far = decode_boxes(torch.full((4,), 20.0), torch.zeros(2), anchor, 8)
    near = decode_boxes(torch.full((4,), -20.0), torch.zeros(2), anchor, 8)
    assert far.tolist() == pytest.approx([1.5 * 8, 1.5 * 8, 40.0, 40.0], abs=1e-3)
    assert near.tolist() == pytest.approx([-0.5 * 8, -0.5 * 8, 0.0, 0.0], abs=1e-3)


def test_decode_lists_every_anchor_of_every_scale():
    maps = [torch.zeros(1, 64 // s, 96 // s, 3, 7) for s in STRIDES]
    ((boxes, scores),) = decode(maps, torch.tensor(ANCHORS, dtype=torch.float32))
    count = 3 * sum((64 // s) * (96 // s) for s in STRIDES)
    assert boxes.shape == (count, 4)
    assert scores.shape == (count, 2)
    assert torch.all(scores == 0.25)  # sigmoid(0) x sigmoid(0)
    # Row-major: the second cell of the first row lies one stride to the right.
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    assert middle[3].tolist() == [12.0, 4.0]


def test_decode_leaves_out_cells_without_objects():
    maps = [torch.full((2, 64 // s, 96 // s, 3, 6), -9.0) for s in STRIDES]
    maps[1][1, 2, 4, 0, :] = 0.0
    anchors = torch.tensor(ANCHORS, dtype=torch.float32)
    empty, one = decode(maps, anchors, 0.3)
    assert empty[0].shape == (0, 4) and empty[1].shape == (0, 1)
    width, height = ANCHORS[1][0]
    x, y = 4.5 * 16, 2.5 * 16
    expected = [x - width / 2, y - height / 2, x + width / 2, y + height / 2]
    assert one[0].tolist() == [expected] and one[1].tolist() == [[0.25]]


def test_iou_of_known_boxes():
    a = torch.tensor([[0.0, 0.0, 10.0, 10.0]])
    b = torch.tensor([[5.0, 0.0, 15.0, 10.0], [20.0, 20.0, 30.0, 30.0], [0.0, 0.0, 10.0, 10.0]])
    assert box_iou(a, b)[0].tolist() == pytest.approx([1 / 3, 0.0, 1.0])


def test_complete_iou_of_known_boxes():
    box = torch.tensor([[5.0, 5.0, 10.0, 10.0]])
    moved = torch.tensor([[10.0, 5.0, 10.0, 10.0]])
    assert complete_iou(box, box).item() == pytest.approx(1.0, abs=1e-5)
    # IoU 1/3; centres 5 px apart in a hull of 15 x 10 px; same aspect.
    assert complete_iou(box, moved).item() == pytest.approx(1 / 3 - 25 / 325, abs=1e-5)
    # Same centre and IoU 1/2, aspects 1 and 1/2: v = 4/pi^2 (atan 1 - atan 1/2)^2.
    slim = torch.tensor([[5.0, 5.0, 5.0, 10.0]])
    v = 4 / math.pi**2 * (math.atan(1.0) - math.atan(0.5)) ** 2
    assert complete_iou(box, slim).item() == pytest.approx(0.5 - v * v / (0.5 + v), abs=1e-5)


def test_suppression_keeps_the_best_of_overlapping_boxes_of_a_class():
    boxes = torch.tensor(
        [[0.0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10], [40, 40, 50, 50], [90, 90, 99, 99]]
    )
    scores = torch.tensor([[0.8, 0.0], [0.9, 0.0], [0.0, 0.7], [0.6, 0.0], [0.1, 0.0]])
    kept, score, label = non_maximum_suppression(boxes, scores, 0.25, 0.5, 10)
    assert score.tolist() == pytest.approx([0.9, 0.7, 0.6])
    assert label.tolist() == [0, 1, 0]
    # IoU 9/11 with the first box: one object, whose box is their mean weighted by 0.9 and 0.8.
    assert kept[0].tolist() == pytest.approx([0.9 / 1.7, 0, 10 + 0.9 / 1.7, 10])
    assert len(non_maximum_suppression(boxes, scores, 0.25, 0.5, 2)[0]) == 2


def test_a_box_that_crosses_a_better_one_loses_score_by_their_overlap():
    boxes = torch.tensor([[0.0, 0, 10, 10], [2, 0, 12, 10], [5, 0, 15, 10]])  # IoU 2/3 and 1/3
    scores = torch.tensor([[0.9], [0.8], [0.7]])
    kept, score, _ = non_maximum_suppression(boxes, scores, 0.2, 0.5, 10)
    # Of the last two, too, IoU is 7/13 > 0.5.
    assert score.tolist() == pytest.approx([0.9, 0.7])  # 0.8 (1 - 2/3) (1 - 7/13) < 0.2
    assert kept.tolist() == [[0, 0, 10, 10], [5, 0, 15, 10]]
    _, score, _ = non_maximum_suppression(boxes[:2], scores[:2], 0.2, 0.5, 10)
    assert score.tolist() == pytest.approx([0.9, 0.8 / 3])


def test_suppression_of_nothing_gives_nothing():
    boxes, score, label = non_maximum_suppression(
        torch.zeros(5, 4), torch.zeros(5, 1), 0.25, 0.5, 10
    )
    assert len(boxes) == len(score) == len(label) == 0


def cells(match, anchor: int) -> set[tuple[int, int]]:
    chosen = match.anchor == anchor
    return set(zip(match.column[chosen].tolist(), match.row[chosen].tolist(), strict=True))


def test_a_box_is_assigned_to_its_cell_and_the_two_nearest():
    anchors = torch.tensor([[16.0, 30.0], [16.0, 30.0], [200.0, 200.0]])
    target = torch.tensor([[0, 0, 8 * 4.3, 8 * 6.8, 16.0, 30.0]])
    match = assign(target, anchors, 8, (20, 20), 4.0)
    assert cells(match, 0) == {(4, 6), (3, 6), (4, 7)}
    assert cells(match, 2) == set()  # more than four times as large


def test_assignment_stays_inside_the_grid():
    anchors = torch.tensor([[16.0, 16.0]] * 3)
    target = torch.tensor([[0, 0, 0.5, 0.5, 16.0, 16.0], [0, 0, 159.9, 159.9, 16.0, 16.0]])
    match = assign(target, anchors, 8, (20, 20), 4.0)
    assert cells(match, 0) == {(0, 0), (19, 19)}


def test_crossing_boxes_with_one_centre_each_get_the_anchor_of_their_shape():
    anchors = torch.tensor([[20.0, 40.0], [40.0, 20.0], [30.0, 30.0]])
    standing = [0, 0, 84.0, 84.0, 20.0, 41.0]
    lying = [0, 1, 84.0, 84.0, 44.0, 20.0]
    match = assign(torch.tensor([standing, lying]), anchors, 8, (20, 20), 4.0)
    places = torch.stack([match.image, match.anchor, match.row, match.column], 1)
    assert len(places.unique(dim=0)) == len(places)
    assert set(match.label[match.anchor == 0].tolist()) == {0}
    assert set(match.label[match.anchor == 1].tolist()) == {1}
    assert set(match.label[match.anchor == 2].tolist()) == {0}  # 41/30 is nearer than 44/30


def test_a_perfect_prediction_has_almost_no_loss():
    anchors = torch.tensor(ANCHORS, dtype=torch.float32)
    target = torch.tensor([[0, 0, 8 * 6.5, 8 * 4.5, 16.0, 30.0]])
    maps = [torch.zeros(1, 128 // s, 128 // s, 3, 6) for s in STRIDES]
    for m in maps:
        m[..., 4] = -20.0
    weights = LossWeights(anchor_ratio=1.2)  # only the anchor of 16 x 30 px fits
    match = assign(target, anchors[0], 8, (16, 16), 1.2)
    for row, column in zip(match.row.tolist(), match.column.tolist(), strict=True):
        shift = torch.tensor([6.5 - column, 4.5 - row])
        maps[0][0, row, column, 1, :2] = torch.logit((shift + 0.5) / 2)
        maps[0][0, row, column, 1, 4] = 20.0
    good, _ = detection_loss(maps, target, anchors, weights)
    assert good.item() < 1e-3
    worse = [m.clone() for m in maps]
    worse[0][..., 4] = -20.0  # sees nothing
    assert detection_loss(worse, target, anchors, weights)[0].item() > 10 * good.item()


def test_an_empty_image_trains_objectness_alone():
    anchors = torch.tensor(ANCHORS, dtype=torch.float32)
    maps = [torch.zeros(1, 64 // s, 64 // s, 3, 6, requires_grad=True) for s in STRIDES]
    loss, terms = detection_loss(maps, torch.zeros(0, 6), anchors, LossWeights())
    # BCE of probability 1/2 is log 2 on every scale.
    assert loss.item() == pytest.approx((4.0 + 1.0 + 0.4) * math.log(2), rel=1e-5)
    assert terms["box"].item() == 0.0
    loss.backward()
    assert torch.isfinite(maps[0].grad).all()
