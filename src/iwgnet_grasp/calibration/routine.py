"""The routine: the arm shows the target to the camera in one pose after another, each gives a
sample. It knows no transport; a `Cell` moves the arm and looks, over ROS or in one process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from iwgnet_grasp.calibration.board import Board, DetectionError
from iwgnet_grasp.calibration.poses import PosePlanner, tour
from iwgnet_grasp.calibration.samples import Sample, SampleSet
from iwgnet_grasp.calibration.settings import CalibrationError, Settings, core

SOURCES = ("images", "simulated_poses")


@dataclass(frozen=True)
class Look:
    """What was measured while the arm stood still."""

    joints: np.ndarray  # (6,) rad
    image: np.ndarray | None = None  # (H, W, 3) RGB
    T_camera_target: np.ndarray | None = None  # (4, 4), of source simulated_poses


class Cell(Protocol):
    """Calls block. Errors that end the routine are raised."""

    def joints(self) -> np.ndarray:
        """(6,) rad, now."""

    def move(self, trajectory: Any) -> None:
        """Carries out a _core.Trajectory and waits until the arm stands still."""

    def look(self, source: str) -> Look:
        """Taken after the call, the arm at rest. Raises DetectionError if it was not."""

    def intrinsics(self) -> tuple[int, int, float, float, float, float]:
        """Of the colour camera: width, height, fx, fy, cx, cy in px."""


def collect(
    cell: Cell,
    planner: PosePlanner,
    board: Board,
    settings: Settings,
    count: int,
    source: str,
    origin: dict[str, Any],
    say: Callable[[str], None],
) -> SampleSet:
    """`count` samples. A pose that cannot be reached or used gives way to another; raises
    CalibrationError when there are too few.
    """
    width, height, fx, fy, cx, cy = intrinsics = cell.intrinsics()
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    start = cell.joints()
    views = planner.views(count)
    queue = tour([next(views) for _ in range(count)], start)
    samples: list[Sample] = []
    failures: list[str] = []
    here = start
    while len(samples) < count:
        if not queue:
            try:
                queue.append(next(views))
            except StopIteration:
                raise CalibrationError(
                    f"only {len(samples)} of {count} poses gave a sample; the last failed: "
                    f"{failures[-1]}"
                ) from None
        view = queue.pop(0)
        try:
            trajectory = planner.motion(here, view.joints)
        except CalibrationError as error:
            failures.append(str(error))
            continue
        cell.move(trajectory)
        here = view.joints
        try:
            sample = _sample(cell.look(source), board, settings, K)
        except DetectionError as error:
            failures.append(str(error))
            say(f"pose {len(samples) + 1:2d}  left out: {error}")
            if len(failures) > 2 * count:
                raise CalibrationError(
                    f"{len(failures)} poses gave no sample; the last: {error}"
                ) from None
            continue
        samples.append(sample)
        say(_line(len(samples), count, sample, board))
    try:
        cell.move(planner.motion(here, start))
    except CalibrationError as error:
        say(f"the arm stays at its last pose: {error}")
    noise = settings.noise if source == "images" else settings.simulated_noise
    return SampleSet(samples, intrinsics, noise, {**origin, "source": source})


def _sample(look: Look, board: Board, settings: Settings, K: np.ndarray) -> Sample:
    T_base_tool = np.array(core().forward(look.joints))
    if look.image is None:
        if look.T_camera_target is None:
            raise DetectionError("neither an image nor a pose of the target came")
        return Sample(look.joints, T_base_tool, look.T_camera_target)
    detection = board.detect(look.image, K)
    T_camera_target, _ = board.pose(detection, K)
    return Sample(
        look.joints, T_base_tool, T_camera_target, detection.corners, detection.pixels, look.image
    )


def _line(number: int, count: int, sample: Sample, board: Board) -> str:
    x, y, z = sample.T_camera_target[:3, 3]
    tilt = np.degrees(np.arccos(min(1.0, abs(sample.T_camera_target[2, 2]))))
    seen = (
        "" if sample.corners is None else f"  {len(sample.corners)} of {len(board.corners)} corners"
    )
    return (
        f"pose {number:2d} of {count}  target at ({x:+.3f}, {y:+.3f}, {z:.3f}) m of the camera, "
        f"tilted {tilt:2.0f} deg{seen}"
    )
