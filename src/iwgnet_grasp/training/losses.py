"""Loss of the grasp networks."""

from typing import NamedTuple

from torch import Tensor
from torch.nn import functional as F


class GraspLoss(NamedTuple):
    total: Tensor
    quality: Tensor
    angle: Tensor
    width: Tensor


def grasp_loss(
    logits: Tensor,
    labels: Tensor,
    quality_power: float = 1.0,
    angle_weight: float = 1.0,
    width_weight: float = 2.0,
) -> GraspLoss:
    """Cross entropy on Q, smooth L1 on cos, sin and width where a grasp is.

    logits: [N, 4, H, W] of GraspNetwork.logits. labels: [N, 5, H, W] (q, cos, sin, width, mask).
    Q: cross entropy with the soft target q ** quality_power (its minimum is the target itself, and
    a grasp of quality 0.1 still pulls ten times as hard as one of 0.01), summed over all pixels and
    divided by the number of grasp pixels, so that it does not depend on how much empty table is
    seen. The entropy of the target is taken off: a perfect Q costs 0. The background has neither
    angle nor width.

    A Q learnt with power 1 is the quality on average: a place that would be good and is barred four
    times in five is worth as much as one that is poor and sure. The lower the power, the more
    counts whether there is a grasp at all.
    """
    target, mask = labels[:, 0] ** quality_power, labels[:, 4:5]
    positives = mask.sum().clamp(min=1)
    logit = logits[:, 0].float()
    cross_entropy = F.binary_cross_entropy_with_logits(logit, target, reduction="sum")
    least = F.binary_cross_entropy(target, target, reduction="sum")
    quality = (cross_entropy - least) / positives
    # The masked maps are zero on both sides where no grasp is.
    double_angle = logits[:, 1:3].float() * mask
    angle = F.smooth_l1_loss(double_angle, labels[:, 1:3], reduction="sum", beta=0.1) / positives
    opening = logits[:, 3:].float() * mask
    width = F.smooth_l1_loss(opening, labels[:, 3:4], reduction="sum", beta=0.05) / positives
    total = quality + angle_weight * angle + width_weight * width
    return GraspLoss(total, quality, angle, width)
