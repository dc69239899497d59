"""What many trials say: rates with their intervals, causes of failure, speed."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence

Record = dict  # a line of trials.jsonl: Trial.to_json() and what batch.py adds to it

# Trials of the paper that succeeded, of 50 (its section 4.3).
PAPER_TRIALS = 50
PAPER_SUCCESSES = {"five_scattered": 50, "seven_stacked": 46, "ten_stacked": 43}

# Order of the columns; what else a record says (a broken graph, a lost part) follows them.
CAUSES = (
    "missed",
    "slipped",
    "dropped",
    "collided",
    "not detected",
    "no grasp",
    "no plan",
    "unreachable",
)
_CAUSE_OF_REASON = {
    "not_in_tray": "dropped",  # released, but it came to rest elsewhere
    "lost": "dropped",
    "infeasible": "no grasp",
    "unknown_grasp": "no grasp",
    "no_plan": "no plan",
    "execution_failed": "execution failed",
}


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a rate (Wilson 1927); z = 1.96: 95 %. (0, 1) without a trial."""
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    spread = z * z / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z * math.sqrt(rate * (1 - rate) / trials + spread / (4 * trials)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def _cause(reason: str) -> str:
    return _CAUSE_OF_REASON.get(reason, reason)


def causes(record: Record) -> list[str]:
    """Why a trial failed, in order of time; empty for a successful one."""
    if record["success"]:
        return []
    found = [_cause(pick["reason"]) for pick in record["picks"] if not pick["success"]]
    if record["collisions"] and "collided" not in found:
        found.append("collided")  # outside of a pick
    if record["error"]:
        found.append("error")
    if record["lost"]:
        found.append("knocked away")
    if record["on_table"] and record["ended"] == "cleared":
        found.append("not detected")
    set_aside = record.get("set_aside")  # no motion was found for them
    if record["on_table"] and set_aside and not found:
        found.append(_cause(set_aside[-1]["reason"]))
    elif record["on_table"] and record["ended"] == "nothing_graspable":
        found.append("no grasp")
    if record["on_table"] and not found:  # one look and one sequence did not hold every object
        found.append("not detected")
    return found or ["second attempt"]


def summarise(records: Sequence[Record]) -> dict:
    """Figures of one scene's trials (or of all): counts, rates, intervals, speed, errors."""
    trials = len(records)
    successes = sum(record["success"] for record in records)
    picks = [pick for record in records for pick in record["picks"]]
    good = [pick for pick in picks if pick["success"]]
    objects = sum(record["objects"] or 0 for record in records)
    simulated = sum(record["sim_time_s"] for record in records)
    computing = sum(record["computing_time_s"] for record in records)
    # In process the cell's clock stands still while perception and planning compute; over ROS it
    # goes on, and simulated time holds what they take.
    working = sum(
        record["sim_time_s"] + (record["transport"] != "ros") * record["computing_time_s"]
        for record in records
    )
    wall = sum(record["wall_time_s"] for record in records)
    failures = [causes(record) for record in records if not record["success"]]
    return {
        "trials": trials,
        "successes": successes,
        "success_rate": _ratio(successes, trials),
        "interval_95": list(wilson_interval(successes, trials)),
        "attempts": len(picks),
        "good_attempts": len(good),
        "pushes": sum(record.get("pushes", 0) for record in records),
        "set_aside": sum(len(record.get("set_aside", [])) for record in records),
        "gsr": _ratio(len(good), len(picks)),
        "gsr_interval_95": list(wilson_interval(len(good), len(picks))),
        "objects": objects,
        "cleared": _ratio(sum(record["in_tray"] or 0 for record in records), objects),
        "picks_per_hour": _ratio(3600 * len(good), working),
        "slip_mm": _spread([p["slip_mm"] for p in good if p["slip_mm"] is not None]),
        "slip_deg": _spread([p["slip_deg"] for p in good if p["slip_deg"] is not None]),
        "placement_mm": _spread(
            [p["placement_mm"] for p in good if p.get("placement_mm") is not None]
        ),
        "sim_time_s": round(simulated, 3),
        "computing_time_s": round(computing, 3),
        "wall_time_s": round(wall, 3),
        "times_real": _ratio(simulated, wall),
        # Each failed trial once, by what failed first; and every failed pick.
        "failed_trials_by_cause": dict(Counter(reasons[0] for reasons in failures)),
        "failures_by_cause": dict(Counter(reason for reasons in failures for reason in reasons)),
        "failed_seeds": {
            str(record["seed"]): causes(record) for record in records if not record["success"]
        },
    }


def summary(records: Sequence[Record], scenes: Sequence[str]) -> dict:
    """By scene, over all trials, and the mean of the scenes' success rates."""
    by_scene = {
        scene: summarise([record for record in records if record["scene"] == scene])
        for scene in scenes
    }
    rates = [s["success_rate"] for s in by_scene.values() if s["trials"]]
    return {
        "scenes": by_scene,
        "all": summarise(records),
        "average_success_rate": statistics.fmean(rates) if rates else None,
        "commits": sorted({record.get("commit", "") for record in records} - {""}),
    }


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _spread(values: Sequence[float]) -> dict | None:
    if not values:
        return None
    ordered = sorted(values)
    return {
        "median": round(statistics.median(ordered), 3),
        "p95": round(ordered[math.ceil(0.95 * len(ordered)) - 1], 3),
        "max": round(ordered[-1], 3),
    }
