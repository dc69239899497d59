"""One trial again, by scene and seed, with all that is needed to look at it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from iwgnet_grasp.report.film import FilmCamera, Frame, write_gif
from iwgnet_grasp.report.pictures import write_png
from iwgnet_grasp.report.strip import trial_strip
from iwgnet_grasp.trials.in_process import Plan
from iwgnet_grasp.trials.pictures import Pictures
from iwgnet_grasp.trials.record import write_json
from iwgnet_grasp.trials.statistics import Record, causes
from iwgnet_grasp.trials.worker import Conditions, InProcessWorker

# What a second run of the same trial may differ in: time of the wall, and where and by what it ran.
_MAY_DIFFER = ("wall_time_s", "computing_time_s", "commit", "backends", "transport")


@dataclass
class Replay:
    """A trial with what was made of each look and a film of it."""

    record: Record
    plans: list[Plan] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)

    def captions(self) -> list[str]:
        """What happens in each frame: the pick under way and, when it is over, its end."""
        picks = self.record["picks"]
        lines = []
        for frame in self.frames:
            begun = [i for i, p in enumerate(picks) if p["start_time_s"] <= frame.time_s]
            if not begun:
                lines.append("")
                continue
            i = begun[-1]
            pick = picks[i]
            text = f"pick {i + 1} of {len(picks)}   S* {pick['priority']:.2f}"
            text += f"   Q {pick['grasp']['quality']:.2f}   {frame.time_s:5.1f} s"
            if not pick["success"] and frame.time_s > (pick["grip_time_s"] or 0.0):
                text += f"   {pick['reason']}"
            lines.append(text)
        if lines and self.record["success"]:
            lines[-1] += f"   all {self.record['in_tray']} in the tray"
        elif lines:
            lines[-1] += f"   failed: {', '.join(causes(self.record))}"
        return lines


def replay(conditions: Conditions, scene: str, seed: int, film: bool = True) -> Replay:
    """Runs a trial in process and keeps its looks and, unless not wanted, its film. The same
    conditions, scene and seed give the trial of the table again."""
    worker = InProcessWorker(conditions)
    plans: list[Plan] = []
    try:
        if not film:
            return Replay(worker.run(scene, seed, plans.append), plans)
        with FilmCamera(worker.cell.simulated) as camera:
            record = worker.run(scene, seed, plans.append)
        return Replay(record, plans, camera.frames)
    finally:
        worker.close()


def write_replay(result: Replay, out: Path, frames: bool = False) -> list[Path]:
    """trial.json, the pictures of each look, strip.png and film.gif; frames: each as a PNG, too.
    Returns the paths of the strip and of the film."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "trial.json", result.record)
    pictures = Pictures(out)
    for plan in result.plans:
        pictures.draw(plan)
    pictures.finish()
    paths = [write_png(out / "strip.png", trial_strip(result.record, result.plans, result.frames))]
    if result.frames:
        paths.append(out / "film.gif")
        write_gif(paths[-1], result.frames, result.captions())
    if frames:
        folder = out / "frames"
        folder.mkdir(exist_ok=True)
        for frame in result.frames:
            write_png(folder / f"{frame.time_s:07.3f}.png", frame.image)
    return paths


def differences(first: Record, second: Record) -> list[str]:
    """Keys in which two records of one trial differ that are to be the same."""
    keys = sorted((first.keys() | second.keys()) - set(_MAY_DIFFER))
    return [key for key in keys if first.get(key) != second.get(key)]
