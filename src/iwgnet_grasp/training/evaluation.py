"""A grasp network on held-out data: rectangle metric, errors, calibration, latency."""

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iwgnet_grasp.data.grasp_dataset import GraspDataset
from iwgnet_grasp.data.grasp_rectangle import OPENING, QUALITY, THETA, Grasp, angle_between
from iwgnet_grasp.networks import GRASP_NETWORKS, count_parameters
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.inference import make_predictor
from iwgnet_grasp.networks.weights import (
    MODELS,
    WeightsError,
    load_weights,
    read_card,
    weights_path,
)
from iwgnet_grasp.training.held_out import HeldOutSet
from iwgnet_grasp.training.rectangle_metric import any_match, hit
from iwgnet_grasp.training.reliability import Reliability, reliability

CANDIDATES = 5
GOOD_QUALITY = 0.5  # of a label: half of what the best grasp of all is worth


@dataclass(frozen=True)
class Prediction:
    """What a network says about one object, and what of it is true."""

    sample: str
    family: str
    arrangement: str
    best_quality: float  # of the object's labels
    grasps: tuple[Grasp, ...]  # up to CANDIDATES, best first, in px of the network's input
    right: bool  # the first grasp matches a label
    right_of_five: bool
    quality: float  # of the label that the first grasp matches; 0: none
    width_error_px: float | None = None  # of a right first grasp, to that label
    angle_error_deg: float | None = None

    @property
    def predicted_quality(self) -> float:
        return self.grasps[0].quality if self.grasps else 0.0


@dataclass(frozen=True)
class NetworkRun:
    """All predictions of one network. milliseconds: of the network alone, median, one crop."""

    weights: str
    network: str
    parameters: int
    input_px: int
    backend: str
    milliseconds: float
    predictions: dict[str, tuple[Prediction, ...]]  # by set


@dataclass(frozen=True)
class Score:
    """Of some predictions. Shares are in [0, 1]; errors are means over right first grasps, NaN
    where there is none."""

    objects: int
    top1: float
    top5: float
    good_objects: int  # with a label of at least GOOD_QUALITY
    top1_good: float
    relative_quality: float  # label quality of the chosen grasp / of the object's best; 0 if wrong
    width_error_px: float
    angle_error_deg: float


def trained_networks(folder: Path = MODELS) -> list[str]:
    """Weights of all grasp networks in a folder, in the order of networks.GRASP_NETWORKS.
    WeightsError when there are none."""
    order = list(GRASP_NETWORKS)
    found = []
    for path in sorted(folder.glob("*.safetensors")):
        try:
            network = str(read_card(path)["network"])
        except WeightsError:
            continue
        if network in order:
            found.append((order.index(network), path.stem))
    if not found:
        raise WeightsError(f"{folder}: holds no grasp network; make one with 'iwgnet train'")
    return [name if folder == MODELS else str(folder / name) for _, name in sorted(found)]


def run_network(
    weights: str | Path,
    sets: Iterable[HeldOutSet],
    backend: str = "auto",
    progress: Callable[[], None] | None = None,
) -> NetworkRun:
    """`progress` is told of each object. WeightsError or ValueError names what cannot be used."""
    network, card = load_weights(weights)
    size = int(card["input_px"])
    name, predictor = make_predictor(network, size, backend)
    seconds: list[float] = []
    predictions = {}
    for held_out in sets:
        dataset = GraspDataset(held_out.views, size)
        rows = []
        facts = zip(held_out.views.names, held_out.families, held_out.arrangements, strict=True)
        for index, (sample, family, arrangement) in enumerate(facts):
            height, truth = dataset.crop(index)
            start = time.perf_counter()
            maps = predictor(height[None])
            seconds.append(time.perf_counter() - start)
            grasps = decode_grasps(*maps[0], max_grasps=CANDIDATES)
            rows.append(compare(sample, family, arrangement, grasps, truth))
            if progress:
                progress()
        predictions[held_out.name] = tuple(rows)
    return NetworkRun(
        weights=weights_path(weights).stem,
        network=str(card["network"]),
        parameters=count_parameters(network),
        input_px=size,
        backend=name,
        milliseconds=round(1e3 * statistics.median(seconds), 2) if seconds else float("nan"),
        predictions=predictions,
    )


def compare(
    sample: str, family: str, arrangement: str, grasps: Sequence[Grasp], truth: np.ndarray
) -> Prediction:
    """Grasps, best first, against the labels [n, 6] of the same object."""
    label = hit(grasps[0], truth) if grasps else None
    width = angle = None
    if label is not None:
        width = float(abs(grasps[0].width_px - label[OPENING]))
        angle = float(np.degrees(angle_between(grasps[0].theta_rad, label[THETA])))
    return Prediction(
        sample=sample,
        family=family,
        arrangement=arrangement,
        best_quality=float(truth[:, QUALITY].max()),
        grasps=tuple(grasps),
        right=label is not None,
        right_of_five=any_match(grasps, truth),
        quality=0.0 if label is None else float(label[QUALITY]),
        width_error_px=width,
        angle_error_deg=angle,
    )


def score(predictions: Sequence[Prediction]) -> Score:
    good = [p for p in predictions if p.best_quality >= GOOD_QUALITY]
    return Score(
        objects=len(predictions),
        top1=_mean(p.right for p in predictions),
        top5=_mean(p.right_of_five for p in predictions),
        good_objects=len(good),
        top1_good=_mean(p.right for p in good),
        relative_quality=_mean(p.quality / p.best_quality for p in predictions),
        width_error_px=_mean(p.width_error_px for p in predictions if p.right),
        angle_error_deg=_mean(p.angle_error_deg for p in predictions if p.right),
    )


def score_by(predictions: Sequence[Prediction], fact: str) -> dict[str, Score]:
    """Scores by "family" or "arrangement", of the predictions that name it."""
    groups: dict[str, list[Prediction]] = {}
    for p in predictions:
        groups.setdefault(getattr(p, fact), []).append(p)
    return {name: score(groups[name]) for name in sorted(groups) if name}


def quality_reliability(predictions: Sequence[Prediction]) -> Reliability:
    """Of the first grasps' predicted quality against the labels'."""
    return reliability([p.predicted_quality for p in predictions], [p.quality for p in predictions])


def _mean(values: Iterable[Any]) -> float:
    values = list(values)
    return float(np.mean(values)) if values else float("nan")
