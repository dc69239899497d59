"""Trials in one process: the simulated cell, perception and planning without ROS.

    python -m iwgnet_grasp.trials.in_process --scene five_scattered --seed 0 --out DIR

The cell's clock stands still while perception and planning compute; trial.json tells that wall
time apart. The same seed gives the same trial to the bit.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from iwgnet_grasp.perception.types import CameraIntrinsics, GraspRectangle, Look, PerceptionError
from iwgnet_grasp.priority import PriorityConfig, Ranking, rank
from iwgnet_grasp.progress import interrupt_on
from iwgnet_grasp.supervisor import CellError, Outcome, Target, load_settings
from iwgnet_grasp.trials.lift import core_rectangle
from iwgnet_grasp.trials.record import Trial, judged_by, run_trial, summary_line

PACKAGE = Path(__file__).resolve().parents[3]


class Perceives(Protocol):
    """perception.Perception."""

    backends: dict[str, str]

    def look(self, color: np.ndarray, depth: np.ndarray, empty_depth: np.ndarray) -> Look: ...

    def without(self, look: Look, taken: Sequence[int]) -> Look: ...


@dataclass(frozen=True)
class Plan:
    """All that was made of one look, for pictures."""

    scene_id: int
    look: Look
    ranking: Ranking
    targets: list[Target]


class InProcessCell:
    """supervisor.Cell on the simulated cell. Raises CellError when the core cannot be loaded or a
    config is not usable."""

    def __init__(
        self,
        perception: Perceives,
        package_dir: Path = PACKAGE,
        config_dir: Path | None = None,
        T_base_color: np.ndarray | None = None,
    ) -> None:
        """T_base_color: (4, 4), where the planner believes the colour camera to be (a calibration);
        None: config_dir/camera.yaml's nominal pose."""
        core = _core()
        config_dir = config_dir or package_dir / "config"
        self._core = core
        self._perception = perception
        self.backends = perception.backends
        self.on_plan: Callable[[Plan], None] | None = None
        self._priority = PriorityConfig.load(config_dir / "priority.yaml")
        try:
            self.simulated = core.SimulatedCell(str(package_dir), str(config_dir))
            self._grasp_config = core.load_grasp_pose_config(str(config_dir))
            self._pick_config = core.load_pick_place_config(str(config_dir))
        except core.CoreError as error:
            raise CellError(str(error)) from None
        self._robot = core.SimulatedRobot(self.simulated)
        self._T_base_color = T_base_color
        self._empty_depth: np.ndarray | None = None
        self._scene_id = 0
        self._frames: tuple[np.ndarray, np.ndarray] | None = None
        self._seen: Look | None = None  # what perception made of them
        self._poses: dict[tuple[int, int], tuple[Any, np.ndarray]] = {}
        self._centroids: list[np.ndarray] = []  # of the objects of the newest plan, base_link

    def load(self, scene: str, seed: int) -> int:
        """Measures the bare table, then sets up the scene; returns the number of parts."""
        try:
            self.simulated.load_scene("", seed)
            self._empty_depth = self._depth()
            parts = self.simulated.load_scene(scene, seed)
        except self._core.CoreError as error:
            raise CellError(str(error)) from None
        self._pick_config.seed = seed
        self._pick_and_place = self._core.PickAndPlace(self.simulated.config, self._pick_config)
        self._scene_id = 0
        self._poses.clear()
        return parts

    def _depth(self) -> np.ndarray:
        return self.simulated.aligned_depth(self.simulated.depth())

    # supervisor.Cell

    def look(self) -> int:
        self._scene_id += 1
        self._frames = self.simulated.color(), self._depth()
        self._seen = None
        return self._scene_id

    def plan(
        self, scene_id: int, failed: Sequence[GraspRectangle], taken: Sequence[int] = ()
    ) -> list[Target]:
        if self._frames is None or self._empty_depth is None or scene_id != self._scene_id:
            raise CellError(f"look {scene_id} is not the newest; call look() before plan()")
        color, depth = self._frames
        try:
            if self._seen is None:
                self._seen = self._perception.look(color, depth, self._empty_depth)
            look = self._perception.without(self._seen, taken) if taken else self._seen
        except PerceptionError as error:
            raise CellError(str(error)) from None
        camera = self.simulated.config.camera
        if self._T_base_color is not None:
            camera.T_base_color = self._T_base_color
        k = camera.color
        intrinsics = CameraIntrinsics(k.fx, k.fy, k.cx, k.cy)
        seed = self._pick_config.seed, scene_id
        ranking = rank(look.objects, intrinsics, self._priority, failed, seed)
        heights = self._core.HeightMap(look.depth, k, camera.T_base_color, self.simulated.config)
        self._pick_and_place.set_heights(heights)
        self._poses, self._centroids = {}, []
        targets = [self._target(ranked, intrinsics, camera, heights) for ranked in ranking.objects]
        targets += [
            Target(scene_id, o.object_id, o.label, o.score, 0.0, None, False, reason)
            for o, reason in ranking.dropped
        ]
        if self.on_plan is not None and not taken:
            self.on_plan(Plan(scene_id, look, ranking, targets))
        return targets

    def _target(self, ranked, intrinsics, camera, heights) -> Target:
        candidate = ranked.object
        centroid = None
        if candidate.valid_pixels > 0:
            point = intrinsics.deproject(
                candidate.centroid_u_px, candidate.centroid_v_px, candidate.centroid_depth_m
            )
            centroid = camera.T_base_color[:3, :3] @ point + camera.T_base_color[:3, 3]
            self._centroids.append(centroid)
        pose = self._core.best_grasp_pose(
            [core_rectangle(self._core, grasp) for grasp in candidate.grasps],
            camera.color,
            camera.T_base_color,
            heights,
            self.simulated.config,
            self._grasp_config,
            centroid,
        )
        grasp = candidate.grasps[pose.candidate]
        if not pose.feasible or centroid is None:
            return self._as_target(ranked, grasp, False, ranked.reason or pose.reason)
        self._poses[self._scene_id, candidate.object_id] = pose, centroid
        return self._as_target(ranked, grasp, True, "", pose.quality)

    def _as_target(
        self, ranked, grasp: GraspRectangle, feasible: bool, reason: str, quality: float = 0.0
    ) -> Target:
        candidate = ranked.object
        return Target(
            self._scene_id,
            candidate.object_id,
            candidate.label,
            candidate.score,
            ranked.priority,
            grasp,
            feasible,
            reason,
            quality,
            candidate.covered_px,
        )

    def execute(self, target: Target, tray_slot: int) -> Outcome:
        try:
            pose, centroid = self._poses[target.scene_id, target.object_id]
        except KeyError:
            return Outcome(False, "unknown_grasp", "the target is not of the newest look")
        return self._came_back(self._pick_and_place.run(self._robot, pose, centroid, tray_slot))

    def push(self, scene_id: int) -> Outcome:
        return self._came_back(self._pick_and_place.push(self._robot, self._centroids))

    def _came_back(self, result: Any) -> Outcome:
        """What came of a motion, the arm being back at its observing pose."""
        reason = result.reason.name.lower()
        back = self._pick_and_place.observe(self._robot)
        if back.reason.name != "SUCCEEDED":
            raise CellError(f"the arm cannot return to its observing pose: {back.message}")
        done = reason == "succeeded"
        return Outcome(done, "" if done else reason, result.message)

    def time(self) -> float:
        return self.simulated.time

    @property
    def judge(self) -> Callable[[], dict]:
        return judged_by(self.simulated.verdict)


