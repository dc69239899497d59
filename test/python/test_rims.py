"""Grasps of a ring's wall: found in outlines, and they hold."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from iwgnet_grasp import _core
from iwgnet_grasp.perception.rims import rim_grasps
from iwgnet_grasp.perception.types import Box
from iwgnet_grasp.trials.lift import Lifter

CONFIG = str(Path(__file__).resolve().parents[2] / "config")
BOX = Box(200, 100, 160, 120)
CENTRE = 60, 55  # in the box
OUTER, INNER = 26, 19  # px, radii
FLAT = np.full((BOX.height, BOX.width), 0.022, np.float32)  # m


def ring(inner: int = INNER, shank: bool = True) -> np.ndarray:
    """A rod's end, its shank to the right."""
    image = np.zeros((BOX.height, BOX.width), np.uint8)
    cv2.circle(image, CENTRE, OUTER, 1, -1)
    if shank:
        cv2.rectangle(image, (CENTRE[0], CENTRE[1] - 8), (140, CENTRE[1] + 8), 1, -1)
    if inner:
        cv2.circle(image, CENTRE, inner, 0, -1)
    return image > 0


def test_the_wall_of_a_hole_is_gripped_along_its_radius_away_from_the_rest():
    """Not where the shank begins, nor beside it, where the rod would turn between the pads."""
    grasps = rim_grasps(ring(), FLAT, BOX, 0.4)
    assert len(grasps) >= 4
    centre = np.array([BOX.x + CENTRE[0], BOX.y + CENTRE[1]])
    for g in grasps:
        offset = np.array([g.x_px, g.y_px]) - centre
        along = np.array([math.cos(g.theta_rad), -math.sin(g.theta_rad)])
        assert abs(offset @ along) == pytest.approx(np.linalg.norm(offset), rel=0.01)
        assert offset[0] < -0.8 * np.linalg.norm(offset)  # the shank is to the right
        outside = np.linalg.norm(offset) + g.width_px / 2
        inside = np.linalg.norm(offset) - g.width_px / 2
        assert outside == pytest.approx(OUTER, abs=1.5)
        # A 22 mm pad at 1 mm a pixel meets the hole by its edges.
        assert math.hypot(inside, 11) == pytest.approx(INNER, abs=1.5)
        assert -math.pi / 2 < g.theta_rad <= math.pi / 2 and g.quality == 0.4


def test_walls_that_the_camera_sees_from_the_side_shift_nothing():
    """Seen from beside its axis a hole shows a part of its wall, as the object's pixels."""
    mask, heights = ring(), FLAT.copy()
    wall = np.zeros((BOX.height, BOX.width), np.uint8)
    cv2.circle(wall, CENTRE, INNER, 1, -1)
    cv2.circle(wall, (CENTRE[0] + 5, CENTRE[1]), INNER, 0, -1)
    heights[(wall > 0) & ~mask] = 0.008
    mask |= wall > 0
    heights[~mask] = np.nan
    expected = [(g.x_px, g.y_px) for g in rim_grasps(ring(), FLAT, BOX, 1.0)]
    found = [(g.x_px, g.y_px) for g in rim_grasps(mask, heights, BOX, 1.0)]
    np.testing.assert_allclose(found, expected, atol=1.5)


@pytest.mark.parametrize(
    "mask",
    [
        ring(inner=0),
        ring(inner=10),  # no finger fits in
        ring(shank=False),  # nothing tells where the rest of the part is
        np.zeros((BOX.height, BOX.width), bool),
        np.ones((BOX.height, BOX.width), bool),
    ],
    ids=["disc", "small hole", "ring", "nothing", "everything"],
)
def test_what_has_no_hole_that_a_finger_can_hold_it_by_has_no_rim(mask):
    assert rim_grasps(mask, FLAT, BOX, 1.0) == []


def test_a_rod_held_by_its_rim_is_laid_into_the_middle_of_its_slot():
    """By friction alone, the centre of mass far beside the fingers."""
    lifter = Lifter()
    cell = lifter.cell
    cell.load_scene("", 3)
    empty = cell.ideal_depth()
    cell.load_scene("five_scattered", 3)
    depth, mask = cell.ideal_depth(), cell.part_mask()
    heights = lifter.heights(depth)
    part = cell.part_names.index("rod_106")
    rows, columns = np.nonzero(mask == part)
    box = Box(columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
    centroid = cell.part_poses()[part, :3, 3]
    pad = 0.011  # m
    held = []
    own = mask[box.slices] == part
    for g in rim_grasps(own, empty[box.slices] - depth[box.slices], box, 1.0):
        pose = lifter.pose(g, heights)
        beside = np.linalg.inv(pose.T_base_tcp)[:3] @ np.append(centroid, 1.0)
        if pose.feasible and abs(beside[1]) < pad:
            held.append((abs(beside[0]), pose))
    distance, pose = max(held, key=lambda entry: entry[0])
    assert distance > 0.035
    slot = 7
    pick_and_place = _core.PickAndPlace(cell.config, _core.load_pick_place_config(CONFIG))
    pick_and_place.set_heights(heights)
    result = pick_and_place.run(_core.SimulatedRobot(cell), pose, centroid, slot)
    assert result.reason.name == "SUCCEEDED", result.message
    cell.step(round(1.0 / cell.timestep))
    verdict = json.loads(cell.verdict())
    assert verdict["picks"][0]["success"] and verdict["picks"][0]["part"] == part, verdict
    assert verdict["picks"][0]["slip_deg"] < 2.0
    at = cell.part_poses()[part]
    middle = np.array(cell.config.tray_slots[slot])
    assert np.linalg.norm(at[:2, 3] - middle[:2]) < 0.015
    long_axis = at[:2, 0] / np.linalg.norm(at[:2, 0])  # a rod's x axis (config/parts.yaml)
    assert abs(long_axis[1]) > math.cos(math.radians(15))
