"""Grasps across an object's length."""

import math

import cv2
import numpy as np
import pytest

from iwgnet_grasp.data.grasp_rectangle import angle_between
from iwgnet_grasp.perception.shanks import PLACES, shank_grasps
from iwgnet_grasp.perception.types import Box

BOX = Box(100, 50, 200, 160)
MIDDLE = (95.0, 82.0)  # in the box


def bar(angle_deg: float, length: float = 130, width: float = 24) -> np.ndarray:
    """A bar whose length lies at an angle to the image's x, counter-clockwise as seen."""
    corners = cv2.boxPoints((MIDDLE, (length, width), -angle_deg))
    mask = np.zeros((BOX.height, BOX.width), np.uint8)
    return cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 1).astype(bool)


@pytest.mark.parametrize("angle_deg", [0, 25, 90, -60])
def test_a_bar_is_gripped_across_its_length(angle_deg):
    grasps = shank_grasps(bar(angle_deg), BOX, 0.3)
    assert len(grasps) == len(PLACES)
    along = math.radians(angle_deg)
    for grasp in grasps:
        assert angle_between(grasp.theta_rad, along + math.pi / 2) < 0.05
        # The ends of the band widen a bar that does not lie along the rows.
        assert 24 <= grasp.width_px <= 28
        off = np.array([grasp.x_px - BOX.x - MIDDLE[0], grasp.y_px - BOX.y - MIDDLE[1]])
        assert abs(off @ (math.sin(along), math.cos(along))) < 1.5
        assert grasp.quality == 0.3
    reach = [math.hypot(g.x_px - BOX.x - MIDDLE[0], g.y_px - BOX.y - MIDDLE[1]) for g in grasps]
    assert min(reach) < 2 and max(reach) == pytest.approx(130 / 4, abs=3)


def test_nothing_is_gripped_where_it_is_hidden_or_has_no_length():
    mask = bar(0)
    mask[:, 85:105] = False
    assert len(shank_grasps(mask, BOX, 0.3)) == len(PLACES) - 1
    disc = np.zeros((BOX.height, BOX.width), np.uint8)
    cv2.circle(disc, (90, 80), 40, 1, -1)
    assert shank_grasps(disc.astype(bool), BOX, 0.3) == []
    assert shank_grasps(np.zeros((160, 200), bool), BOX, 0.3) == []
