"""Detect, mask, merge, estimate, decode, foresee: what the perception node does with one look."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from iwgnet_grasp.data.depth import normalise_depth, support_plane
from iwgnet_grasp.data.grasp_rectangle import angle_between, wrap_theta
from iwgnet_grasp.data.letterbox import Region, checked_region, region_corners
from iwgnet_grasp.files import read_config
from iwgnet_grasp.perception.grasp_view import grasp_view, without_gaps
from iwgnet_grasp.perception.merged_depth import (
    centroid,
    covered_share,
    crop_window,
    distinct_objects,
    grasp_depth,
    lies_on,
    metres,
    object_mask,
    own_share,
    pixel_owners,
    same_parts,
    standing,
    taken_away,
    unexplained_surfaces,
    union,
)
from iwgnet_grasp.perception.rims import rim_grasps
from iwgnet_grasp.perception.shanks import shank_grasps
from iwgnet_grasp.perception.types import (
    NOBODY,
    Box,
    Detection,
    GraspRectangle,
    Look,
    ObjectGrasps,
    PerceptionError,
    Window,
)

PACKAGE = Path(__file__).resolve().parents[3]
UNKNOWN = "unknown"  # label of an object where nothing was detected
DEFAULT_CONFIG = PACKAGE / "config" / "perception.yaml"


class ObjectDetector(Protocol):
    """perception.detector.Detector."""

    backend: str
    region: Region  # of the image, where it looks

    def detect(self, color: np.ndarray, where: Box | None = None) -> list[Detection]: ...


class WindowGrasps(Protocol):
    """networks.inference.GraspEstimator: grasps of each window in the window's own px."""

    input_px: int
    backend: str

    def predict(self, depth: np.ndarray, table: np.ndarray) -> list[list[Any]]: ...


class WindowMasks(Protocol):
    """networks.object_mask.MaskEstimator: logits (N, S, S) of "the object's pixel" in windows of
    S = input_px around the objects, from heights (N, S, S) and greys (N, S, S) uint8."""

    input_px: int
    backend: str

    def predict(self, heights: np.ndarray, greys: np.ndarray) -> np.ndarray: ...


class SameParts(Protocol):
    """networks.same_part.SamePartEstimator: for each patch (H, W) bool the probability (H, W) that
    a pixel shows the same part, from heights (H, W) m and grey (H, W) uint8."""

    backend: str

    def predict(
        self, heights: np.ndarray, grey: np.ndarray, patches: list[np.ndarray]
    ) -> list[np.ndarray]: ...


