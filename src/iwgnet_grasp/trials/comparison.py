"""Runs that differ in single settings, on the same seeds: ablations, rivals, sweeps."""

from __future__ import annotations

import difflib
import itertools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from iwgnet_grasp.overrides import parse_override
from iwgnet_grasp.trials.batch import BatchError, Run, inputs, read_summary
from iwgnet_grasp.trials.record import write_json
from iwgnet_grasp.trials.worker import PACKAGE

FILE = "comparison.json"


@dataclass(frozen=True)
class Comparison:
    """variants: name -> settings (FILE.KEY or "replan" -> value); arguments: what follows
    `scripts/run_trials compare`."""

    name: str
    title: str
    variants: dict[str, dict[str, Any]]
    arguments: str

    def runs(self, base: Run) -> dict[str, Run]:
        """Run by variant."""
        runs = {}
        for name, settings in self.variants.items():
            overrides = {**base.conditions.overrides, **settings}
            replan = overrides.pop("replan", base.conditions.replan)
            conditions = replace(base.conditions, overrides=overrides, replan=replan)
            runs[name] = replace(base, conditions=conditions)
        return runs


def named_comparison(name: str) -> Comparison:
    """The one of config/comparisons.yaml. Raises BatchError."""
    known = yaml.safe_load((PACKAGE / "config" / "comparisons.yaml").read_text())
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean '{close[0]}'?" if close else f" (known: {', '.join(known)})"
        raise BatchError(f"compare {name}: no such comparison{hint}")
    return Comparison(name, known[name]["title"], known[name]["variants"], name)


def sweep(axes: Sequence[str]) -> Comparison:
    """Every combination of the values of 'FILE.KEY=V1,V2,...'. Raises OverrideError."""
    values: dict[str, list[Any]] = {}
    for text in axes:
        key = text.partition("=")[0]
        items = text.partition("=")[2].split(",")
        values[key.strip()] = [parse_override(f"{key}={item}")[1] for item in items]
    variants = {}
    for combination in itertools.product(*values.values()):
        settings = dict(zip(values, combination, strict=True))
        name = ", ".join(f"{key.rpartition('.')[2]} {value}" for key, value in settings.items())
        variants[name] = settings
    keys = [key.rpartition(".")[2] for key in values]
    arguments = " ".join(f"--sweep {text}" for text in axes)
    return Comparison(
        f"sweep_{'_'.join(keys)}", f"Sweep of {' and '.join(keys)}", variants, arguments
    )


def compare(
    comparison: Comparison,
    base: Run,
    out: Path,
    run_one: Callable[[Run, Path, str], dict],
) -> dict:
    """Runs each variant by run_one(run, folder, name) -> summary; returns and writes what
    read_comparison() reads. Raises BatchError or OverrideError for settings or weights that do not
    exist, before anything runs."""
    runs = comparison.runs(base)
    for run in runs.values():
        inputs(run.conditions)  # keys and weights that do not exist: before the first trial
    out.mkdir(parents=True, exist_ok=True)
    folders = {name: folder_name(name) for name in comparison.variants}
    for name, run in runs.items():
        run_one(run, out / folders[name], name)
    write_json(
        out / FILE,
        {
            "name": comparison.name,
            "title": comparison.title,
            "command": f"scripts/run_trials compare {comparison.arguments}",
            "variants": [
                {"name": name, "settings": comparison.variants[name], "folder": folders[name]}
                for name in comparison.variants
            ],
        },
    )
    return read_comparison(out)


def read_comparison(out: Path) -> dict:
    """comparison.json with the summary of each variant in it. Raises BatchError."""
    try:
        result = json.loads((out / FILE).read_text())
    except (OSError, json.JSONDecodeError):
        raise BatchError(f"{out}: is not the folder of a comparison (no {FILE})") from None
    for variant in result["variants"]:
        variant["summary"] = read_summary(out / variant["folder"])
    return result


def folder_name(variant: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", variant).strip("_")
