"""Order in which the objects of a look are grasped (section 3.3, Eq. 17-21)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from iwgnet_grasp.files import read_config
from iwgnet_grasp.perception.pipeline import PACKAGE, same_grasp
from iwgnet_grasp.perception.types import (
    CameraIntrinsics,
    GraspRectangle,
    ObjectGrasps,
    PerceptionError,
)

DEFAULT_CONFIG = PACKAGE / "config" / "priority.yaml"


@dataclass(frozen=True)
class PriorityConfig:
    """config/priority.yaml."""

    alpha: float  # weight of D
    beta: float  # weight of G
    failed_radius_px: float
    failed_angle_rad: float
    random_order: bool  # S* is drawn, not computed: for comparison

    @staticmethod
    def load(path: str | Path = DEFAULT_CONFIG) -> PriorityConfig:
        """Raises PerceptionError for a file that is missing, malformed or lacks a key."""
        return read_config(path, "priority config", PriorityConfig._of, PerceptionError)

    @staticmethod
    def _of(text: dict) -> PriorityConfig:
        names = ("alpha", "beta", "failed_radius_px", "failed_angle_deg")
        values = [float(text[name]) for name in names]
        if not all(math.isfinite(value) and value >= 0 for value in values):
            raise ValueError(f"{', '.join(names)} must be finite and >= 0")
        return PriorityConfig(
            *values[:-1],
            failed_angle_rad=math.radians(values[-1]),
            random_order=bool(text["random_order"]),
        )


@dataclass(frozen=True)
class RankedObject:
    """An object with the terms of its priority; see msg/RankedObject.msg."""

    object: ObjectGrasps
    depth_distance_m: float  # D of Eq. 17; NaN when not scored, as are the next two
    centroid_distance_m: float  # G of Eq. 20
    score: float  # S of Eq. 17
    priority: float  # S* of Eq. 21; 0 for the objects that go last
    reason: str = ""  # why it goes last


@dataclass(frozen=True)
class Ranking:
    """The sequence, first to be grasped first, and the objects left out of it with the reason."""

    objects: tuple[RankedObject, ...]
    dropped: tuple[tuple[ObjectGrasps, str], ...] = ()


def rank(
    objects: Sequence[ObjectGrasps],
    camera: CameraIntrinsics,
    config: PriorityConfig,
    failed: Sequence[GraspRectangle] = (),
    seed: Sequence[int] = (0,),
) -> Ranking:
    """Ranks objects by S* (Eq. 21), descending; equal S* keep the order of `objects`.

    Each object is scored by its best grasp that is not among the `failed` ones (see
    without_failed); the returned objects hold the grasps that are left. The degenerate cases:
    one object, or equal scores -> S* = 1 for all (Eq. 21 is 0/0 there); an object without a
    valid pixel or without depth at its grasp has no S: it goes last with S* = 0 and its reason;
    an object without any grasp left is dropped. With config.random_order `seed` draws S* of the
    objects that would have been scored.
    """
    scored: list[RankedObject] = []
    last: list[RankedObject] = []
    dropped: list[tuple[ObjectGrasps, str]] = []
    for candidate in objects:
        left = without_failed(candidate, failed, config)
        if not left.grasps:
            reason = "no grasp was found" if not candidate.grasps else "all its grasps have failed"
            dropped.append((left, reason))
            continue
        reason = _unscorable(left)
        if reason:
            last.append(RankedObject(left, math.nan, math.nan, math.nan, 0.0, reason))
            continue
        depth_distance = left.grasps[0].depth_m
        distance = centroid_distance(left, left.grasps[0], camera)
        score = config.alpha * depth_distance + config.beta * distance  # Eq. 17
        scored.append(RankedObject(left, depth_distance, distance, score, math.nan))
    priorities = normalised([entry.score for entry in scored])
    if config.random_order:
        priorities = np.random.default_rng(seed).permutation(len(scored)) / max(len(scored) - 1, 1)
        priorities = [float(priority) for priority in priorities]
    scored = [replace(entry, priority=p) for entry, p in zip(scored, priorities, strict=True)]
    scored.sort(key=lambda entry: -entry.priority)  # stable
    return Ranking(tuple(scored + last), tuple(dropped))


def centroid_distance(
    target: ObjectGrasps, grasp: GraspRectangle, camera: CameraIntrinsics
) -> float:
    """G of Eq. 20 (m): from the object's centroid to the grasp point, in the camera frame."""
    at_centroid = camera.deproject(
        target.centroid_u_px, target.centroid_v_px, target.centroid_depth_m
    )
    at_grasp = camera.deproject(grasp.x_px, grasp.y_px, grasp.depth_m)
    return float(np.linalg.norm(at_centroid - at_grasp))


def normalised(scores: Sequence[float]) -> list[float]:
    """S* of Eq. 21: 1 for the least score, 0 for the greatest; 1 for all when they are equal."""
    if not scores:
        return []
    low, high = min(scores), max(scores)
    if high == low:
        return [1.0] * len(scores)
    return [1.0 - (score - low) / (high - low) for score in scores]


def without_failed(
    target: ObjectGrasps, failed: Sequence[GraspRectangle], config: PriorityConfig
) -> ObjectGrasps:
    """The object without the candidates that repeat a failed grasp (same place and direction)."""
    kept = tuple(
        grasp
        for grasp in target.grasps
        if not any(
            same_grasp(grasp, other, config.failed_radius_px, config.failed_angle_rad)
            for other in failed
        )
    )
    return replace(target, grasps=kept)


def _unscorable(target: ObjectGrasps) -> str:
    if target.valid_pixels == 0:
        return "no valid depth on the object"
    if not math.isfinite(target.grasps[0].depth_m):
        return "no depth at the grasp point"
    return ""
