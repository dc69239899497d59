"""The extension iwgnet_grasp._core: shapes, memory, errors, and one pick by ground truth."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from iwgnet_grasp import _core

ROOT = Path(__file__).resolve().parents[2]
PARTS = ROOT / "assets" / "parts"
CONFIG = str(ROOT / "config")


@pytest.fixture(scope="module")
def cell():
    return _core.SimulatedCell(str(ROOT))


def test_inverse_kinematics_finds_the_pose_again():
    rng = np.random.default_rng(0)
    for q in rng.uniform(-math.pi, math.pi, (50, 6)):
        T = _core.forward(q)
        assert T.shape == (4, 4)
        solutions = _core.inverse(T)
        assert solutions.ndim == 2 and solutions.shape[1] == 6 and 1 <= len(solutions) <= 8
        for solution in solutions:
            np.testing.assert_allclose(_core.forward(solution), T, atol=1e-9)


def test_a_matrix_that_is_no_pose_is_a_core_error():
    with pytest.raises(_core.CoreError, match="rigid"):
        _core.inverse(2 * np.eye(4))


def test_core_errors_are_runtime_errors_with_one_line(cell):
    with pytest.raises(_core.CoreError, match="five_scattered") as info:
        cell.load_scene("six_flying", 0)
    assert isinstance(info.value, RuntimeError) and "\n" not in str(info.value)
    with pytest.raises(_core.CoreError):
        _core.load_cell_config("/nowhere")


def test_images_have_the_cameras_size_and_outlive_the_next_frame(cell):
    cell.load_scene("five_scattered", 0)
    k = cell.camera.color
    color = cell.color()
    assert color.shape == (k.height, k.width, 3) and color.dtype == np.uint8
    kept = color.copy()
    cell.color()
    np.testing.assert_array_equal(color, kept)
    depth = cell.depth()
    d = cell.camera.depth
    assert depth.shape == (d.height, d.width) and depth.dtype == np.float32
    aligned = cell.aligned_depth(depth)
    assert aligned.shape == (k.height, k.width)
    assert cell.part_mask().dtype == np.int32
    assert cell.part_poses().shape == (5, 4, 4)
    assert len(cell.part_names) == len(cell.part_families) == 5


def test_a_depth_array_that_is_not_contiguous_is_taken_as_it_reads(cell):
    cell.load_scene("five_scattered", 0)
    depth = cell.depth()
    strided = np.asfortranarray(depth)
    np.testing.assert_array_equal(cell.aligned_depth(strided), cell.aligned_depth(depth))
    with pytest.raises(_core.CoreError, match="shape"):
        cell.aligned_depth(depth[None])


def test_the_camera_can_be_moved_and_a_new_scene_puts_it_back(cell):
    cell.load_scene("", 0)
    camera = cell.camera
    T = camera.T_base_color
    T[2, 3] += 0.05
    camera.T_base_color = T
    cell.camera = camera
    center = cell.ideal_depth()[camera.color.height // 2, camera.color.width // 2]
    assert center == pytest.approx(T[2, 3], abs=1e-4)
    cell.load_scene("", 0)
    assert cell.camera.T_base_color[2, 3] == pytest.approx(T[2, 3] - 0.05)


def test_hidden_parts_are_not_seen(cell):
    cell.load_scene("five_scattered", 1)
    assert (cell.part_mask() >= 0).any()
    cell.show_parts(False)
    assert not (cell.part_mask() >= 0).any()
    cell.show_parts(True)
    assert (cell.part_mask() >= 0).any()


def test_a_part_on_another_weighs_on_it_and_spoils_the_grasps_below(cell):
    def best(part):
        labels = _core.GraspLabeler(CONFIG).label(cell, *cell.ideal_view())
        return max((label.rectangle.quality for label in labels if label.part == part), default=0)

    cell.load_scene("five_scattered", 1)
    assert cell.supports() == []
    free = best(0)
    poses = cell.part_poses()
    poses[1] = poses[0]
    # Across each other, one flat on the other's end.
    poses[1, :3, :3] = cv2.Rodrigues(np.array([0, 0, math.pi / 2]))[0] @ poses[0, :3, :3]
    poses[1, 2, 3] += 2 * poses[0, 2, 3]
    cell.lay_parts(poses)
    cell.step(round(0.5 / cell.timestep))
    supports = cell.supports()
    assert max(supports, key=lambda support: support[2])[:2] == (0, 1)
    carried = sum(force for _, over, force in supports if over == 1)
    mass = yaml.safe_load((PARTS / cell.part_names[1] / "part.yaml").read_text())["mass"]
    assert carried == pytest.approx(mass * 9.81, rel=0.05)
    assert best(0) < 0.5 * free < best(1)


def test_projection_round_trip():
    k = _core.PinholeIntrinsics(1280, 800, 640.0, 640.0, 639.5, 399.5)
    point = _core.deproject(k, 100.0, 700.0, 0.6)
    np.testing.assert_allclose(_core.project(k, point), [100.0, 700.0])


def test_eq_4_and_eq_5():
    assert _core.depth_from_disparity(100.0, 650.0, 0.095) == pytest.approx(650 * 0.095 / 100)
    assert _core.width_in_metres(64.0, 0.6, 640.0) == pytest.approx(0.06)


def test_labels_lie_on_the_part_that_they_name(cell):
    cell.load_scene("five_scattered", 2)
    depth, mask = cell.ideal_depth(), cell.part_mask()
    labels = _core.GraspLabeler(CONFIG).label(cell, depth, mask)
    assert {label.part for label in labels} == set(range(5))
    for label in labels:
        r = label.rectangle
        assert 0 < r.quality <= 1 and -math.pi / 2 < r.theta_rad <= math.pi / 2
        assert label.pose.feasible and label.opening_px > r.width_px > 0
        # Across a bore the part is met half a width from the centre.
        reach = math.ceil(r.width_px / 2) + 2
        x, y = round(r.x_px), round(r.y_px)
        near = mask[y - reach : y + reach + 1, x - reach : x + reach + 1]
        assert (near == label.part).any()
        # The closing direction in the image is the gripper's x axis in base_link (y mirrored).
        x_axis = label.pose.T_base_tcp[:2, 0]
        turn = math.remainder(math.atan2(x_axis[1], x_axis[0]) - r.theta_rad, math.pi)
        assert abs(turn) < 0.1


def test_a_pick_by_ground_truth_succeeds_in_the_judges_eyes_and_repeats_to_the_bit(cell):
    def pick():
        cell.load_scene("five_scattered", 3)
        depth = cell.ideal_depth()
        labels = _core.GraspLabeler(CONFIG).label(cell, depth, cell.part_mask())
        best = max(labels, key=lambda label: label.rectangle.quality)
        camera = cell.camera
        heights = _core.HeightMap(depth, camera.color, camera.T_base_color, cell.config)
        pick_and_place = _core.PickAndPlace(cell.config, _core.load_pick_place_config(CONFIG))
        pick_and_place.set_heights(heights)
        phases = []
        result = pick_and_place.run(
            _core.SimulatedRobot(cell),
            best.pose,
            cell.part_poses()[best.part, :3, 3],
            0,
            lambda phase: phases.append(phase) or True,
        )
        assert result.reason == _core.PickReason.SUCCEEDED, result.message
        assert "grasp" in phases and "release" in phases
        return best.part, json.loads(cell.verdict()), cell.part_poses()

    part, verdict, poses = pick()
    assert [p["part"] for p in verdict["picks"]] == [part]
    assert verdict["picks"][0]["success"], verdict
    assert verdict["picks"][0]["slip_mm"] < 5.0
    assert verdict["in_tray"] == 1 and verdict["on_table"] == 4
    assert not verdict["success"]  # four parts are left
    again = pick()
    assert again[1] == verdict
    np.testing.assert_array_equal(again[2], poses)
