"""Grasp networks side by side on held-out data."""

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from iwgnet_grasp.data.grasp_dataset import GraspDataset, find_samples, load_views
from iwgnet_grasp.data.grasp_rectangle import OPENING, QUALITY, THETA, Grasp, X, Y, angle_between
from iwgnet_grasp.networks import count_parameters
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.inference import make_predictor
from iwgnet_grasp.networks.weights import load_weights, weights_path, write_whole
from iwgnet_grasp.training.rectangle_metric import any_match, matches

CANDIDATES = 5


@dataclass(frozen=True)
class Evaluation:
    """Shares are in [0, 1]; errors are those of right predictions to the nearest true grasp."""

    weights: str
    network: str
    parameters: int
    samples: int
    top1: float
    top1_good: float  # of the samples whose best grasp has at least half the full quality
    top5: float
    relative_quality: float  # true quality of the chosen grasp / of the sample's best; 0 if wrong
    width_error_px: float
    angle_error_deg: float
    quality_error: float  # mean |predicted quality - quality of the grasp hit, 0 if wrong|
    backend: str
    milliseconds: float  # of the network alone, one crop of input_px, median


def evaluate(weights: str | Path, data: Path, backend: str = "auto", limit: int = 0) -> Evaluation:
    """DataError or WeightsError names what cannot be used."""
    network, card = load_weights(weights)
    size = int(card["input_px"])
    samples = find_samples(data)
    dataset = GraspDataset(load_views(samples[:limit] if limit else samples), size)
    name, predictor = make_predictor(network, size, backend)
    hits, good, hits_of_five, relative, width, angle, quality, times = ([] for _ in range(8))
    for index in range(len(dataset)):
        height, truth = dataset.crop(index)
        start = time.perf_counter()
        maps = predictor(height[None])
        times.append(time.perf_counter() - start)
        grasps = decode_grasps(*maps[0], max_grasps=CANDIDATES)
        hit = any_match(grasps[:1], truth)
        hits.append(hit)
        best = float(truth[:, QUALITY].max())
        if best >= 0.5:
            good.append(hit)
        hits_of_five.append(any_match(grasps, truth))
        row = nearest(grasps[0], truth) if hit else None
        true_quality = float(row[QUALITY]) if hit else 0.0
        relative.append(true_quality / best)
        quality.append(abs((grasps[0].quality if grasps else 0.0) - true_quality))
        if hit:
            width.append(abs(grasps[0].width_px - row[OPENING]))
            angle.append(np.degrees(angle_between(grasps[0].theta_rad, row[THETA])))
    return Evaluation(
        weights=weights_path(weights).stem,
        network=str(card["network"]),
        parameters=count_parameters(network),
        samples=len(dataset),
        top1=_mean(hits),
        top1_good=_mean(good),
        top5=_mean(hits_of_five),
        relative_quality=_mean(relative),
        width_error_px=_mean(width),
        angle_error_deg=_mean(angle),
        quality_error=_mean(quality),
        backend=name,
        milliseconds=round(1e3 * statistics.median(times), 2),
    )


def nearest(grasp: Grasp, truth: np.ndarray) -> np.ndarray:
    """Of the true rectangles that the grasp matches, the one with the nearest centre."""
    matching = np.stack([row for row in truth if matches(grasp, row[None])])
    distance = np.hypot(matching[:, X] - grasp.x_px, matching[:, Y] - grasp.y_px)
    return matching[int(distance.argmin())]


def as_markdown(rows: Sequence[Evaluation]) -> str:
    lines = [
        "| weights | parameters | top-1 | top-1, good grasp exists | top-5 | relative quality "
        "| width error px | angle error deg | quality error | ms | backend |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r.weights} | {r.parameters:,} | {r.top1:.1%} | {r.top1_good:.1%} | {r.top5:.1%} "
            f"| {r.relative_quality:.2f} | {r.width_error_px:.1f} | {r.angle_error_deg:.1f} "
            f"| {r.quality_error:.2f} | {r.milliseconds:.1f} | {r.backend} |"
        )
    return "\n".join(lines) + "\n"


def write_json(path: Path, data: Path, rows: Sequence[Evaluation]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"data": data.name, "evaluations": [asdict(row) for row in rows]}
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


def _mean(values: Sequence[float]) -> float:
    return round(float(np.mean(values)), 4) if len(values) else 0.0
