"""Are the labels true? A sample of them is carried out in Bullet.

Labels come from geometry (grasping/antipodal.h). Here some of a set's scenes are made again from
their seed, and labels drawn at random are executed with friction, forces and the robot's own pick
and place (trials.lift), from the depth that the D455 measured there: just as the robot would do.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import OPENING, QUALITY, THETA, X, Y
from iwgnet_grasp.perception.types import GraspRectangle
from iwgnet_grasp.trials.lift import Lifter

if TYPE_CHECKING:
    from iwgnet_grasp.data.generate import Scene, SceneMaker

BINS = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)  # of quality, upper bound included
_STREAM = 1  # of the random numbers that choose the labels


def plan_check(scenes: int, looks: int, labels: int) -> tuple[list[int], int]:
    """(piles, labels a scene): piles spread over the set so that about `labels` are tried, in few
    piles, because a pile has to be made whole."""
    piles = -(-scenes // looks)
    count = min(piles, max(labels // (4 * looks), 1))
    chosen = [i * piles // count for i in range(count)]
    tried = sum(min(looks, scenes - pile * looks) for pile in chosen)
    return chosen, -(-labels // tried)


def check_pile(
    maker: SceneMaker, seed: int, pile: int, wanted: list[int], labels: int
) -> dict[int, list[dict]]:
    """Number -> lifts of each wanted scene of a pile: see check_scene()."""
    from iwgnet_grasp.data.generate import LOOKS

    # All looks first: a lift sets the cell's time back, and later looks would come out otherwise.
    scenes = list(maker.pile(seed, pile))
    lifter = Lifter(maker.cell)
    return {
        number: check_scene(lifter, scenes[number - pile * LOOKS], labels, [seed, number, _STREAM])
        for number in wanted
    }


def check_scene(lifter: Lifter, scene: Scene, labels: int, seed: list[int]) -> list[dict]:
    """Lifts `labels` of the scene's labels, drawn at random.

    An entry: object and grasp (line of its grasps.txt, from 0), quality, outcome (trials.lift.Lift)
    and slip. The parts are laid as they lay when the scene was taken.
    """
    from iwgnet_grasp.data.generate import crop

    cell = lifter.cell
    cell.lay_parts(scene.poses)
    cell.camera = scene.camera
    heights = lifter.heights(scene.stereo)
    places = []
    for o in scene.objects:
        window, rows = crop(scene, o)
        places += [(o, line, row, window) for line, row in enumerate(rows)]
    chosen = np.random.default_rng(seed).permutation(len(places))[:labels]
    lifts = []
    for i in np.sort(chosen):
        o, line, row, window = places[i]
        row[X], row[Y] = row[X] + window.x, row[Y] + window.y
        depth = float(scene.stereo[round(float(row[Y])), round(float(row[X]))])
        rectangle = GraspRectangle(
            float(row[X]), float(row[Y]), float(row[THETA]), float(row[OPENING]), 1.0, depth
        )
        pose = lifter.pose(rectangle, heights)
        centroid = scene.poses[o.part][:3, 3]
        lift = lifter.lift(pose, heights, o.part, centroid, scene.laid_away)
        lifts.append(
            {
                "object": o.part,
                "grasp": line,
                "quality": round(float(row[QUALITY]), 4),
                "outcome": lift.outcome,
                "slip_mm": round(lift.slip_mm, 2),
                "slip_deg": round(lift.slip_deg, 2),
            }
        )
    return lifts


def require_stored(out: Path, number: int, lifts: list[dict]) -> None:
    """DataError unless the labels that were lifted are those of the scene on disk."""
    folder = out / f"{number:06d}"
    for lift in lifts:
        try:
            lines = (folder / f"{lift['object']}_{number:06d}_quality.txt").read_text().split()
            same = abs(float(lines[lift["grasp"]]) - lift["quality"]) < 2e-4
        except (OSError, IndexError, ValueError):
            same = False
        if not same:
            raise DataError(
                f"{folder}: does not come out again as it is stored (made by another version?); "
                "make the set anew, or leave its labels unchecked with --lift-check 0"
            )


def summary(lifts: list[dict]) -> dict:
    """Agreement of labels and physics: share lifted, what became of the others, by quality."""
    bins = []
    for low, high in zip(BINS, BINS[1:], strict=False):
        tried = [lift for lift in lifts if low < lift["quality"] <= high]
        if tried:
            bins.append({"quality": [low, high], "labels": len(tried), "lifted": _share(tried)})
    return {
        "labels": len(lifts),
        "lifted": _share(lifts),
        "outcomes": dict(Counter(lift["outcome"] for lift in lifts).most_common()),
        "by_quality": bins,
    }


def as_text(report: dict) -> str:
    """The summary in a few lines."""
    lines = [
        f"lift check: {100 * report['lifted']:.1f} % of {report['labels']} labels lift in Bullet ("
        + ", ".join(f"{name} {count}" for name, count in report["outcomes"].items())
        + ")"
    ]
    for entry in report["by_quality"]:
        low, high = entry["quality"]
        lines.append(
            f"  quality {low:.1f}-{high:.1f}: {100 * entry['lifted']:5.1f} % of {entry['labels']}"
        )
    return "\n".join(lines)


def _share(lifts: list[dict]) -> float:
    return round(sum(lift["outcome"] == "lifted" for lift in lifts) / max(len(lifts), 1), 4)
