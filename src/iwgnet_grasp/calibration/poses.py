"""Where to show the target: robot poses that are reachable, free of collision, with the whole board
in view, and as different from each other as can be had."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iwgnet_grasp.calibration.settings import (
    PACKAGE,
    CalibrationError,
    Settings,
    angle,
    core,
    inverse,
)

_DRAWS = 6000  # of board poses, at most
_CANDIDATES = 12  # usable poses to choose from, for each pose wanted
# What counts as far apart: poses differ by 1 along each of these.
_FAR_MOVE, _FAR_TURN, _FAR_TILT = 0.10, 0.8, 0.35  # m, rad, rad
_TURNING = np.array([1, 1, 0, 1, 1, 1])  # joints with more than one turn
_PIECES = 5  # capsules that cover the plate in collision checks
_OBSERVED = 5  # points a side of the print that nothing may hide


@dataclass(frozen=True)
class View:
    """A robot pose and the board pose that it should show, by the nominal transforms."""

    joints: np.ndarray  # (6,) rad
    T_base_board: np.ndarray  # (4, 4)


class PosePlanner:
    """Views and the motions between them, for a cell's nominal geometry. Draws from `seed`."""

    def __init__(self, settings: Settings, seed: int, config_dir: Path = PACKAGE / "config"):
        self._core = core()
        self._settings = settings
        self._cell = self._core.load_cell_config(str(config_dir))
        self._motion = self._core.load_pick_place_config(str(config_dir))
        self._motion.seed = seed
        self._random = np.random.default_rng(seed)
        self.T_base_camera = np.array(self._cell.camera.T_base_color)
        self.world = self._core.CollisionWorld(self._cell)
        self.world.set_gripper_gap(float(settings.plate_size[2]))
        self.world.set_attached(*self._plate())

    def _plate(self) -> tuple[list, float]:
        """The plate as capsules in the TCP frame, side by side along its long edge."""
        s = self._settings
        T_tcp_board = (
            inverse(np.array(self._core.T_tool0_tcp(float(s.plate_size[2])))) @ s.T_tool_board
        )
        width = s.plate_size[1] / _PIECES
        radius = 0.75 * width  # reaches over the edges of its strip
        half = s.plate_size[0] / 2 - 0.5 * radius
        segments = []
        for i in range(_PIECES):
            y = s.plate_center[1] - s.plate_size[1] / 2 + (i + 0.5) * width
            ends = [(T_tcp_board @ [x, y, s.plate_center[2], 1.0])[:3] for x in (-half, half)]
            segments.append(tuple(ends))
        return segments, radius

    def views(self, count: int) -> Iterator[View]:
        """The `count` views that lie farthest apart, then the rest, next best first.

        Raises CalibrationError when there are fewer than `count` usable ones.
        """
        usable: list[View] = []
        for _ in range(_DRAWS):
            view = self._draw()
            if view is not None:
                usable.append(view)
            if len(usable) >= _CANDIDATES * count:
                break
        if len(usable) < count:
            raise CalibrationError(
                f"only {len(usable)} of {_DRAWS} board poses can be reached in view of the camera, "
                f"{count} are wanted; widen 'poses' in calibration.yaml or ask for fewer"
            )
        left = list(range(1, len(usable)))
        distance = np.array([_distance(usable[0], view) for view in usable])
        yield usable[0]
        while left:
            best = max(left, key=lambda i: distance[i])
            left.remove(best)
            distance = np.minimum(distance, [_distance(usable[best], view) for view in usable])
            yield usable[best]

    def _draw(self) -> View | None:
        s, random = self._settings, self._random
        tilt, toward = random.uniform(*s.tilt), random.uniform(-np.pi, np.pi)
        turn = random.uniform(-np.pi, np.pi)
        T = np.eye(4)
        # Facing the camera, then tilted towards a side.
        T[:3, :3] = (
            self.T_base_camera[:3, :3]
            @ np.diag([1.0, -1.0, -1.0])
            @ _about("z", toward)
            @ _about("y", tilt)
            @ _about("z", turn - toward)
        )
        T[:3, 3] = random.uniform(s.board_min, s.board_max)
        points = self._print_points(T)
        if not self._in_view(points):
            return None
        start = s.start_joints
        for q in self._core.inverse(T @ inverse(s.T_tool_board)):
            # The turn nearest to the start, but for the elbow, which has only one.
            turns = np.round((start - q) / (2 * np.pi)) * _TURNING
            q = q + 2 * np.pi * turns
            if not self.world.collides(q) and not self._hidden(points, q):
                return View(q, T)
        return None

    def _print_points(self, T_base_board: np.ndarray) -> np.ndarray:
        """(n, 3) points all over the print, base_link."""
        half = self._settings.print_size / 2
        x, y = np.meshgrid(*(np.linspace(-h, h, _OBSERVED) for h in half))
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return points @ T_base_board[:3, :3].T + T_base_board[:3, 3]

    def _in_view(self, points: np.ndarray) -> bool:
        k, margin = self._cell.camera.color, self._settings.margin_px
        T = inverse(self.T_base_camera)
        seen = points @ T[:3, :3].T + T[:3, 3]
        u = k.fx * seen[:, 0] / seen[:, 2] + k.cx
        v = k.fy * seen[:, 1] / seen[:, 2] + k.cy
        inside = (u > margin) & (u < k.width - 1 - margin)
        return bool(np.all(inside & (v > margin) & (v < k.height - 1 - margin)))

    def _hidden(self, points: np.ndarray, q: np.ndarray) -> bool:
        """Whether a part of the arm comes between the camera and the print."""
        spheres = np.asarray(self.world.spheres(q))
        eye = self.T_base_camera[:3, 3]
        ray = points - eye
        to_center = spheres[None, :, :3] - eye
        along = np.einsum("ijk,ik->ij", to_center, ray) / np.sum(ray**2, axis=1)[:, None]
        nearest = np.clip(along, 0.0, 1.0)[:, :, None] * ray[:, None, :]
        far = np.linalg.norm(to_center - nearest, axis=2)
        return bool(np.any(far < spheres[None, :, 3]))

    def motion(self, start: np.ndarray, goal: np.ndarray) -> Any:
        """A collision-free _core.Trajectory. Raises CalibrationError when there is none."""
        s = self._settings
        try:
            return self._core.plan_motion(
                self.world, start, goal, self._motion, s.max_velocity, s.max_acceleration
            )
        except self._core.CoreError as error:
            raise CalibrationError(str(error)) from None


def tour(views: list[View], start: np.ndarray) -> list[View]:
    """The views in an order of short ways: always the nearest one next."""
    left, order, here = list(views), [], start
    while left:
        nearest = min(left, key=lambda view: float(np.abs(view.joints - here).max()))
        left = [view for view in left if view is not nearest]
        order.append(nearest)
        here = nearest.joints
    return order


def _distance(a: View, b: View) -> float:
    move = np.linalg.norm(a.T_base_board[:3, 3] - b.T_base_board[:3, 3]) / _FAR_MOVE
    turn = angle(a.T_base_board[:3, :3].T @ b.T_base_board[:3, :3]) / _FAR_TURN
    cosine = float(a.T_base_board[:3, 2] @ b.T_base_board[:3, 2])
    tilt = np.arccos(np.clip(cosine, -1.0, 1.0)) / _FAR_TILT
    return float(np.sqrt(move**2 + turn**2 + tilt**2))


def _about(axis: str, angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    if axis == "z":
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])
