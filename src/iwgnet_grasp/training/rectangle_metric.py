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


def matches(grasp: Grasp, truth: np.ndarray) -> bool:
    """True when IoU > 0.25 and angle within 30 deg hold for one of the rectangles [n, 6].

    The jaw is the gripper's and not predicted: it is taken from the rectangle compared with.
    """
    row = np.empty(COLUMNS, np.float32)
    row[[X, Y, THETA]] = grasp.x_px, grasp.y_px, grasp.theta_rad
    row[[OPENING, QUALITY]] = grasp.width_px, grasp.quality
    for candidate in truth[angle_between(truth[:, THETA], row[THETA]) <= ANGLE_THRESHOLD]:
        row[JAW] = candidate[JAW]
        if iou(row, candidate) > IOU_THRESHOLD:
            return True
    return False


def any_match(grasps: Iterable[Grasp], truth: np.ndarray) -> bool:
    return any(matches(grasp, truth) for grasp in grasps)
