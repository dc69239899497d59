"""Rectangles -> the maps that a network learns."""

from typing import NamedTuple

import cv2
import numpy as np

from iwgnet_grasp.data.grasp_rectangle import JAW, OPENING, QUALITY, THETA, X, Y, corners
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX

_SUBPIXEL_BITS = 4


class LabelMaps(NamedTuple):
    """float32 [H, W] each. `mask` is 1 on grasps; cos, sin and width mean nothing elsewhere."""

    q: np.ndarray
    cos: np.ndarray
    sin: np.ndarray
    width: np.ndarray
    mask: np.ndarray


def label_maps(rectangles: np.ndarray, height: int, width: int) -> LabelMaps:
    """Draws the centre third of each rectangle [n, 6]: opening / 3 along, the jaw across.

    q is the grasp's quality, width its opening in WIDTH_REFERENCE_PX of this very image. Where
    rectangles overlap, the better grasp is drawn over the worse.
    """
    order = np.argsort(rectangles[:, QUALITY], kind="stable")
    index = np.full((height, width), -1, np.int32)
    for i in order:
        row = rectangles[i]
        points = corners(row[X], row[Y], row[THETA], row[OPENING] / 3, row[JAW])
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillConvexPoly(index, fixed, int(i), shift=_SUBPIXEL_BITS)
    mask = index >= 0
    # One more entry for -1, the background.
    quality = np.append(rectangles[:, QUALITY], 0).astype(np.float32)
    theta = np.append(rectangles[:, THETA], 0)
    opening = np.append(rectangles[:, OPENING] / WIDTH_REFERENCE_PX, 0).astype(np.float32)
    return LabelMaps(
        quality[index],
        np.where(mask, np.cos(2 * theta).astype(np.float32)[index], 0),
        np.sin(2 * theta).astype(np.float32)[index],
        opening[index],
        mask.astype(np.float32),
    )
