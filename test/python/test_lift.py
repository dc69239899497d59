"""Open-loop lifts: what holds is lifted, what does not is named, and the scene stays as it was."""

from pathlib import Path

import numpy as np
import pytest

from iwgnet_grasp import _core
from iwgnet_grasp.perception.types import GraspRectangle
from iwgnet_grasp.trials.lift import Lifter

CONFIG = str(Path(__file__).resolve().parents[2] / "config")


@pytest.fixture(scope="module")
def lifter():
    return Lifter()


@pytest.fixture(scope="module")
def scene(lifter):
    """Heights and labels of five scattered rods, best first within a rod."""
    lifter.cell.load_scene("five_scattered", 3)
    depth = lifter.cell.ideal_depth()
    labels = _core.GraspLabeler(CONFIG).label(lifter.cell, depth, lifter.cell.part_mask())
    return lifter.heights(depth), labels


def test_the_best_label_lifts_its_part_again_and_again(lifter, scene):
    heights, labels = scene
    before = lifter.cell.part_poses()
    first = lifter.lift(labels[0].pose, heights, labels[0].part)
    assert first.lifted and first.executed and first.part == labels[0].part, first
    assert first.slip_mm < 5 and first.slip_deg < 5
    np.testing.assert_allclose(lifter.cell.part_poses(), before, atol=1e-12)
    assert lifter.cell.time == 0
    assert lifter.lift(labels[0].pose, heights, labels[0].part) == first  # to the bit


def test_a_rectangle_goes_the_robots_own_way_to_its_pose(lifter, scene):
    heights, labels = scene
    r = labels[0].rectangle
    pose = lifter.pose(
        GraspRectangle(r.x_px, r.y_px, r.theta_rad, r.width_px, r.quality, r.depth_m), heights
    )
    np.testing.assert_allclose(pose.T_base_tcp, labels[0].pose.T_base_tcp, atol=2e-3)
    assert lifter.lift(pose, heights).lifted


def test_a_lift_of_another_part_than_the_one_meant_is_no_lift(lifter, scene):
    heights, labels = scene
    other = next(label.part for label in labels if label.part != labels[0].part)
    lift = lifter.lift(labels[0].pose, heights, other)
    assert lift.outcome == "wrong_part" and lift.part == labels[0].part


def test_closing_in_the_air_over_a_part_misses(lifter, scene):
    heights, labels = scene
    pose = labels[0].pose
    raised = pose.T_base_tcp
    raised[2, 3] += 0.06  # the rods are at most 28 mm thick
    above = _core.GraspPose()
    above.T_base_tcp = raised
    above.width, above.opening, above.feasible = pose.width, pose.opening, True
    lift = lifter.lift(above, heights)
    assert lift.outcome == "missed" and lift.executed and lift.part == -1, lift


def test_a_pose_that_is_not_feasible_is_not_tried(lifter, scene):
    pose = _core.GraspPose()
    pose.reason = "no depth"
    lift = lifter.lift(pose, scene[0])
    assert lift.outcome == "infeasible" and not lift.executed and "no depth" in lift.message


def test_parts_are_laid_back_only_with_a_pose_each(lifter, scene):
    with pytest.raises(_core.CoreError, match="4 poses for the scene's 5 parts"):
        lifter.cell.lay_parts(lifter.cell.part_poses()[:4])
