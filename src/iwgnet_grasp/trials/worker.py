"""Runs single trials for a table: one worker, one trial at a time."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iwgnet_grasp.overrides import changed_config
from iwgnet_grasp.supervisor import CellError
from iwgnet_grasp.trials.pool import Worker
from iwgnet_grasp.trials.statistics import Record

if TYPE_CHECKING:
    from iwgnet_grasp.trials.in_process import Plan

PACKAGE = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Conditions:
    """What the trials of one table have in common."""

    replan: str = "every"  # once | every
    transport: str = "inprocess"  # inprocess | ros
    overrides: dict[str, Any] = field(default_factory=dict)  # FILE.KEY -> value
    calibration: str = ""  # file with the camera pose that the planner uses; '': the nominal one
    camera_offset: int = -1  # seed of what the camera's mounting is off by; -1: nothing


def make_worker(conditions: Conditions, log_dir: Path) -> Worker:
    """log_dir: for the logs of failed trials over ROS."""
    ros = conditions.transport == "ros"
    return RosWorker(conditions, log_dir) if ros else InProcessWorker(conditions)


class _Configured:
    def __init__(self, conditions: Conditions) -> None:
        self._conditions = conditions
        self._stack = contextlib.ExitStack()
        self._config_dir = self._stack.enter_context(
            changed_config(PACKAGE / "config", conditions.overrides)
        )

    def close(self) -> None:
        self._stack.close()

    def _finished(self, record: Record) -> Record:
        """The record with how far from its slot's centre each part came to rest (mm, level)."""
        from iwgnet_grasp import _core

        slots = _core.load_cell_config(str(self._config_dir)).tray_slots
        for pick in record["picks"]:
            pick["placement_mm"] = None
            if pick["success"] and pick.get("position") is not None:
                slot = slots[pick["tray_slot"] % len(slots)]
                off = math.hypot(pick["position"][0] - slot[0], pick["position"][1] - slot[1])
                pick["placement_mm"] = round(1e3 * off, 2)
        return record


class InProcessWorker(_Configured):
    """Keeps networks and cell loaded from trial to trial."""

    def __init__(self, conditions: Conditions) -> None:
        super().__init__(conditions)
        from iwgnet_grasp.perception import load_perception
        from iwgnet_grasp.perception.types import PerceptionError
        from iwgnet_grasp.trials.in_process import InProcessCell, load_calibration

        calibrated = load_calibration(conditions.calibration) if conditions.calibration else None
        folder = self._config_dir
        try:
            perception = load_perception(folder / "perception.yaml")
            self.cell = InProcessCell(perception, config_dir=folder, T_base_color=calibrated)
        except (CellError, PerceptionError) as error:
            # By the name of the user's file, not of the copy in which --set has changed it.
            raise CellError(str(error).replace(f"{folder}/", "config/")) from None
        if conditions.camera_offset >= 0:
            self.cell.simulated.offset_camera(conditions.camera_offset)

    def run(self, scene: str, seed: int, on_plan: Callable[[Plan], None] | None = None) -> Record:
        from iwgnet_grasp.trials import in_process

        trial = in_process.run(
            scene,
            seed,
            self._conditions.replan,
            cell=self.cell,
            on_plan=on_plan,
            say=lambda line: None,
            config_dir=self._config_dir,
        )
        return self._finished(trial.to_json())


class RosWorker(_Configured):
    """Each trial on a graph and a ROS master of its own, as scripts/start_grasping runs it."""

    def __init__(self, conditions: Conditions, log_dir: Path) -> None:
        super().__init__(conditions)
        self._log_dir = log_dir

    def run(self, scene: str, seed: int) -> Record:
        from iwgnet_grasp.ros.session import free_master_uri, stop_with_parent

        out = self._log_dir / f"{scene}_{seed}"
        command = [sys.executable, "-m", "iwgnet_grasp.ros.grasping"]
        command += ["--scene", scene, "--seed", str(seed), "--replan", self._conditions.replan]
        command += ["--driver", "simulation", "--real-time", "false"]
        command += ["--rviz", "false", "--record", "false"]
        command += ["--camera-offset", str(self._conditions.camera_offset)]
        command += ["--config-dir", str(self._config_dir), "--out", str(out), "--no-pictures"]
        if self._conditions.calibration:
            command += ["--calibration", self._conditions.calibration]
        process = subprocess.Popen(
            command,
            env={**os.environ, "ROS_MASTER_URI": free_master_uri()},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # ctrl-C comes to us alone
            preexec_fn=stop_with_parent,
        )
        try:
            _, said = process.communicate()
        except BaseException:
            process.send_signal(signal.SIGTERM)  # stops its graph in good order
            process.wait()
            raise
        try:
            record = json.loads((out / "trial.json").read_text())
        except (OSError, json.JSONDecodeError):
            last = said.strip().splitlines()[-1:] or [f"status {process.returncode}"]
            raise CellError(f"no trial over ROS: {last[0]}") from None
        if record["success"]:
            shutil.rmtree(out, ignore_errors=True)  # logs are for failed trials
        return self._finished(record)
