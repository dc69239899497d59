"""Eye-to-hand calibration: targets, poses, samples, solution; one whole routine in process."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from iwgnet_grasp.calibration import in_process, report
from iwgnet_grasp.calibration.board import NAMES, Board, DetectionError
from iwgnet_grasp.calibration.poses import PosePlanner, tour
from iwgnet_grasp.calibration.samples import load, save, simulated
from iwgnet_grasp.calibration.settings import (
    CalibrationError,
    angle,
    difference,
    inverse,
    load_settings,
)
from iwgnet_grasp.calibration.solve import compare, solve, solve_with_visp

ROOT = Path(__file__).resolve().parents[2]
K = np.array([[640.0, 0, 639.5], [0, 640.0, 399.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def settings():
    return load_settings()


def pose(move, turn) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(turn, float))[0]
    T[:3, 3] = move
    return T


FACING = np.diag([1.0, -1.0, -1.0, 1.0])  # a board that looks into the camera


def photograph(board: Board, settings, T_camera_board: np.ndarray) -> np.ndarray:
    """The print on a grey ground as a pinhole camera sees it: an image four times as large by
    homography, then the mean over each pixel."""
    zoom = 4
    albedo = board.print()
    # Print pixels (centre of the top left one at 0, 0) -> board plane (m) -> image pixels.
    width, height = settings.print_size
    step = width / albedo.shape[1]
    to_board = np.array(
        [[step, 0, -width / 2 + step / 2], [0, -step, height / 2 - step / 2], [0, 0, 1.0]]
    )
    large = K.copy()
    large[:2] *= zoom
    large[:2, 2] += (zoom - 1) / 2
    H = large @ T_camera_board[:3, [0, 1, 3]] @ to_board
    size = (1280 * zoom, 800 * zoom)
    image = cv2.warpPerspective(
        albedo, H, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=128
    )
    image = cv2.resize(image, (1280, 800), interpolation=cv2.INTER_AREA)
    return np.dstack([image] * 3)


# The corner of a tag is less sharp than the crossing of two edges.
@pytest.mark.parametrize(("name", "limit_px"), [("charuco", 0.1), ("apriltag", 0.4)])
def test_corners_are_found_where_the_camera_model_puts_them(name, limit_px, settings):
    board = Board(name, settings)
    T = pose([0.03, -0.02, 0.36], [0, 0, 0]) @ FACING @ pose([0, 0, 0], [0.3, -0.35, 0.4])
    detection = board.detect(photograph(board, settings, T), K)
    assert len(detection.corners) == len(board.corners)
    points = detection.corners @ T[:3, :3].T + T[:3, 3]
    expected = points[:, :2] / points[:, 2:] * [640, 640] + K[:2, 2]
    error = detection.pixels - expected
    assert np.abs(error.mean(axis=0)).max() < 0.05  # half a pixel is a common mistake
    assert np.sqrt((error**2).mean()) < limit_px
    found, rms = board.pose(detection, K)
    move, turn = difference(found, T)
    assert move < 1e-3 and turn < np.radians(0.3) and rms < limit_px


@pytest.mark.parametrize("name", NAMES)
def test_a_board_that_is_not_wholly_in_view_is_refused_with_the_reason(name, settings):
    board = Board(name, settings)
    empty = np.full((800, 1280, 3), 120, np.uint8)
    with pytest.raises(DetectionError, match="no board in view"):
        board.detect(empty, K)
    half_out = photograph(board, settings, pose([0.31, 0.0, 0.30], [0, 0, 0]) @ FACING)
    with pytest.raises(DetectionError, match="half out of the image"):
        board.detect(half_out, K)


def test_corners_of_two_boards_are_no_board(settings):
    board = Board("charuco", settings)
    detection = board.detect(photograph(board, settings, pose([0, 0, 0.36], [0, 0, 0]) @ FACING), K)
    pixels = detection.pixels.copy()
    pixels[::2] += [40, 0]
    with pytest.raises(DetectionError, match="do not lie on one board"):
        board.pose(dataclasses.replace(detection, pixels=pixels), K)


def test_views_are_reachable_in_view_apart_and_the_seeds(settings):
    planner = PosePlanner(settings, 5)
    views = planner.views(12)
    chosen = [next(views) for _ in range(12)]
    for view in chosen:
        assert planner.world.describe(view.joints) == ""
        corners = np.array([[x, y, 0, 1] for x in (-0.112, 0.112) for y in (-0.084, 0.084)])
        seen = corners @ (inverse(planner.T_base_camera) @ view.T_base_board).T
        pixels = seen[:, :2] / seen[:, 2:3] * 640 + K[:2, 2]
        assert np.all(pixels > 39) and np.all(pixels < [1240, 760])
        tilt = angle_between(view.T_base_board[:3, 2], [0, 0, 1])
        assert settings.tilt[0] - 1e-6 < tilt < settings.tilt[1] + 1e-6
    normals = [view.T_base_board[:3, 2] for view in chosen]
    assert max(angle_between(a, b) for a in normals for b in normals) > np.radians(40)
    again = PosePlanner(settings, 5).views(12)
    assert np.allclose([next(again).joints for _ in range(12)], [v.joints for v in chosen])
    other = PosePlanner(settings, 6).views(12)
    assert not np.allclose(next(other).joints, chosen[0].joints)
    order = tour(chosen, settings.start_joints)
    assert len(order) == 12 and {id(v) for v in order} == {id(v) for v in chosen}


def angle_between(a, b) -> float:
    return float(np.arccos(np.clip(np.dot(a, b), -1, 1)))


def test_the_whole_plate_counts_as_an_obstacle(settings):
    planner = PosePlanner(settings, 0)
    start = settings.start_joints
    assert planner.world.describe(start) == ""
    from iwgnet_grasp import _core

    low = np.array(_core.forward(start))
    low[2, 3] -= 0.13  # the plate's edge is 0.126 m above the table
    solutions = _core.inverse(low)
    assert any("held_part - table" in planner.world.describe(q) for q in solutions)


def test_motion_between_views_is_free_of_collision(settings):
    planner = PosePlanner(settings, 2)
    view = next(planner.views(4))
    trajectory = planner.motion(settings.start_joints, view.joints)
    assert np.allclose(trajectory.q[0], settings.start_joints)
    assert np.allclose(trajectory.q[-1], view.joints)
    assert np.abs(trajectory.qd).max() <= settings.max_velocity + 1e-9
    assert all(planner.world.describe(q) == "" for q in trajectory.q[::5])


def test_every_method_finds_the_camera_of_clean_pairs():
    samples, truth = simulated(10, (1e-12, 1e-12), np.random.default_rng(1))
    methods = compare(samples)
    names = [method.name for method in methods]
    assert names[:2] == ["ViSP", "ours, pairs"]
    assert [n.removeprefix("OpenCV ") for n in names[2:]] == [
        "Tsai", "Park", "Horaud", "Andreff", "Daniilidis", "Shah", "Li",
    ]  # fmt: skip
    for method in methods:
        move, turn = difference(method.T_base_camera, truth)
        assert move < 1e-7 and turn < 1e-7, method.name


def test_refinement_is_at_least_a_quarter_better_than_visp_on_noisy_pairs():
    random = np.random.default_rng(3)
    problems = [simulated(15, (5e-4, np.radians(0.1)), random) for _ in range(60)]
    answers = solve_with_visp([samples for samples, _ in problems])
    errors = np.array(
        [
            [difference(T, truth)[0], difference(solve(samples, T).T_base_camera, truth)[0]]
            for (samples, truth), (T, _) in zip(problems, answers, strict=True)
        ]
    )
    visp, ours = np.median(errors, axis=0)
    assert ours <= 0.75 * visp


def test_samples_that_cannot_be_solved_are_refused_with_the_reason():
    samples, _ = simulated(8, (1e-6, 1e-6), np.random.default_rng(2))
    three = dataclasses.replace(samples, samples=samples.samples[:3])
    with pytest.raises(CalibrationError, match="only 3 pairs"):
        solve(three)
    twice = dataclasses.replace(samples, samples=[*samples.samples, samples.samples[2]])
    with pytest.raises(CalibrationError, match="same robot pose"):
        solve(twice)


@pytest.fixture(scope="module")
def routine(settings):
    """Six poses on the simulated cell, with images."""
    lines = []
    return in_process.run(settings, 1, count=6, say=lines.append), lines


def test_a_routine_finds_the_mounting_error_of_the_camera(routine, settings):
    run, lines = routine
    planner = PosePlanner(settings, 1)
    assert difference(planner.T_base_camera, run.T_base_camera)[0] > 1e-3  # it is not nominal
    assert len(lines) == 6 and all("35 of 35 corners" in line for line in lines)
    calibration = solve(run.samples)
    assert calibration.method == "reprojection"
    move, turn = difference(calibration.T_base_camera, run.T_base_camera)
    assert move < 3e-4 and turn < np.radians(0.03)
    move, turn = difference(calibration.T_tool_target, run.T_tool_board)
    assert move < 3e-4 and turn < np.radians(0.05)
    # What it says of itself fits what is true of it.
    assert calibration.rms_px < 0.2
    assert calibration.leave_one_out[0] < 3e-4
    assert calibration.largest_rotation > np.radians(30)


def test_a_wrong_robot_pose_hardly_moves_the_result(routine):
    run, _ = routine
    clean = solve(run.samples)
    sample = run.samples.samples[3]
    wrong = dataclasses.replace(
        sample, T_base_tool=sample.T_base_tool @ pose([0.02, 0, 0], [0, 0.1, 0])
    )
    spoiled = solve(
        dataclasses.replace(
            run.samples, samples=[*run.samples.samples[:3], wrong, *run.samples.samples[4:]]
        )
    )
    assert spoiled.weights[3] < 0.1
    assert difference(spoiled.T_base_camera, clean.T_base_camera)[0] < 2e-4
    assert any("OUTLIER" in line for line in report.text(spoiled, run.samples))


def test_a_file_is_solved_again_to_the_same_result(routine, tmp_path):
    run, _ = routine
    calibration = solve(run.samples)
    path = tmp_path / "0.yaml"
    save(path, run.samples, report.as_dict(calibration))
    again = solve(load(path))
    move, turn = difference(again.T_base_camera, calibration.T_base_camera)
    assert move < 1e-7 and turn < 1e-7
    from iwgnet_grasp import _core

    read = np.array(_core.load_camera_pose(str(path)))  # as the grasping launch does
    assert difference(read, calibration.T_base_camera)[0] < 1e-12
    done = subprocess.run(
        [sys.executable, "-m", "iwgnet_grasp.cli", "calibrate", path, "--leave-out", "2"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    assert "T_base_camera = [" in done.stdout and "from 5 poses" in done.stdout
    assert "OpenCV Shah" in done.stdout


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: "", "is no calibration"),
        (lambda text: "a: [1", "not valid YAML"),
        (lambda text: "T_base_color: {}\n", "'samples' is missing"),
        (lambda text: text.replace("pixels", "pixles"), "'pixels' is missing"),
        (lambda text: text.replace("T_camera_target", "T_camera"), "'T_camera_target' is missing"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(change, said, routine, tmp_path):
    run, _ = routine
    path = tmp_path / "0.yaml"
    save(path, run.samples, report.as_dict(solve(run.samples)))
    path.write_text(change(path.read_text()))
    with pytest.raises(CalibrationError, match=said) as caught:
        load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_report_shows_equation_22_and_the_picture_all_images(routine, settings, tmp_path):
    run, _ = routine
    calibration = solve(run.samples)
    rows = report.equation_22(calibration.T_base_camera)
    numbers = [[float(v) for v in row.split("[")[1].strip(" ]").split()] for row in rows]
    assert np.allclose(numbers, calibration.T_base_camera, atol=1e-5)
    x, y = settings.print_size / 2
    outline = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    report.draw(calibration, run.samples, outline, tmp_path / "residuals.png")
    image = cv2.imread(str(tmp_path / "residuals.png"))
    assert image.shape[1] == 4 * 640 and image.shape[0] >= 2 * 400


def test_simulated_poses_scatter_as_stated(settings):
    run = in_process.run(settings, 2, count=5, source="simulated_poses")
    assert not run.samples.has_images and run.samples.noise == settings.simulated_noise
    for sample in run.samples.samples:
        expected = inverse(run.T_base_camera) @ sample.T_base_tool @ run.T_tool_board
        off = inverse(expected) @ sample.T_camera_target
        assert np.abs(off[:3, 3]).max() < 5 * settings.simulated_noise[0]
        assert 0 < angle(off[:3, :3]) < 8 * settings.simulated_noise[1]


def test_bad_settings_name_the_file_and_the_key(tmp_path):
    text = yaml.safe_load((ROOT / "config/calibration.yaml").read_text())
    del text["poses"]["tilt"]
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(text))
    with pytest.raises(CalibrationError, match="calibration.yaml: key 'tilt'"):
        load_settings(tmp_path)
