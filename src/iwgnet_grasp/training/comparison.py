"""Grasp networks side by side on held-out sets: rectangle metric, calibration, lifts, latency."""

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.progress import Progress

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.networks.weights import WeightsError, load_weights, weights_path
from iwgnet_grasp.perception.types import PerceptionError
from iwgnet_grasp.progress import progress_bar
from iwgnet_grasp.training.evaluation import (
    NetworkRun,
    Prediction,
    quality_reliability,
    run_network,
    score,
    score_by,
)
from iwgnet_grasp.training.held_out import HeldOutSet, load_held_out
from iwgnet_grasp.training.reliability import reliability
from iwgnet_grasp.trials.held_out_lifts import (
    NO_GRASP,
    LiftsUnavailable,
    choose_objects,
    in_view,
    lift_all,
    simulator_digest,
)
from iwgnet_grasp.trials.statistics import wilson_interval

log = logging.getLogger(__name__)

Outcomes = dict[str, str]  # object -> what became of the network's first grasp
LIFTED = "lifted"


def compare_networks(
    weights: Sequence[str],
    data: Sequence[Path],
    out: Path,
    backend: str = "auto",
    limit: int = 0,
    lifts: int = 0,
    seed: int = 0,
    workers: int = 1,
    address: str | None = None,
    detector: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """All figures as plain data (the content of evaluation.json).

    lifts: objects of each set that every network's first grasp is carried out on, drawn by `seed`;
    outcomes are kept in OUT/lifts.jsonl. detector: weights of the detector, None: not evaluated.
    What cannot be used is named in one warning and left out; DataError when nothing is left.
    """
    usable = _each(weights, load_weights)
    sets = list(_each(data, lambda folder: load_held_out(folder, limit)).values())
    names = [s.name for s in sets]
    if len(set(names)) < len(names):
        raise DataError(f"data folders of the same name: {', '.join(sorted(names))}")
    if lifts:
        try:
            simulator_digest()
        except LiftsUnavailable as error:
            log.warning("lifts: %s; left out", error)
            lifts = 0
    with progress_bar(quiet=not progress) as bar:
        objects = sum(len(s.views) for s in sets)
        runs = []
        stems = Counter(weights_path(name).stem for name in usable)
        for name in usable:
            stem = weights_path(name).stem
            label = stem if stems[stem] == 1 else str(name)
            task = bar.add_task(f"predictions of {label}", total=objects)
            run = run_network(name, sets, backend, lambda t=task: bar.advance(t))
            runs.append(replace(run, weights=label))
        lifted = {
            held_out.name: _lift(held_out, runs, lifts, seed, out, workers, address, bar)
            for held_out in sets
        }
        found = _detect(detector, sets, backend, bar) if detector else {}
    return {
        "sets": {s.name: _describe(s) for s in sets},
        "lifts": {"count": lifts, "seed": seed},
        "networks": [_network(run, lifted) for run in runs],
        "detector": _plain(found),
    }


def _each(names: Sequence, load) -> dict[Any, Any]:
    """name -> loaded; what cannot be loaded is left out. Raises the error when none can be."""
    loaded, first = {}, None
    for name in names:
        try:
            loaded[name] = load(name)
        except (DataError, WeightsError) as error:
            if len(names) > 1:
                log.warning("%s; left out", error)
            first = first or error
    if first and not loaded:
        raise first
    return loaded


def _lift(
    held_out: HeldOutSet,
    runs: Sequence[NetworkRun],
    count: int,
    seed: int,
    out: Path,
    workers: int,
    address: str | None,
    bar: Progress,
) -> dict[str, Outcomes]:
    """Network -> outcomes of the set's chosen objects; nothing where lifts cannot be done."""
    if not count:
        return {}
    if not held_out.generator or "settings" not in held_out.generator:
        log.warning("lifts on %s: not made by 'iwgnet dataset'; left out", held_out.folder)
        return {}
    chosen = choose_objects(held_out.views.names, count, seed)
    first = {
        run.weights: {
            p.sample: in_view(p.grasps[0], run.input_px) if p.grasps else None
            for p in run.predictions[held_out.name]
            if p.sample in chosen
        }
        for run in runs
    }
    wanted: dict[str, list] = {name: [] for name in chosen}
    for grasps in first.values():
        for name, grasp in grasps.items():
            if grasp and grasp not in wanted[name]:
                wanted[name].append(grasp)
    total = sum(len(grasps) for grasps in wanted.values())
    task = bar.add_task(f"lifts on {held_out.name}", total=total)
    try:
        done = lift_all(
            held_out.folder,
            held_out.generator,
            wanted,
            out / "lifts.jsonl",
            workers,
            address,
            lambda n: bar.advance(task, n),
        )
    except DataError as error:
        log.warning("lifts on %s: %s; left out", held_out.folder, error)
        return {}
    lost = {name for name, grasps in wanted.items() if any((name, g) not in done for g in grasps)}
    if lost:
        log.warning(
            "lifts on %s: %d of %d objects do not come out as they are stored (made by another "
            "version?); left out",
            held_out.folder,
            len(lost),
            len(chosen),
        )
    return {
        weights: {
            name: done[name, grasp]["outcome"] if grasp else NO_GRASP
            for name, grasp in grasps.items()
            if name not in lost
        }
        for weights, grasps in first.items()
    }


def _detect(
    weights: Path, sets: Sequence[HeldOutSet], backend: str, bar: Progress
) -> dict[str, Any]:
    from iwgnet_grasp.training.detector_evaluation import evaluate_detector

    found = {}
    for held_out in sets:
        if not (held_out.folder / "detector" / "annotations.json").is_file():
            continue
        task = bar.add_task(f"detector on {held_out.name}", total=None)
        try:
            metrics = evaluate_detector(
                weights, held_out.folder, backend, lambda t=task: bar.advance(t)
            )
        except (PerceptionError, DataError) as error:
            log.warning("detector: %s; left out", error)
            continue
        broken = metrics.pop("left_out")
        if broken:
            log.warning(
                "%s: missing or not an image, one of %d such; left out", broken[0], len(broken)
            )
        found[held_out.name] = metrics
    return found


def _describe(held_out: HeldOutSet) -> dict[str, Any]:
    generator = held_out.generator or {}
    return {
        "objects": len(held_out.views),
        "families": generator.get("families", []),
        "seed": generator.get("seed"),
        "scenes": generator.get("scenes"),
    }


def _network(run: NetworkRun, lifted: Mapping[str, Mapping[str, Outcomes]]) -> dict[str, Any]:
    facts = ("weights", "network", "parameters", "input_px", "backend", "milliseconds")
    return {name: getattr(run, name) for name in facts} | {
        "sets": {
            name: _on_set(predictions, lifted[name].get(run.weights, {}))
            for name, predictions in run.predictions.items()
        }
    }


def _on_set(predictions: Sequence[Prediction], outcomes: Outcomes) -> dict[str, Any]:
    result: dict[str, Any] = {
        "score": asdict(score(predictions)),
        "quality": asdict(quality_reliability(predictions)),
        "lifts": {**lift_score(predictions, outcomes), "by_object": outcomes},
    }
    for fact in ("family", "arrangement"):
        result[fact] = {
            name: {
                "score": asdict(part),
                "lifts": lift_score([p for p in predictions if getattr(p, fact) == name], outcomes),
            }
            for name, part in score_by(predictions, fact).items()
        }
    return _plain(result)


def lift_score(predictions: Sequence[Prediction], outcomes: Outcomes) -> dict[str, Any]:
    """Of the objects that were tried: how many were lifted, what became of the others, and how the
    predicted quality agrees with that. A grasp that cannot be executed counts as not lifted."""
    tried = [p for p in predictions if p.sample in outcomes]
    success = [outcomes[p.sample] == LIFTED for p in tried]
    return {
        "tried": len(tried),
        "lifted": sum(success),
        "share": sum(success) / len(tried) if tried else math.nan,
        "interval_95": list(wilson_interval(sum(success), len(tried))),
        "outcomes": dict(Counter(outcomes[p.sample] for p in tried).most_common()),
        "quality": asdict(reliability([p.predicted_quality for p in tried], success)),
    }


def _plain(value: Any) -> Any:
    """For JSON: floats of four digits, None for what is not a number."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    return value
