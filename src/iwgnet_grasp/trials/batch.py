"""A run of trials in a folder: what its conditions are, which trials are done, what they say.

The folder holds settings.json, trials.jsonl (a line a trial, flushed as the trial ends) and
summary.json. The same settings go on where a killed run stopped; others are refused.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import yaml

from iwgnet_grasp.files import sole_writer
from iwgnet_grasp.overrides import changed_config
from iwgnet_grasp.trials.pool import Task, run_here, run_with_ray
from iwgnet_grasp.trials.record import write_json
from iwgnet_grasp.trials.statistics import Record, summary
from iwgnet_grasp.trials.worker import PACKAGE, Conditions, make_worker

_NOT_OF_TRIALS = ("comparisons.yaml", "dataset.yaml", "detector_training.yaml")


class BatchError(ValueError):
    """A run that cannot be started; one line."""


@dataclass(frozen=True)
class Run:
    """Trials of each scene with the seeds first_seed ... first_seed + trials - 1."""

    scenes: tuple[str, ...]
    trials: int
    first_seed: int
    conditions: Conditions = Conditions()

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise BatchError("--trials must be at least 1")
        if self.first_seed < 0:
            raise BatchError("--seed must not be negative")

    def tasks(self) -> list[Task]:
        """Seed by seed, so that a run that is cut off has as many trials of each scene."""
        seeds = range(self.first_seed, self.first_seed + self.trials)
        return [(scene, seed) for seed in seeds for scene in self.scenes]


def scene_names(config_dir: Path = PACKAGE / "config") -> list[str]:
    return list(yaml.safe_load((config_dir / "scenes.yaml").read_text()))


def run_trials(
    run: Run,
    out: Path,
    workers: int = 1,
    address: str | None = None,
    on_start: Callable[[list[Record]], None] = lambda records: None,
    on_record: Callable[[Record], None] = lambda record: None,
    say: Callable[[str], None] = print,
) -> dict:
    """Runs what is still to be run; returns the summary, which is also in out/summary.json.

    on_start is told the trials that the folder holds already, on_record each new one, `say` what
    else a person should know. Raises BatchError for a folder of another run or one
    that another process writes, PoolError or CellError when trials cannot go on; what was
    finished stays in the folder, also after KeyboardInterrupt.
    """
    with sole_writer(out, BatchError):
        _claim(out, run)
        records = read_records(out)
        on_start(records)
        done = {(record["scene"], record["seed"]) for record in records}
        tasks = [task for task in run.tasks() if task not in done]
        commit = _commit()
        try:
            if tasks:
                with (out / "trials.jsonl").open("a") as file:
                    for record in _records(run.conditions, tasks, out, workers, address, say):
                        record["commit"] = commit
                        file.write(json.dumps(record, allow_nan=False) + "\n")
                        file.flush()
                        os.fsync(file.fileno())
                        records.append(record)
                        on_record(record)
        finally:
            result = {"run": _as_json(run), **summary(records, run.scenes)}
            write_json(out / "summary.json", result)
        return result


def read_summary(out: Path) -> dict:
    """The summary of a folder's trials as they are now. Raises BatchError."""
    run = read_run(out)
    return {"run": _as_json(run), **summary(read_records(out), run.scenes)}


def _records(
    conditions: Conditions,
    tasks: Sequence[Task],
    out: Path,
    workers: int,
    address: str | None,
    say: Callable[[str], None],
) -> Iterator[Record]:
    make = functools.partial(make_worker, conditions, (out / "logs").resolve())
    if workers == 1 and address is None:
        return run_here(make, tasks)
    return run_with_ray(make, tasks, workers, address, say)


def read_records(out: Path) -> list[Record]:
    """The trials of a folder; a last line that was cut off in the middle is taken away."""
    path = out / "trials.jsonl"
    if not path.is_file():
        return []
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole)
    try:
        return [json.loads(line) for line in whole.splitlines()]
    except json.JSONDecodeError as error:
        raise BatchError(f"{path}: is not a file of trials ({error})") from None


def read_run(out: Path) -> Run:
    """The run that a folder holds. Raises BatchError."""
    path = out / "settings.json"
    try:
        settings = json.loads(path.read_text())
        names = [f.name for f in fields(Conditions)]
        conditions = Conditions(**{name: settings[name] for name in names})
        return Run(
            tuple(settings["scenes"]), settings["trials"], settings["first_seed"], conditions
        )
    except (OSError, json.JSONDecodeError, KeyError, TypeError):
        raise BatchError(f"{out}: is not the folder of a run (no usable settings.json)") from None


def _claim(out: Path, run: Run) -> None:
    """Writes settings.json, or compares it: only the number of trials may grow."""
    path = out / "settings.json"
    settings = {**_as_json(run), "inputs": inputs(run.conditions)}
    if path.exists():
        try:
            stored = json.loads(path.read_text())
        except (OSError, json.JSONDecodeError):
            raise BatchError(f"--out {out}: its settings.json cannot be read") from None
        different = [
            key
            for key in sorted(settings.keys() | stored.keys())
            if key != "trials" and settings.get(key) != stored.get(key)
        ]
        if different:
            key = different[0]
            old, new = stored.get(key), settings.get(key)
            what = f"{key} is {_short(old)} there, {_short(new)} here"
            if key == "inputs":
                changed = [n for n in old.keys() | new.keys() if old.get(n) != new.get(n)]
                what = f"{', '.join(sorted(changed))} changed since"
            raise BatchError(f"--out {out}: holds another run ({what}); choose another folder")
        if stored["trials"] > run.trials:
            raise BatchError(
                f"--out {out}: holds a run of {stored['trials']} trials; give as many or more"
            )
    elif any(out.iterdir()):
        raise BatchError(f"--out {out}: is not empty and holds no run of trials")
    write_json(path, settings)


def _as_json(run: Run) -> dict:
    settings = {**asdict(run), **asdict(run.conditions)}
    del settings["conditions"]
    settings["scenes"] = list(run.scenes)
    return settings


def inputs(conditions: Conditions) -> dict[str, str]:
    """Digests of the settings and weights that the trials depend on, by file. Raises BatchError or
    OverrideError for what does not exist."""
    if "supervisor.replan" in conditions.overrides:
        raise BatchError("--set supervisor.replan: is --replan here")
    with changed_config(PACKAGE / "config", conditions.overrides) as config_dir:
        paths = {f"config/{p.name}": p for p in sorted(config_dir.glob("*.yaml"))}
        perception = yaml.safe_load((config_dir / "perception.yaml").read_text())
    contents = {}
    for name, path in paths.items():
        if path.name in _NOT_OF_TRIALS:
            continue
        contents[name] = (PACKAGE / "config" / path.name).read_bytes()
    for part in ("detector", "masks", "outcomes", "grasps"):
        weights = perception[part]["weights"]
        try:
            contents[weights] = (PACKAGE / weights).read_bytes()
        except OSError as error:
            raise BatchError(f"{weights}: cannot be read ({error.strerror})") from None
    if conditions.calibration:
        contents[conditions.calibration] = Path(conditions.calibration).read_bytes()
    return {name: hashlib.sha256(data).hexdigest()[:16] for name, data in contents.items()}


def _commit() -> str:
    """The checkout's commit, with '+' when tracked files differ from it; '' outside of git."""
    try:
        git = ["git", "-C", str(PACKAGE)]
        commit = subprocess.run(
            [*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = subprocess.run(
            [*git, "status", "--porcelain", "-uno", "--", "src", "include", "config", "urdf"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit + ("+" if changed else "")


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else text[:57] + "..."
