"""One trial: the supervisor's cycle on a cell, the judge's verdict, and trial.json."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from iwgnet_grasp.supervisor import Attempt, Cell, CellError, Cycle, Settings, clear_table

Verdict = dict  # physics/judge.h's Verdict as JSON: success, parts, in_tray, ..., picks, collisions


@dataclass
class Trial:
    """What trial.json holds. A trial without a judge (a real cell) goes by what the robot says."""

    scene: str
    seed: int
    replan: str
    transport: str  # ros | in_process
    backends: dict[str, str] = field(default_factory=dict)  # library by network, where known
    cycle: Cycle = field(default_factory=Cycle)
    verdict: Verdict | None = None
    sim_time_s: float = 0.0
    wall_time_s: float = 0.0
    computing_time_s: float = 0.0  # wall time of looking and planning, part of wall_time_s
    error: str = ""

    @property
    def success(self) -> bool:
        if self.error:
            return False
        if self.verdict is not None:
            return bool(self.verdict["success"])
        picks = self.cycle.attempts
        return (
            self.cycle.ended in ("cleared", "sequence_done")
            and bool(picks)
            and all(pick.outcome.success for pick in picks)
        )

    def to_json(self) -> dict:
        verdict = self.verdict or {}
        return {
            "scene": self.scene,
            "seed": self.seed,
            "replan": self.replan,
            "transport": self.transport,
            "backends": self.backends,
            "success": self.success,
            "objects": verdict.get("parts"),
            "in_tray": verdict.get("in_tray"),
            "on_table": verdict.get("on_table"),
            "lost": verdict.get("lost"),
            "collisions": verdict.get("collisions", []),
            "picks": [pick_entry(a, self.verdict) for a in self.cycle.attempts],
            "set_aside": [pick_entry(a, None) for a in self.cycle.set_aside],
            "looks": self.cycle.looks,
            "pushes": self.cycle.pushes,
            "ended": "error" if self.error else self.cycle.ended,
            "error": self.error,
            "sim_time_s": round(self.sim_time_s, 3),
            "wall_time_s": round(self.wall_time_s, 3),
            "computing_time_s": round(self.computing_time_s, 3),
        }


def pick_entry(attempt: Attempt, verdict: Verdict | None) -> dict:
    """A pick as trial.json tells it: the judge's word where there is one, else the robot's."""
    target, outcome = attempt.target, attempt.outcome
    entry = {
        "object": target.object_id,
        "success": outcome.success,
        "reason": outcome.reason,
        "slip_mm": None,
        "slip_deg": None,
        "part": None,
        "position": None,
        "grip_time_s": None,
        "tray_slot": attempt.tray_slot,
        "look": target.scene_id,
        "label": target.label,
        "message": outcome.message,
        "priority": round(target.priority, 4),
        "grasp": {
            "x_px": round(target.grasp.x_px, 2),
            "y_px": round(target.grasp.y_px, 2),
            "theta_rad": round(target.grasp.theta_rad, 4),
            "width_px": round(target.grasp.width_px, 2),
            "quality": round(target.grasp.quality, 4),
        },
        "start_time_s": round(attempt.start_time_s, 3),
        "end_time_s": round(attempt.end_time_s, 3),
    }
    judged = [
        pick
        for pick in (verdict or {}).get("picks", [])
        if attempt.start_time_s <= pick["grip_time"] <= attempt.end_time_s
    ]
    if judged:
        # A pick that the judge saw fail does not become one because of a second grip in its time.
        worst = min(judged, key=lambda pick: pick["success"])
        entry["success"] = bool(worst["success"]) and outcome.success
        entry["reason"] = worst["reason"] or outcome.reason
        entry["slip_mm"] = round(max(pick["slip_mm"] for pick in judged), 3)
        entry["slip_deg"] = round(max(pick["slip_deg"] for pick in judged), 3)
        entry["part"] = worst["part"] if worst["part"] >= 0 else None
        entry["position"] = worst.get("position")
        entry["grip_time_s"] = round(worst["grip_time"], 3)
    return entry


def judged_by(verdict_json: Callable[[], str]) -> Callable[[], Verdict]:
    """The judge's JSON as a dict. CellError when it is not one."""

    def judge() -> Verdict:
        try:
            return json.loads(verdict_json())
        except json.JSONDecodeError as error:
            raise CellError(f"the judge's verdict is not JSON: {error}") from None

    return judge


def write_json(path: Path, value: object) -> None:
    """Writes a JSON file in one step: a reader sees the old file or the new one, never half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    try:
        with os.fdopen(handle, "w") as file:
            json.dump(value, file, indent=2, allow_nan=False)
            file.write("\n")
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


class _Timed:
    """The cell, with the wall time spent on looking and planning counted."""

    def __init__(self, cell: Cell, trial: Trial):
        self._cell, self._trial = cell, trial

    def _count(self, call, *arguments):
        start = time.monotonic()
        try:
            return call(*arguments)
        finally:
            self._trial.computing_time_s += time.monotonic() - start

    def look(self):
        return self._count(self._cell.look)

    def plan(self, scene_id, failed, taken=()):
        return self._count(self._cell.plan, scene_id, failed, taken)

    def execute(self, target, tray_slot):
        return self._cell.execute(target, tray_slot)

    def push(self, scene_id):
        return self._cell.push(scene_id)

    def time(self):
        return self._cell.time()


def run_trial(
    cell: Cell,
    settings: Settings,
    *,
    scene: str,
    seed: int,
    transport: str,
    backends: dict[str, str] | None = None,
    out: Path | None = None,
    judge: Callable[[], Verdict] | None = None,
    say: Callable[[str], None] = print,
) -> Trial:
    """Runs a trial to its end. out/trial.json is brought up to date after each pick and at the
    end, also when the trial breaks off: CellError ends in Trial.error, KeyboardInterrupt is
    raised again after the file is written."""
    trial = Trial(scene, seed, settings.replan, transport, backends or {})
    trial.cycle.ended = "running"
    wall_start = time.monotonic()
    sim_start = math.nan

    def save() -> None:
        trial.wall_time_s = time.monotonic() - wall_start
        try:
            if math.isfinite(sim_start):
                trial.sim_time_s = cell.time() - sim_start
            if judge is not None:
                trial.verdict = judge()
        except CellError as error:  # the verdict of the last save stays
            trial.error = trial.error or str(error)
        if out is not None:
            write_json(out / "trial.json", trial.to_json())

    def after_pick(line: str) -> None:
        say(line)
        save()

    try:
        sim_start = cell.time()
        clear_table(_Timed(cell, trial), settings, after_pick, trial.cycle)
    except CellError as error:
        trial.error = str(error)
    except KeyboardInterrupt:
        trial.error = "interrupted"
        raise
    finally:
        save()
    return trial


def summary_line(trial: Trial) -> str:
    """The last line of a trial."""
    entries = trial.to_json()
    picked = sum(entry["success"] for entry in entries["picks"])
    parts = entries["objects"]
    where = f", {entries['in_tray']} of {parts} in the tray" if parts is not None else ""
    why = f": {trial.error}" if trial.error else ""
    for collision in entries["collisions"][:3]:
        why += f"; collision {collision}"
    return (
        f"{'SUCCESS' if trial.success else 'FAILED'}  {trial.scene} seed {trial.seed}"
        f"  {picked} of {len(entries['picks'])} picks good{where}"
        f"  {trial.sim_time_s:.1f} s simulated, {trial.wall_time_s:.1f} s wall"
        f" ({entries['ended']}{why})"
    )
