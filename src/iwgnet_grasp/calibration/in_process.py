"""The routine on the simulated cell in one process, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iwgnet_grasp.calibration.board import Board, DetectionError
from iwgnet_grasp.calibration.poses import PosePlanner
from iwgnet_grasp.calibration.routine import Look, collect
from iwgnet_grasp.calibration.samples import SampleSet
from iwgnet_grasp.calibration.settings import PACKAGE, Settings, core


class InProcessCell:
    """routine.Cell. Camera and rig hang off their nominal poses as `seed` draws."""

    def __init__(self, settings: Settings, board: Board, seed: int, package_dir: Path = PACKAGE):
        self._core = core()
        self._settings = settings
        self.simulated = self._core.SimulatedCell(str(package_dir), "")
        self.simulated.offset_camera(seed)
        self.simulated.hold_board(board.print(), seed)
        self.simulated.load_scene("", seed)
        self._robot = self._core.SimulatedRobot(self.simulated)
        self._looks = 0

    def joints(self) -> np.ndarray:
        return np.array(self.simulated.joints)

    def move(self, trajectory: Any) -> None:
        self._core.execute(self._robot, trajectory)
        s, cell = self._settings, self.simulated
        deadline = cell.time + s.settle_give_up
        still_since = cell.time
        while cell.time - still_since < s.settle_time and cell.time < deadline:
            cell.step()
            if np.abs(cell.joint_velocities).max() > s.settle_speed:
                still_since = cell.time

    def look(self, source: str) -> Look:
        if np.abs(self.simulated.joint_velocities).max() > self._settings.settle_speed:
            raise DetectionError("the arm does not come to rest")
        joints = self.joints()
        if source == "images":
            return Look(joints, np.array(self.simulated.color()))
        self._looks += 1
        return Look(joints, T_camera_target=np.array(self.simulated.measure_board(self._looks)))

    def intrinsics(self) -> tuple[int, int, float, float, float, float]:
        k = self.simulated.camera.color
        return k.width, k.height, k.fx, k.fy, k.cx, k.cy


@dataclass(frozen=True)
class Run:
    samples: SampleSet
    T_base_camera: np.ndarray  # the simulator's truth
    T_tool_board: np.ndarray


def run(
    settings: Settings,
    seed: int,
    count: int = 15,
    board_name: str = "charuco",
    source: str = "images",
    say: Callable[[str], None] = lambda line: None,
) -> Run:
    """Samples of one routine and the truth to judge them by. The same seed gives the same run."""
    board = Board(board_name, settings)
    cell = InProcessCell(settings, board, seed)
    planner = PosePlanner(settings, seed)
    origin = {"board": board_name, "seed": seed, "transport": "in_process"}
    samples = collect(cell, planner, board, settings, count, source, origin, say)
    return Run(
        samples,
        np.array(cell.simulated.camera.T_base_color),
        np.array(cell.simulated.T_tool_board),
    )
