"""One grasp carried out open loop in the simulated cell: does it hold the part?

    lifter = Lifter()
    lifter.cell.load_scene("five_scattered", 0)      # or build_scene(...)
    heights = lifter.heights(depth)                  # of the scene, before the first lift
    lift = lifter.lift(lifter.pose(rectangle, heights), heights)

The grasp is executed as it is, with the robot's own pick and place, friction and forces: no second
look and no other candidate. The judge watches until the gripper is about to let go over the tray.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iwgnet_grasp.perception.types import GraspRectangle
from iwgnet_grasp.supervisor import NOT_EXECUTED

PACKAGE = Path(__file__).resolve().parents[3]
LIFTED = "lifted"


@dataclass(frozen=True)
class Lift:
    """What became of a grasp.

    outcome: "lifted"; not executed: "infeasible", "unreachable" or "no_plan"; else "missed" (the
    gripper closed on nothing), "dropped", "slipped" or "collided" (limits of config/judge.yaml),
    "wrong_part" or "execution_failed".
    """

    outcome: str
    part: int = -1  # index of the part that was held; -1: none
    slip_mm: float = 0.0  # of the part between the pads
    slip_deg: float = 0.0
    message: str = ""  # of pick and place, when it failed
    others_m: float = 0.0  # farthest that any other part was moved

    @property
    def lifted(self) -> bool:
        return self.outcome == LIFTED

    @property
    def executed(self) -> bool:
        return self.outcome not in NOT_EXECUTED


def core_rectangle(core: Any, grasp: GraspRectangle) -> Any:
    """The grasp as a _core.GraspRectangle."""
    return core.GraspRectangle(
        grasp.x_px, grasp.y_px, grasp.theta_rad, grasp.width_px, grasp.quality, grasp.depth_m
    )


class _OverTheTray(Exception):
    """Ends a pick whose part hangs over its slot: the lift is known."""


class Lifter:
    """Tries grasps on the scene that its cell holds; each lift leaves the scene as it was.

    `cell`: a _core.SimulatedCell to share; by default one of its own.
    """

    def __init__(
        self, cell: Any = None, package_dir: Path = PACKAGE, config_dir: Path | None = None
    ) -> None:
        from iwgnet_grasp import _core  # only here: training machines have no extension

        configs = str(config_dir or package_dir / "config")
        self._core = _core
        self.cell = cell or _core.SimulatedCell(str(package_dir), configs)
        self._robot = _core.SimulatedRobot(self.cell)
        self._pose_config = _core.load_grasp_pose_config(configs)
        self._pick_config = _core.load_pick_place_config(configs)
        self._laid: tuple[np.ndarray, np.ndarray] | None = None

    def heights(self, depth: np.ndarray) -> Any:
        """_core.HeightMap of what lies on the table. depth: (H, W) m of the cell's colour camera
        as it stands (SimulatedCell.ideal_depth() or aligned_depth())."""
        camera = self.cell.camera
        return self._core.HeightMap(depth, camera.color, camera.T_base_color, self.cell.config)

    def pose(self, grasp: GraspRectangle, heights: Any, centroid: np.ndarray | None = None) -> Any:
        """_core.GraspPose of a rectangle in the colour image, as the robot would compute it; with
        the object's centroid, (3,) m in base_link, the best of those beside it."""
        camera = self.cell.camera
        if centroid is not None:
            return self._core.best_grasp_pose(
                [core_rectangle(self._core, grasp)],
                camera.color,
                camera.T_base_color,
                heights,
                self.cell.config,
                self._pose_config,
                centroid,
            )
        return self._core.grasp_pose(
            core_rectangle(self._core, grasp),
            camera.color,
            camera.T_base_color,
            heights,
            self.cell.config,
            self._pose_config,
        )

    def lift(
        self,
        pose: Any,
        heights: Any,
        part: int | None = None,
        centroid: np.ndarray | None = None,
        tray_slot: int = 0,
    ) -> Lift:
        """Carries a _core.GraspPose out, then lays the parts back as they lay.

        part: index of the part that is meant; None: any. centroid: (3,) m, of the object in
        base_link, by which the tray slot is approached; the grasp point when None. The same scene
        and grasp give the same result to the bit.
        """
        cell, core = self.cell, self._core
        poses = self._scene()
        cell.lay_parts(poses)  # every lift starts alike, whatever was done with the cell before
        pick_and_place = core.PickAndPlace(cell.config, self._pick_config)
        pick_and_place.set_heights(heights)
        if centroid is None:
            centroid = pose.T_base_tcp[:3, 3]

        def phase(name: str) -> bool:
            if name == "release":  # it holds, or pick and place would have ended already
                raise _OverTheTray
            return True

        outcome = message = ""
        try:
            result = pick_and_place.run(self._robot, pose, centroid, tray_slot, phase)
        except _OverTheTray:
            pass
        else:
            outcome, message = result.reason.name.lower(), result.message
        verdict = json.loads(cell.verdict())
        moved = np.linalg.norm((cell.part_poses() - poses)[:, :3, 3], axis=1)
        cell.lay_parts(poses)
        self._laid = poses, cell.part_poses()
        lift = _lift(outcome, message, verdict, part)
        others = np.delete(moved, lift.part) if lift.part >= 0 else moved
        return replace(lift, others_m=float(others.max(initial=0.0)))

    def _scene(self) -> np.ndarray:
        """Poses of the parts; to the bit those of the first lift while nothing else moved them
        (reading poses back rounds them)."""
        poses = self.cell.part_poses()
        if self._laid is not None and np.array_equal(poses, self._laid[1]):
            return self._laid[0]
        return poses


def _lift(outcome: str, message: str, verdict: dict, part: int | None) -> Lift:
    """outcome: how pick and place ended, "" when the part hung over the tray."""
    picks = verdict["picks"]
    if outcome in NOT_EXECUTED or not picks:
        return Lift(outcome or "missed", message=message)
    pick = picks[0]  # a failed one may try to set the part down: what counts is the first grip
    reason = pick["reason"]
    if reason == "collided":
        outcome = reason
    elif outcome:  # missed, lost, execution_failed
        outcome = "dropped" if outcome == "lost" else outcome
    elif reason in ("missed", "dropped", "slipped"):
        outcome = reason
    else:  # not_in_tray: it still hangs over it
        outcome = LIFTED if part in (None, pick["part"]) else "wrong_part"
    return Lift(outcome, pick["part"], pick["slip_mm"], pick["slip_deg"], message)
