"""Grasps across an object's length, from its pixels alone.

For a look in which objects are thought away: what is made up of the surface beneath them is smooth
and ends where the hidden outline is not known, unlike anything that the grasp network has learnt
from, so that it finds no grasp on some objects.
"""

from __future__ import annotations

import math

import numpy as np

from iwgnet_grasp.data.grasp_rectangle import wrap_theta
from iwgnet_grasp.perception.types import Box, GraspRectangle

PLACES = (0.25, 0.375, 0.5, 0.625, 0.75)  # along the object, as parts of its length
BAND_PX = 4.0  # half the length of the piece whose width is measured
MIN_PX = 20  # that it must show
MIN_SLENDERNESS = 1.5  # length to width (standard deviations), or its direction says nothing


def shank_grasps(mask: np.ndarray, box: Box, quality: float) -> list[GraspRectangle]:
    """Grasps, in px of the image, that close across the longer principal axis of an object.

    mask: (box.height, box.width) bool, the object's pixels; quality: what each is given.
    """
    rows, columns = np.nonzero(mask)
    if len(rows) < MIN_PX:
        return []
    points = np.column_stack([columns, rows]).astype(float)
    middle = points.mean(0)
    spread, axes = np.linalg.eigh(np.cov((points - middle).T))
    if spread[1] < MIN_SLENDERNESS**2 * spread[0]:
        return []
    across, along = axes.T
    place, side = (points - middle) @ along, (points - middle) @ across
    low, high = place.min(), place.max()
    grasps = []
    for share in PLACES:
        at = low + share * (high - low)
        band = side[np.abs(place - at) <= BAND_PX]
        if len(band) < MIN_PX:
            continue
        x, y = middle + at * along + (band.min() + band.max()) / 2 * across
        theta = float(wrap_theta(math.atan2(-across[1], across[0])))  # y points down
        width = float(band.max() - band.min() + 1)
        grasps.append(GraspRectangle(box.x + float(x), box.y + float(y), theta, width, quality))
    return grasps
