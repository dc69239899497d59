"""The rectangle metric of the grasp literature."""

from collections.abc import Iterable

import numpy as np

from iwgnet_grasp.data.grasp_rectangle import (
    COLUMNS,
    JAW,
    OPENING,
    QUALITY,
    THETA,
    Grasp,
    X,
    Y,
    angle_between,
    iou,
)

IOU_THRESHOLD = 0.25
ANGLE_THRESHOLD = np.radians(30)


def as_rectangle(grasp: Grasp) -> np.ndarray:
    """Row [6] of a predicted grasp; its jaw is half its opening, as in GG-CNN's evaluation."""
    row = np.empty(COLUMNS, np.float32)
    row[[X, Y, THETA]] = grasp.x_px, grasp.y_px, grasp.theta_rad
    row[[OPENING, JAW, QUALITY]] = grasp.width_px, grasp.width_px / 2, grasp.quality
    return row


def matches(grasp: Grasp, truth: np.ndarray) -> bool:
    """True when IoU > 0.25 and angle within 30 deg hold for one of the rectangles [n, 6]."""
    row = as_rectangle(grasp)
    near = angle_between(truth[:, THETA], row[THETA]) <= ANGLE_THRESHOLD
    reach = np.hypot(truth[:, X] - row[X], truth[:, Y] - row[Y])
    near &= reach < 0.5 * (truth[:, OPENING] + truth[:, JAW] + row[OPENING] + row[JAW])
    return any(iou(row, candidate) > IOU_THRESHOLD for candidate in truth[near])


def any_match(grasps: Iterable[Grasp], truth: np.ndarray) -> bool:
    return any(matches(grasp, truth) for grasp in grasps)
