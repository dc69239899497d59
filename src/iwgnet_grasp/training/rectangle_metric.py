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


def hit(grasp: Grasp, truth: np.ndarray) -> np.ndarray | None:
    """Of the rectangles [n, 6] that the grasp matches, the one with the nearest centre, [6].

    It matches where IoU > 0.25 and the angles are within 30 deg. The jaw is the gripper's and not
    predicted: it is taken from the rectangle compared with.
    """
    row = np.empty(COLUMNS, np.float32)
    row[[X, Y, THETA]] = grasp.x_px, grasp.y_px, grasp.theta_rad
    row[[OPENING, QUALITY]] = grasp.width_px, grasp.quality
    distances = np.hypot(truth[:, X] - row[X], truth[:, Y] - row[Y])
    turned = angle_between(truth[:, THETA], row[THETA]) > ANGLE_THRESHOLD
    for i in np.argsort(distances, kind="stable"):
        row[JAW] = truth[i, JAW]
        if not turned[i] and iou(row, truth[i]) > IOU_THRESHOLD:
            return truth[i]
    return None


def matches(grasp: Grasp, truth: np.ndarray) -> bool:
    """Whether the grasp hits one of the rectangles [n, 6]."""
    return hit(grasp, truth) is not None


def any_match(grasps: Iterable[Grasp], truth: np.ndarray) -> bool:
    return any(matches(grasp, truth) for grasp in grasps)
