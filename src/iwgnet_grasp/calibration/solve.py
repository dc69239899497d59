"""From samples to T_base_camera: ViSP's closed form, then maximum likelihood; and, for comparison,
all that OpenCV offers."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from iwgnet_grasp.calibration.samples import SampleSet
from iwgnet_grasp.calibration.settings import CalibrationError, core, inverse

_OPENCV_HAND_EYE = ("Tsai", "Park", "Horaud", "Andreff", "Daniilidis")
_OPENCV_ROBOT_WORLD = ("Shah", "Li")


@dataclass(frozen=True)
class Calibration:
    """T_base_camera (4, 4) and all that a person needs to judge it. SI units."""

    T_base_camera: np.ndarray
    T_tool_target: np.ndarray
    method: str  # reprojection (all corners of all images) or pairs
    T_visp: np.ndarray  # T_base_camera as ViSP alone gives it
    T_pairs: np.ndarray  # as the maximum likelihood over the pairs gives it
    translation_residuals: np.ndarray  # (n,) of the final transforms
    rotation_residuals: np.ndarray  # (n,)
    view_rms_px: np.ndarray | None  # (n,), of one coordinate
    rms_px: float | None
    weights: np.ndarray  # (n,) 1 trusted .. 0 outlier
    axxb: tuple[float, float]  # RMS of AX = XB, trusted pairs: m, rad
    leave_one_out: tuple[float, float]  # largest change without one pair: m, rad
    largest_rotation: float
    axis_spread: float
    sigma: tuple[float, float]  # one standard deviation along the worst axis: m, rad


def solve(samples: SampleSet, T_visp: np.ndarray | None = None) -> Calibration:
    """ViSP's solution (made here unless given), refined over all pairs and, where the samples hold
    corners, over all images. Raises CalibrationError with the reason when there is none.
    """
    _core = core()
    T_base_tool, T_camera_target = samples.T_base_tool, samples.T_camera_target
    refusal = _core.refuse_pairs(T_base_tool, T_camera_target)
    if refusal:
        raise CalibrationError(refusal)
    if T_visp is None:
        solution, _ = solve_with_visp([samples])[0]
        if isinstance(solution, str):
            raise CalibrationError(solution)
        T_visp = solution
    noise = _core.PoseNoise(*samples.noise)
    pairs = _core.refine_hand_eye(T_base_tool, T_camera_target, T_visp, noise)
    if not pairs.success:
        raise CalibrationError(pairs.reason)
    final, rms_px, view_rms_px = pairs, None, None
    if samples.has_images:
        views, camera = samples.views, samples.camera
        final = _core.refine_reprojection(views, camera, pairs.T_base_camera, pairs.T_tool_target)
        if not final.success:
            raise CalibrationError(final.reason)
        rms_px, view_rms_px = final.rms_px, np.array(final.view_rms_px)
        spread = _core.leave_one_view_out_spread(views, camera, final)
    else:
        spread = _core.leave_one_out_spread(T_base_tool, T_camera_target, pairs, noise)
    weights = np.array(final.weights)
    trusted = np.flatnonzero(weights > 0.1)
    residuals = _core.evaluate_hand_eye(
        T_base_tool, T_camera_target, final.T_base_camera, final.T_tool_target
    )
    largest, axis_spread = _core.rotation_diversity(T_base_tool)
    covariance = np.array(final.covariance)
    return Calibration(
        T_base_camera=np.array(final.T_base_camera),
        T_tool_target=np.array(final.T_tool_target),
        method="reprojection" if samples.has_images else "pairs",
        T_visp=np.array(T_visp),
        T_pairs=np.array(pairs.T_base_camera),
        translation_residuals=np.array(residuals.translation_residuals),
        rotation_residuals=np.array(residuals.rotation_residuals),
        view_rms_px=view_rms_px,
        rms_px=rms_px,
        weights=weights,
        axxb=_core.axxb_rms(
            [T_base_tool[i] for i in trusted],
            [T_camera_target[i] for i in trusted],
            final.T_base_camera,
        ),
        leave_one_out=spread,
        largest_rotation=largest,
        axis_spread=axis_spread,
        sigma=(
            float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]).max())),
            float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]).max())),
        ),
    )


def solve_with_visp(problems: Sequence[SampleSet]) -> list[tuple[np.ndarray | str, float]]:
    """ViSP's T_base_camera of each problem, or its reason not to give one; and its time in ms.

    By the program visp_hand_eye: ViSP is under the GPL and nothing here may link it. Raises
    CalibrationError where it is not built.
    """
    # Executables lie beside the extension's lib/python3/dist-packages.
    program = Path(core().__file__).parents[3] / "iwgnet_grasp" / "visp_hand_eye"
    lines = []
    for problem in problems:
        lines.append(str(len(problem.samples)))
        for sample in problem.samples:
            numbers = np.concatenate(
                [sample.T_base_tool[:3].ravel(), sample.T_camera_target[:3].ravel()]
            )
            lines.append(" ".join(f"{number:.17g}" for number in numbers))
    try:
        run = subprocess.run(
            [program], input="\n".join(lines) + "\n", capture_output=True, text=True, check=True
        )
    except OSError as error:
        raise CalibrationError(f"{program}: {error.strerror}; run scripts/setup") from None
    except subprocess.CalledProcessError as error:
        raise CalibrationError(f"visp_hand_eye: {error.stderr.strip()}") from None
    answers: list[tuple[np.ndarray | str, float]] = []
    for line in run.stdout.splitlines():
        word, _, rest = line.partition(" ")
        if word == "OK":
            *numbers, milliseconds = map(float, rest.split())
            T = np.eye(4)
            T[:3] = np.reshape(numbers, (3, 4))
            answers.append((T, milliseconds))
        elif word == "REFUSED":
            answers.append((rest, np.nan))
    return answers


@dataclass(frozen=True)
class Method:
    name: str
    T_base_camera: np.ndarray | None  # None: it gave none
    milliseconds: float


def compare(samples: SampleSet, visp: tuple[np.ndarray | str, float] | None = None) -> list[Method]:
    """T_base_camera of the same samples by ViSP (made here unless given), ours, OpenCV's five
    hand-eye and two robot-world methods.
    """
    _core = core()
    solution, milliseconds = visp or solve_with_visp([samples])[0]
    T_visp = None if isinstance(solution, str) else solution
    methods = [Method("ViSP", T_visp, milliseconds)]
    if T_visp is not None:
        noise = _core.PoseNoise(*samples.noise)
        poses = samples.T_base_tool, samples.T_camera_target
        methods.append(_timed("ours, pairs", lambda: _core.refine_hand_eye(*poses, T_visp, noise)))
        if samples.has_images:
            views, camera = samples.views, samples.camera
            Y = _core.mean_tool_target(*poses, T_visp)
            methods.append(
                _timed("ours, images", lambda: _core.refine_reprojection(views, camera, T_visp, Y))
            )
    for name in _OPENCV_HAND_EYE:
        methods.append(_timed(f"OpenCV {name}", lambda name=name: _hand_eye(samples, name)))
    for name in _OPENCV_ROBOT_WORLD:
        methods.append(_timed(f"OpenCV {name}", lambda name=name: _robot_world(samples, name)))
    return methods


def _timed(name: str, body: Callable[[], Any]) -> Method:
    start = time.perf_counter()
    try:
        result = body()
    except cv2.error:
        return Method(name, None, np.nan)
    milliseconds = (time.perf_counter() - start) * 1e3
    if not isinstance(result, np.ndarray):
        result = np.array(result.T_base_camera) if result.success else None
    if result is not None and not np.all(np.isfinite(result)):
        result = None
    return Method(name, result, milliseconds)


def _hand_eye(samples: SampleSet, name: str) -> np.ndarray:
    """cv2.calibrateHandEye solves for a camera on the gripper: with the robot's poses inverted, the
    camera in the room is the same problem.
    """
    tool_base = [inverse(T) for T in samples.T_base_tool]
    R, t = cv2.calibrateHandEye(
        [T[:3, :3] for T in tool_base],
        [T[:3, 3] for T in tool_base],
        [T[:3, :3] for T in samples.T_camera_target],
        [T[:3, 3] for T in samples.T_camera_target],
        method=getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}"),
    )
    return _pose(R, t)


def _robot_world(samples: SampleSet, name: str) -> np.ndarray:
    """cv2.calibrateRobotWorldHandEye: T_cam_world T_world_base = T_cam_gripper T_gripper_base.

    Ours, T_camera_target T_target_tool = T_camera_base T_base_tool, has the same form.
    """
    _, _, R_camera_base, t_camera_base = cv2.calibrateRobotWorldHandEye(
        [T[:3, :3] for T in samples.T_camera_target],
        [T[:3, 3] for T in samples.T_camera_target],
        [T[:3, :3] for T in samples.T_base_tool],
        [T[:3, 3] for T in samples.T_base_tool],
        method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}"),
    )
    return inverse(_pose(R_camera_base, t_camera_base))


def _pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.ravel(t)
    return T