class GraspOutcomes(Protocol):
    """networks.pick_outcome.OutcomeEstimator: probabilities (N, 2) that a grasp takes its part,
    alone and without a fault, and that no other part moves, from views (N, C, S, S) float32."""

    backend: str

    def predict(self, views: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class PerceptionConfig:
    """config/perception.yaml."""

    detector_weights: Path
    detector_backend: str
    detector_region: Region | None
    score_threshold: float
    iou_threshold: float
    max_objects: int
    mask_weights: Path
    mask_backend: str
    sure_score: float
    min_new_share: float
    min_new_pixels: int
    min_unexplained_pixels: int
    same_part_weights: Path
    same_part_backend: str
    sure_part_score: float
    same_part_probability: float
    min_piece_pixels: int
    min_part_pixels: int
    grasp_weights: Path
    grasp_backend: str
    outcome_weights: Path
    outcome_backend: str
    candidates: int
    min_distance_px: float
    min_angle_rad: float
    min_own_share: float
    rim_quality: float
    shank_quality: float
    min_pixels: int
    min_height: float
    max_step: float
    covered_scale: float
    grasp_depth_radius_px: float

    @staticmethod
    def load(path: str | Path = DEFAULT_CONFIG) -> PerceptionConfig:
        """Raises PerceptionError for a file that is missing, malformed or lacks a key."""
        return read_config(path, "perception config", PerceptionConfig._of, PerceptionError)

    @staticmethod
    def _of(text: dict) -> PerceptionConfig:
        detector, masks, pieces = text["detector"], text["masks"], text["pieces"]
        grasps, pixels = text["grasps"], text["object_pixels"]
        region = detector["region"]
        return PerceptionConfig(
            detector_weights=_in_package(detector["weights"]),
            detector_backend=str(detector["backend"]),
            detector_region=region and checked_region(region),
            score_threshold=float(detector["score_threshold"]),
            iou_threshold=float(detector["iou_threshold"]),
            max_objects=int(detector["max_objects"]),
            mask_weights=_in_package(masks["weights"]),
            mask_backend=str(masks["backend"]),
            sure_score=float(masks["sure_score"]),
            min_new_share=float(masks["min_new_share"]),
            min_new_pixels=int(masks["min_new_pixels"]),
            min_unexplained_pixels=int(masks["min_unexplained_pixels"]),
            same_part_weights=_in_package(pieces["weights"]),
            same_part_backend=str(pieces["backend"]),
            sure_part_score=float(pieces["sure_score"]),
            same_part_probability=float(pieces["probability"]),
            min_piece_pixels=int(pieces["min_pixels"]),
            min_part_pixels=int(pieces["min_part_pixels"]),
            grasp_weights=_in_package(grasps["weights"]),
            grasp_backend=str(grasps["backend"]),
            outcome_weights=_in_package(text["outcomes"]["weights"]),
            outcome_backend=str(text["outcomes"]["backend"]),
            candidates=int(grasps["candidates"]),
            min_distance_px=float(grasps["min_distance_px"]),
            min_angle_rad=math.radians(float(grasps["min_angle_deg"])),
            min_own_share=float(grasps["min_own_share"]),
            rim_quality=float(grasps["rim_quality"]),
            shank_quality=float(grasps["shank_quality"]),
            min_pixels=int(pixels["min_pixels"]),
            min_height=float(pixels["min_height"]),
            max_step=float(pixels["max_step"]),
            covered_scale=float(pixels["covered_scale"]),
            grasp_depth_radius_px=float(pixels["grasp_depth_radius_px"]),
        )


@dataclass(frozen=True)
class _View:
    """What the networks see of the table; (H, W) each but color."""

    color: np.ndarray  # (H, W, 3) uint8 RGB
    depth: np.ndarray  # m
    empty_depth: np.ndarray
    grey: np.ndarray  # uint8
    heights: np.ndarray  # m over the empty scene, lines of missing pixels filled
    table: np.ndarray  # m, depth of the plane that the empty scene shows in the part looked at

    @staticmethod
    def of(color: np.ndarray, depth: np.ndarray, empty_depth: np.ndarray, part: Box) -> _View:
        grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        try:
            table = support_plane(empty_depth[part.slices], (-part.y, -part.x, *depth.shape))
        except ValueError:
            raise PerceptionError(
                "empty_depth: nothing was measured where the detector looks; check the region in "
                "config/perception.yaml"
            ) from None
        return _View(color, depth, empty_depth, grey, without_gaps(empty_depth - depth), table)

    def tables(self, windows: Sequence[Window], size: int) -> list[np.ndarray]:
        """(size, size) of `table` for each window."""
        return [self.table[w.y : w.y + size, w.x : w.x + size] for w in windows]


class Perception:
    """All networks on one look. Stateless between looks."""

    def __init__(
        self,
        config: PerceptionConfig,
        detector: ObjectDetector,
        estimator: WindowGrasps,
        masks: WindowMasks,
        outcomes: GraspOutcomes,
        same_part: SameParts,
    ) -> None:
        self.config = config
        self.detector = detector
        self.estimator = estimator
        self.masks = masks
        self.outcomes = outcomes
        self.same_part = same_part

    @property
    def backends(self) -> dict[str, str]:
        """The library that runs each network."""
        return {
            "detector": self.detector.backend,
            "masks": self.masks.backend,
            "pieces": self.same_part.backend,
            "grasps": self.estimator.backend,
            "outcomes": self.outcomes.backend,
        }

    def look(self, color: np.ndarray, depth: np.ndarray, empty_depth: np.ndarray) -> Look:
        """All objects of one look with their grasps, in descending order of detection score.

        color: (H, W, 3) uint8 RGB. depth, empty_depth: (H, W) of the same view, float metres
        (NaN or <= 0 invalid) or uint16 millimetres. Raises PerceptionError on anything else and
        on a depth image without one valid pixel.
        """
        start = time.perf_counter()
        color = checked_color(color)
        depth = metres(depth, "depth")
        empty_depth = metres(empty_depth, "empty_depth")
        for name, image in (("depth", depth), ("empty_depth", empty_depth)):
            if image.shape != color.shape[:2]:
                raise PerceptionError(
                    f"{name}: {image.shape[1]}x{image.shape[0]} px differs from the colour image's "
                    f"{color.shape[1]}x{color.shape[0]} px; align it to the colour camera"
                )
        part = self._looked_at(depth.shape)
        view = _View.of(color, depth, empty_depth, part)
        checked = time.perf_counter()
        where = standing(view.heights, empty_depth, part, self.config.min_height)
        detections = self.detector.detect(color, where)
        detected = time.perf_counter()
        detections, owners = self._distinct(view, detections)
        masked = time.perf_counter()
        numbered = dict(enumerate(detections))
        seconds = {
            "check": checked - start,
            "detect": detected - checked,
            "mask": masked - detected,
        }
        return self._estimate(view, numbered, owners, seconds, strict=False)

    def without(self, look: Look, taken: Sequence[int]) -> Look:
        """The look as it would be once the objects with these ids had been taken away and nothing
        else had moved: what they lay on goes on beneath them, else the empty scene stands there.
        The grasps of the others are estimated anew.

        No other look will show what was wrong in this one: objects that show one part are joined,
        under the first's id, and what no object explains is one as well, with an id of its own.
        """
        part = self._looked_at(look.depth.shape)
        view = _View.of(look.color, look.depth, look.empty_depth, part)
        seen = {o.object_id: Detection(o.label, o.score, o.box) for o in look.objects}
        parts, owners, became = self._whole_parts(view, seen, look.owners)
        gone = {int(became[i]) for i in taken}
        depth, owners = taken_away(
            look.depth, look.empty_depth, owners, list(gone), self.config.max_step
        )
        view = replace(view, depth=depth, heights=without_gaps(look.empty_depth - depth))
        left = {i: detection for i, detection in parts.items() if i not in gone}
        return self._estimate(view, left, owners, {}, strict=True)

    def _looked_at(self, shape: tuple[int, ...]) -> Box:
        """The detector's region in an image (H, W)."""
        left, top, right, bottom = region_corners(shape, self.detector.region)
        return Box(left, top, right - left, bottom - top)

    def _only_looked_at(self, mask: np.ndarray) -> np.ndarray:
        """A mask (H, W) without what lies outside of the detector's region."""
        part = self._looked_at(mask.shape).slices
        kept = np.zeros_like(mask)
        kept[part] = mask[part]
        return kept

    def _distinct(
        self, view: _View, detections: Sequence[Detection]
    ) -> tuple[list[Detection], np.ndarray]:
        """The detections that show an object of their own, with a score of 0 what stands there and
        no detection explains, and whose pixel each is."""
        config = self.config
        size = self.masks.input_px
        boxes = [detection.box for detection in detections]
        windows = [crop_window(view.depth, view.empty_depth, box, size) for box in boxes]
        heights = np.zeros((len(windows), size, size), np.float32)
        for height, window, table in zip(heights, windows, view.tables(windows, size), strict=True):
            height[:] = normalise_depth(window.depth, table)
        greys = [view.grey[w.y : w.y + size, w.x : w.x + size] for w in windows]
        logits = self.masks.predict(heights, np.array(greys, np.uint8).reshape(heights.shape))
        with np.errstate(invalid="ignore"):
            seen = view.heights > config.min_height
        kept = distinct_objects(
            logits,
            windows,
            detections,
            seen,
            config.sure_score,
            config.min_new_share,
            config.min_new_pixels,
        )
        detections = [detections[i] for i in kept]
        owners = pixel_owners(
            logits[kept], [windows[i] for i in kept], [d.box for d in detections], seen.shape
        )
        looked_at = self._only_looked_at(seen)
        label = detections[0].label if detections else UNKNOWN
        for box, surface in unexplained_surfaces(looked_at, owners, config.min_unexplained_pixels):
            owners[box.slices][surface] = len(detections)
            detections.append(Detection(label, 0.0, box))
        return detections, owners

    def _whole_parts(
        self, view: _View, detections: dict[int, Detection], owners: np.ndarray
    ) -> tuple[dict[int, Detection], np.ndarray, np.ndarray]:
        """One object for each part: what lies across a part leaves pieces of it that no object has,
        or that two have. By the first of the ids that are joined, new ones follow the known ones.
        With whose pixel each is, and which object each of the ids has become."""
        config = self.config
        known = len(detections)
        with np.errstate(invalid="ignore"):
            seen = self._only_looked_at(view.heights > config.min_height)
        surfaces = unexplained_surfaces(seen, owners, config.min_piece_pixels)
        pieces = owners.copy()
        for i, (box, surface) in enumerate(surfaces, known):
            pieces[box.slices][surface] = i
        count = known + len(surfaces)
        shown = np.bincount(pieces[pieces != NOBODY], minlength=count)
        scores = [detections[i].score for i in range(known)] + [0.0] * len(surfaces)
        sure = [score >= config.sure_part_score for score in scores]
        asked = [i for i in range(count) if shown[i] and not sure[i]]
        part = self._looked_at(seen.shape).slices
        there = pieces[part]
        claimed = there != NOBODY
        chances = self.same_part.predict(
            view.heights[part], view.grey[part], [there == i for i in asked]
        )
        alike = np.full((count, count), np.nan)
        for i, chance in zip(asked, chances, strict=True):
            total = np.bincount(there[claimed], chance[claimed], count)
            alike[i] = total / np.maximum(shown, 1)
        boxes = [detections[i].box for i in range(known)] + [box for box, _ in surfaces]
        label = detections[0].label if detections else UNKNOWN
        parts = {}
        became = np.full(count + 1, NOBODY, pieces.dtype)  # the last: of what is nobody's
        for group in same_parts(alike, sure, config.same_part_probability):
            first = group[0]
            if first >= known and shown[group].sum() < config.min_part_pixels:
                continue
            became[group] = first
            box = union([boxes[i] for i in group])
            parts[first] = replace(detections.get(first, Detection(label, 0.0, box)), box=box)
        return parts, became[pieces], became

    def _estimate(
        self,
        view: _View,
        detections: dict[int, Detection],
        owners: np.ndarray,
        seconds: dict[str, float],
        strict: bool,
    ) -> Look:
        """strict: an object without pixels or grasps of its own has no grasps. Else any in its box
        will do: of whatever part it is, the next look shows what came of it."""
        start = time.perf_counter()
        size = self.estimator.input_px
        boxes = [detection.box for detection in detections.values()]
        windows = tuple(crop_window(view.depth, view.empty_depth, box, size) for box in boxes)
        estimates: list[list[Any]] = []
        if windows:
            estimates = self.estimator.predict(
                np.stack([w.depth for w in windows]), np.stack(view.tables(windows, size))
            )
        estimated = time.perf_counter()
        lies = lies_on(owners, view.heights, self.config.min_height)
        covered = dict(enumerate(lies.max(axis=1, initial=0).tolist()))
        objects = tuple(
            replace(
                self._object(
                    i, detection, window, grasps, view.depth, view.empty_depth, owners, strict
                ),
                covered_px=covered.get(i, 0),
            )
            for (i, detection), window, grasps in zip(
                detections.items(), windows, estimates, strict=True
            )
        )
        decoded = time.perf_counter()
        objects = self._foreseen(objects, view, owners)
        end = time.perf_counter()
        seconds = seconds | {
            "grasp": estimated - start,
            "decode": decoded - estimated,
            "foresee": end - decoded,
        }
        seconds["total"] = sum(seconds.values())
        return Look(view.color, view.depth, view.empty_depth, objects, windows, owners, seconds)

    def _foreseen(
        self, objects: tuple[ObjectGrasps, ...], view: _View, owners: np.ndarray
    ) -> tuple[ObjectGrasps, ...]:
        """The objects with their grasps' quality times the probability that no other part
        moves; best first."""
        pairs = [(o, grasp) for o in objects for grasp in o.grasps]
        if not pairs:
            return objects
        views = [
            grasp_view(view.heights, view.grey, owners, o.object_id, grasp) for o, grasp in pairs
        ]
        outcomes = self.outcomes.predict(np.stack(views))
        grasps: dict[int, list[GraspRectangle]] = {o.object_id: [] for o in objects}
        for (o, grasp), (_, still) in zip(pairs, outcomes, strict=True):
            grasps[o.object_id].append(replace(grasp, quality=grasp.quality * float(still)))
        return tuple(
            replace(o, grasps=tuple(sorted(grasps[o.object_id], key=lambda g: -g.quality)))
            for o in objects
        )

    def _object(
        self,
        object_id: int,
        detection: Detection,
        window: Window,
        estimates: Sequence[Any],
        depth: np.ndarray,
        empty_depth: np.ndarray,
        owners: np.ndarray,
        strict: bool,
    ) -> ObjectGrasps:
        config, box = self.config, detection.box
        seen = object_mask(depth, empty_depth, box, config.min_height)
        owned = owners[box.slices]
        mask = seen & (owned == object_id)
        if np.count_nonzero(mask) < config.min_pixels:  # unlike all that masks were learnt from
            mask = seen & (owned == NOBODY)
        proposed = [in_image(estimate, window) for estimate in estimates]
        least = config.min_own_share
        if np.count_nonzero(mask) < config.min_pixels:  # a second box of another object
            mask, own = np.zeros_like(seen) if strict else seen, []
        else:
            own = [g for g in proposed if own_share(seen, mask, box, g) >= least]
        if own or strict:
            proposed = own
        kept = select(
            proposed,
            detection,
            config.candidates,
            config.min_distance_px,
            config.min_angle_rad,
        )
        if config.rim_quality > 0:
            heights = empty_depth[box.slices] - depth[box.slices]
            kept += rim_grasps(mask, heights, box, config.rim_quality)
        if config.shank_quality > 0 and strict:
            kept += shank_grasps(mask, box, config.shank_quality)
        covered = covered_share(depth, mask, box, config.max_step) / config.covered_scale
        free = math.exp(-covered * covered)
        radius = config.grasp_depth_radius_px
        u, v, pixels = centroid(mask, box)
        return ObjectGrasps(
            object_id=object_id,
            label=detection.label,
            score=detection.score,
            box=box,
            centroid_u_px=u,
            centroid_v_px=v,
            centroid_depth_m=float(np.median(depth[box.slices][mask])) if pixels else math.nan,
            valid_pixels=pixels,
            grasps=tuple(
                replace(
                    grasp,
                    quality=grasp.quality * free,
                    depth_m=grasp_depth(depth, mask, box, grasp, radius),
                )
                for grasp in kept
            ),
        )


def load_perception(path: str | Path = DEFAULT_CONFIG, backend: str = "") -> Perception:
    """Perception with the weights that a config file names. backend: in place of the config's,
    for all networks. Raises PerceptionError."""
    from iwgnet_grasp.networks.backends import BackendError
    from iwgnet_grasp.networks.inference import GraspEstimator
    from iwgnet_grasp.networks.object_mask import MaskEstimator
    from iwgnet_grasp.networks.pick_outcome import OutcomeEstimator
    from iwgnet_grasp.networks.same_part import SamePartEstimator
    from iwgnet_grasp.networks.weights import WeightsError
    from iwgnet_grasp.perception.detector import Detector

    config = PerceptionConfig.load(path)
    detector = Detector(
        config.detector_weights,
        score_threshold=config.score_threshold,
        iou_threshold=config.iou_threshold,
        max_objects=config.max_objects,
        backend=backend or config.detector_backend,
        region=config.detector_region,
    )
    try:
        estimator = GraspEstimator(config.grasp_weights, backend or config.grasp_backend)
        masks = MaskEstimator(config.mask_weights, backend or config.mask_backend)
        outcomes = OutcomeEstimator(config.outcome_weights, backend or config.outcome_backend)
        same_part = SamePartEstimator(config.same_part_weights, backend or config.same_part_backend)
    except (WeightsError, BackendError) as error:
        raise PerceptionError(str(error)) from error
    return Perception(config, detector, estimator, masks, outcomes, same_part)


def checked_color(color: np.ndarray) -> np.ndarray:
    """The colour image, contiguous (H, W, 3) uint8. Raises PerceptionError."""
    color = np.asarray(color)
    if color.ndim != 3 or color.shape[2] != 3 or color.size == 0:
        raise PerceptionError(f"color: shape {color.shape} is not an RGB image (H, W, 3)")
    if color.dtype != np.uint8:
        raise PerceptionError(f"color: type {color.dtype} is not rgb8 (uint8)")
    return np.ascontiguousarray(color)


def in_image(estimate: Any, window: Window) -> GraspRectangle:
    """A grasp in window px -> full-image px. The window has the image's own resolution."""
    return GraspRectangle(
        x_px=float(estimate.x_px) + window.x,
        y_px=float(estimate.y_px) + window.y,
        theta_rad=float(wrap_theta(estimate.theta_rad)),
        width_px=float(estimate.width_px),
        quality=float(estimate.quality),
    )


def select(
    grasps: Sequence[GraspRectangle],
    detection: Detection,
    count: int,
    min_distance_px: float,
    min_angle_rad: float,
) -> list[GraspRectangle]:
    """The best `count` distinct grasps whose centre lies in the box, by descending quality.

    Two grasps are distinct when their centres are more than min_distance_px apart or their
    closing directions more than min_angle_rad.
    """
    kept: list[GraspRectangle] = []
    for grasp in sorted(grasps, key=lambda g: -g.quality):
        if len(kept) == count:
            break
        if detection.box.contains(grasp.x_px, grasp.y_px) and not any(
            same_grasp(grasp, other, min_distance_px, min_angle_rad) for other in kept
        ):
            kept.append(grasp)
    return kept


def same_grasp(a: GraspRectangle, b: GraspRectangle, distance_px: float, angle_rad: float) -> bool:
    """True when centres are within distance_px and closing directions within angle_rad."""
    apart = math.hypot(a.x_px - b.x_px, a.y_px - b.y_px)
    turned = angle_between(a.theta_rad, b.theta_rad)
    return apart <= distance_px and bool(turned <= angle_rad)


def _in_package(path: str) -> Path:
    path = Path(path)
    return path if path.is_absolute() else PACKAGE / path
