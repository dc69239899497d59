"""The cycle that clears a table: observe, detect, estimate, prioritise, transform, execute, verify.

It knows no transport. A `Cell` does the work: over the ROS graph (trials.ros) or in one process
(trials.in_process). Ground truth never comes this way; that is the judge's alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import yaml

from iwgnet_grasp.perception.types import GraspRectangle

# Reasons of an Outcome that are found before the arm moves: nothing was attempted.
NOT_EXECUTED = ("infeasible", "unreachable", "no_plan")


@dataclass(frozen=True)
class Target:
    """One object of a sequence and the grasp that is to be tried on it."""

    scene_id: int  # look that it was seen in
    object_id: int  # index of the detection in that look
    label: str
    detection_score: float
    priority: float  # S* of Eq. 21
    grasp: GraspRectangle | None  # None: no candidate is left, never executed
    feasible: bool
    reason: str = ""  # why not feasible
    quality: float = 0.0  # of the grasp pose, [0, 1]: the network's, less what geometry takes off
    covered_px: int = 0  # of the object's border with one that lies on it


@dataclass(frozen=True)
class Outcome:
    """What the robot itself says about a pick (not the judge)."""

    success: bool
    reason: str = ""  # snake_case name of a PickPlace.action reason: missed, lost, no_plan, ...
    message: str = ""

    @property
    def executed(self) -> bool:
        return self.reason not in NOT_EXECUTED


class Cell(Protocol):
    """What the supervisor asks of a transport. Calls block; errors that end a trial are raised
    as CellError, errors of one grasp come back as an Outcome."""

    def look(self) -> int:
        """Takes one snapshot with the arm out of view; returns its scene id."""

    def plan(
        self, scene_id: int, failed: Sequence[GraspRectangle], taken: Sequence[int] = ()
    ) -> list[Target]:
        """Detects, estimates, prioritises and transforms: the objects of a look in the order in
        which they are to be grasped, each with its best feasible grasp that does not repeat one of
        `failed` (priority.yaml says what repeating is). Objects without any such grasp come with
        feasible=False. taken: ids of objects of this look that are thought away: the plan is for
        the table without them, the others lying as they did."""

    def execute(self, target: Target, tray_slot: int) -> Outcome:
        """Picks the object and puts it into the tray; the arm ends out of the camera's view."""

    def push(self, scene_id: int) -> Outcome:
        """Pushes some object of the newest look aside, so that the pile lies otherwise; the arm
        ends out of the camera's view. Nothing is gripped."""

    def time(self) -> float:
        """Seconds on the cell's clock."""


class CellError(RuntimeError):
    """The cell cannot go on; one line that says why and what to do."""


@dataclass(frozen=True)
class Settings:
    """config/supervisor.yaml."""

    replan: str  # once | every
    tray_slots: int
    max_attempts: int
    max_idle_looks: int
    min_quality: float
    max_covered_px: int
    push_below: float
    max_pushes: int

    def __post_init__(self) -> None:
        if self.replan not in ("once", "every"):
            raise ValueError(f"replan: '{self.replan}' is not one of once, every")
        for key in ("tray_slots", "max_attempts", "max_idle_looks"):
            value = getattr(self, key)
            if not (isinstance(value, int) and value > 0):
                raise ValueError(f"{key}: {value!r} is not a whole number above 0")
        for key in ("max_covered_px", "max_pushes"):
            value = getattr(self, key)
            if not (isinstance(value, int) and value >= 0):
                raise ValueError(f"{key}: {value!r} is not a whole number from 0")
        for key in ("min_quality", "push_below"):
            if not isinstance(getattr(self, key), int | float):
                raise ValueError(f"{key}: {getattr(self, key)!r} is not a number")


