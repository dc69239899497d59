"""Grasp rectangles in the image plane.

A set of n rectangles is a float32 array [n, 6] with the columns below. theta is the closing
direction, counter-clockwise as seen: atan2(-dy, dx), in (-pi/2, pi/2]. `OPENING` is the jaw opening
along it, `JAW` the extent of the jaws across it.
"""

from typing import NamedTuple

import cv2
import numpy as np

X, Y, THETA, OPENING, JAW, QUALITY = range(6)
COLUMNS = 6


class Grasp(NamedTuple):
    """A predicted grasp in pixels of the image that went into the network."""

    x_px: float
    y_px: float
    theta_rad: float
    width_px: float
    quality: float


def wrap_theta(theta: np.ndarray | float) -> np.ndarray:
    """The same closing direction in (-pi/2, pi/2]: a gripper turned by pi is the same gripper."""
    return -((-np.asarray(theta) + np.pi / 2) % np.pi - np.pi / 2)


def angle_between(a: np.ndarray | float, b: np.ndarray | float) -> np.ndarray:
    """Angle between two closing directions, in [0, pi/2]."""
    return np.abs(wrap_theta(np.asarray(a) - np.asarray(b)))


def corners(x: float, y: float, theta: float, opening: float, jaw: float) -> np.ndarray:
    """Corners [4, 2] (x, y); the first two span the opening."""
    along = 0.5 * opening * np.array([np.cos(theta), -np.sin(theta)])
    across = 0.5 * jaw * np.array([np.sin(theta), np.cos(theta)])
    centre = np.array([x, y])
    return centre + np.stack([-along - across, along - across, along + across, -along + across])


def from_corners(points: np.ndarray, quality: float = 1.0) -> np.ndarray:
    """Row [6] of four corners [4, 2] (x, y), the first two of which span the opening."""
    (x0, y0), (x1, y1), (x2, y2) = points[:3]
    row = np.zeros(COLUMNS, np.float32)
    row[X], row[Y] = points.mean(axis=0)
    row[THETA] = wrap_theta(np.arctan2(-(y1 - y0), x1 - x0))
    row[OPENING] = np.hypot(x1 - x0, y1 - y0)
    row[JAW] = np.hypot(x2 - x1, y2 - y1)
    row[QUALITY] = quality
    return row


def transform(rectangles: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Rectangles after an image warp, a similarity [2, 3] of (x, y): rotation, zoom, shift, mirror.

    Opening and jaw grow with the zoom, as the image does.
    """
    moved = rectangles.copy()
    linear = affine[:, :2]
    moved[:, [X, Y]] = rectangles[:, [X, Y]] @ linear.T + affine[:, 2]
    direction = np.stack([np.cos(rectangles[:, THETA]), -np.sin(rectangles[:, THETA])], axis=1)
    direction = direction @ linear.T
    moved[:, THETA] = wrap_theta(np.arctan2(-direction[:, 1], direction[:, 0]))
    zoom = np.sqrt(abs(np.linalg.det(linear)))
    moved[:, [OPENING, JAW]] *= zoom
    return moved


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two rows (x, y, theta, opening, jaw, ...)."""
    area_a, area_b = a[OPENING] * a[JAW], b[OPENING] * b[JAW]
    if area_a <= 0 or area_b <= 0:
        return 0.0
    kind, points = cv2.rotatedRectangleIntersection(_box(a), _box(b))
    if kind == cv2.INTERSECT_NONE or points is None or len(points) < 3:
        return 0.0
    shared = cv2.contourArea(cv2.convexHull(points))
    return float(shared / (area_a + area_b - shared))


def _box(row: np.ndarray) -> tuple:
    centre = (float(row[X]), float(row[Y]))
    return centre, (float(row[OPENING]), float(row[JAW])), -float(np.degrees(row[THETA]))