def load_calibration(path: str | Path) -> np.ndarray:
    """(4, 4) T_base_color of a calibration's result. Raises CellError."""
    core = _core()
    try:
        return core.load_camera_pose(str(path))
    except core.CoreError as error:
        raise CellError(str(error)) from None


def _core():
    try:
        from iwgnet_grasp import _core
    except ImportError as error:
        raise CellError(
            f"the C++ extension cannot be loaded ({error}); run scripts/setup, then source "
            "scripts/env.sh"
        ) from None
    return _core


def run(
    scene: str = "five_scattered",
    seed: int = 0,
    replan: str = "every",
    out: Path | None = None,
    *,
    perception: Perceives | None = None,
    say: Callable[[str], None] = print,
    cell: InProcessCell | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    config_dir: Path = PACKAGE / "config",
) -> Trial:
    """One trial; the perception of config_dir/perception.yaml unless another is given. A `cell`
    is used again, which saves its set-up. on_plan is told all that was made of each look. Raises
    CellError, PerceptionError or ValueError for arguments and files that cannot be used.
    """
    settings = load_settings(config_dir, replan=replan)
    if cell is None:
        if perception is None:
            from iwgnet_grasp.perception import load_perception

            perception = load_perception(config_dir / "perception.yaml")
        cell = InProcessCell(perception, config_dir=config_dir)
    cell.on_plan = on_plan
    cell.load(scene, seed)
    return run_trial(
        cell,
        settings,
        scene=scene,
        seed=seed,
        transport="in_process",
        backends=cell.backends,
        out=out,
        judge=cell.judge,
        say=say,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m iwgnet_grasp.trials.in_process",
        description="Clears a simulated table in one process. Exit status: 0 success by the "
        "judge, 1 the trial failed, 2 bad arguments.",
    )
    parser.add_argument("--scene", default="five_scattered", help="of config/scenes.yaml")
    parser.add_argument("--seed", type=int, default=0, help="of scene, noise and planner")
    parser.add_argument("--replan", choices=("once", "every"), default="every")
    parser.add_argument("--out", type=Path, help="folder for trial.json and pictures")
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error("--seed must not be negative")
    interrupt_on(signal.SIGTERM)
    pictures = None
    if options.out is not None:
        from iwgnet_grasp.trials.pictures import Pictures

        pictures = Pictures(options.out)
    try:
        trial = run(
            options.scene,
            options.seed,
            options.replan,
            options.out,
            on_plan=pictures.draw if pictures else None,
        )
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 1
    except (CellError, PerceptionError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    finally:
        if pictures:
            pictures.finish()
    print(summary_line(trial))
    return 0 if trial.success else 1


if __name__ == "__main__":
    sys.exit(main())