def load_settings(config_dir: str | Path, **changes: object) -> Settings:
    """Settings of config_dir/supervisor.yaml with `changes` on top. Raises ValueError."""
    path = Path(config_dir) / "supervisor.yaml"
    try:
        values = yaml.safe_load(path.read_text()) or {}
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: cannot be read: {error}".replace("\n", " ")) from error
    known = set(Settings.__dataclass_fields__)
    values = {**values, **changes}
    for key in values:
        if key not in known:
            raise ValueError(f"{path}: key '{key}' is unknown (known: {', '.join(sorted(known))})")
    for key in sorted(known - set(values)):
        raise ValueError(f"{path}: key '{key}' is missing")
    try:
        return Settings(**values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


@dataclass
class Attempt:
    """One pick, or what was set aside before it became one."""

    target: Target
    outcome: Outcome
    tray_slot: int
    start_time_s: float  # on the cell's clock
    end_time_s: float

    @property
    def executed(self) -> bool:
        return self.outcome.executed


@dataclass
class Cycle:
    """What the supervisor did and why it ended: cleared, nothing_graspable, sequence_done,
    attempts_used_up."""

    attempts: list[Attempt] = field(default_factory=list)
    set_aside: list[Attempt] = field(default_factory=list)  # no motion was found, nothing moved
    failed: list[GraspRectangle] = field(default_factory=list)
    looks: int = 0
    pushes: int = 0
    ended: str = ""


def pick_line(number: int, attempt: Attempt) -> str:
    """The line a person reads after each pick."""
    target, outcome = attempt.target, attempt.outcome
    grasp = target.grasp
    failed = "failed" if attempt.executed else "set aside"
    verdict = "picked" if outcome.success else f"{failed} ({outcome.reason})"
    note = f": {outcome.message}" if outcome.message and not outcome.success else ""
    return (
        f"pick {number:2d}  look {target.scene_id:2d} object {target.object_id:2d} {target.label}"
        f"  S* {target.priority:.2f}  Q {grasp.quality:.2f}"
        f"  at ({grasp.x_px:.0f}, {grasp.y_px:.0f}) px {math.degrees(grasp.theta_rad):+.0f} deg"
        f"  {attempt.end_time_s - attempt.start_time_s:.1f} s  {verdict}{note}"
    )


def execution_order(targets: Sequence[Target], settings: Settings) -> list[Target]:
    """The feasible targets in the order in which they are picked.

    Those with a good grasp come as given (by priority), then the doubtful ones, below min_quality,
    by descending quality. The paper's score does not see how good a grasp is, and a doubtful one
    often becomes good once what lies on or beside the object is gone.
    With replan=once objects that lie under others come after all that do not, least covered first:
    taken from beneath they would move what lies on them, and no look would show where to.
    """

    def key(target: Target) -> tuple[float, float]:
        covered = target.covered_px if settings.replan == "once" else 0
        return max(covered, settings.max_covered_px), -min(target.quality, settings.min_quality)

    return sorted((target for target in targets if target.feasible), key=key)


def clear_table(
    cell: Cell,
    settings: Settings,
    say: Callable[[str], None] = print,
    cycle: Cycle | None = None,
) -> Cycle:
    """Runs the cycle until nothing is detected any more, nothing is graspable or the attempts are
    used up. A grasp for which no motion is found is set aside before anything moves, and the next
    best of the same look is taken. Fills `cycle` as it goes, so that a caller keeps what was done
    when an exception (CellError, KeyboardInterrupt) ends it early."""
    cycle = Cycle() if cycle is None else cycle
    idle_looks = 0
    pushes = 0  # since the last pick
    slot = 0
    while True:
        scene_id = cell.look()
        cycle.looks += 1
        targets = cell.plan(scene_id, cycle.failed)
        graspable = execution_order(targets, settings)
        best = max((target.quality for target in graspable), default=0.0)
        may_push = settings.replan == "every" and pushes < settings.max_pushes
        if targets and best < settings.push_below and may_push:
            pushes += 1
            outcome = cell.push(scene_id)
            if outcome.executed:  # one that broke off may have moved the parts as well
                cycle.pushes += 1
                broke_off = "" if outcome.success else f"; it broke off: {outcome.message}"
                say(
                    f"push {cycle.pushes}: no grasp of look {scene_id} is better than "
                    f"Q {best:.2f}{broke_off}"
                )
                continue
        if not graspable:
            # Noise differs from look to look: an object may be seen, or be graspable, in the next.
            idle_looks += 1
            if not targets and (cycle.attempts or idle_looks >= settings.max_idle_looks):
                cycle.ended = "cleared"
                return cycle
            if idle_looks >= settings.max_idle_looks:
                for target in targets:
                    say(f"object {target.object_id} {target.label} left: {target.reason}")
                cycle.ended = "nothing_graspable"
                return cycle
            continue
        idle_looks = pushes = 0
        taken: list[int] = []  # with replan=once, of this look
        tried: set[int] = set()
        while graspable:
            target = graspable[0]
            start = cell.time()
            outcome = cell.execute(target, slot % settings.tray_slots)
            attempt = Attempt(target, outcome, slot, start, cell.time())
            (cycle.attempts if attempt.executed else cycle.set_aside).append(attempt)
            say(pick_line(len(cycle.attempts) + (not attempt.executed), attempt))
            if attempt.executed:
                tried.add(target.object_id)
            if outcome.success:
                slot += 1
                taken.append(target.object_id)
            else:
                cycle.failed.append(target.grasp)
            if len(cycle.attempts) + len(cycle.set_aside) >= settings.max_attempts:
                cycle.ended = "attempts_used_up"
                return cycle
            if settings.replan == "every" and attempt.executed:
                break
            targets = cell.plan(scene_id, cycle.failed, taken)
            left = [t for t in targets if t.object_id not in tried]
            graspable = execution_order(left, settings)
        if settings.replan == "once":
            cycle.ended = "sequence_done"
            return cycle
