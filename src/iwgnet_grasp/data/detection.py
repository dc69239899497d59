"""Images and boxes to train the object detector on, in COCO's layout, and their augmentation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from pycocotools import mask as coco_mask
from torch.utils.data import Dataset

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.letterbox import BORDER, WHOLE, Region, letterbox


@dataclass(frozen=True)
class DetectionScene:
    """One image in the network's input size with its true boxes."""

    name: str
    image: np.ndarray  # (rows, columns, 3) uint8 RGB
    boxes: np.ndarray  # (N, 4) float32 corners x1, y1, x2, y2 in px of `image`
    labels: np.ndarray  # (N,) int64 index into the set's classes
    # N outlines (K, 2) float32 x, y px of what is seen of each object, less than a pixel between
    # two points; none where the set has no masks.
    outlines: tuple[np.ndarray, ...] = ()
    arrangement: str = ""  # of the parts, where the set says it


@dataclass(frozen=True)
class DetectionSet:
    scenes: tuple[DetectionScene, ...]
    classes: tuple[str, ...]

    def split(self, fraction: float) -> tuple[DetectionSet, DetectionSet]:
        """Scenes to train on and the last `fraction` of them, at least one, to test with."""
        held_out = max(1, round(len(self.scenes) * fraction))
        if held_out >= len(self.scenes):
            raise DataError(
                f"{len(self.scenes)} scenes cannot be split into training and test; make more"
            )
        return (
            DetectionSet(self.scenes[:-held_out], self.classes),
            DetectionSet(self.scenes[-held_out:], self.classes),
        )


def load_detection_set(
    folder: str | Path,
    size: tuple[int, int],
    limit: int | None = None,
    workers: int = 2,
    region: Region = WHOLE,
) -> DetectionSet:
    """Reads FOLDER/detector/{annotations.json, images/*.png}; the images' region fitted to `size`.

    folder: a data set made by 'iwgnet dataset' (or its detector folder). limit: at most that many
    scenes. Boxes of COCO [x, y, width, height], masks polygons or run-length codes; crowd regions
    are left out. Classes are ordered by category id. Raises DataError.
    """
    root = Path(folder)
    root = root / "detector" if (root / "detector").is_dir() else root
    path = root / "annotations.json"
    try:
        text = json.loads(path.read_text())
        categories = sorted(text["categories"], key=lambda c: c["id"])
        index = {c["id"]: i for i, c in enumerate(categories)}
        objects: dict[int, list[_Object]] = {i["id"]: [] for i in text["images"]}
        for annotation in text["annotations"]:
            if not annotation.get("iscrowd", 0):
                x, y, w, h = (float(v) for v in annotation["bbox"])
                objects[annotation["image_id"]].append(
                    _Object(
                        (x, y, x + w, y + h),
                        index[annotation["category_id"]],
                        annotation.get("segmentation"),
                    )
                )
        images = sorted(text["images"], key=lambda i: i["file_name"])[:limit]
        files = [
            (i["id"], root / "images" / Path(i["file_name"]).name, str(i.get("arrangement", "")))
            for i in images
        ]
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; make data with 'iwgnet dataset'") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        line = " ".join(str(error).split())
        raise DataError(f"{path}: not COCO annotations ({line})") from None
    if not files or not categories:
        raise DataError(f"{path}: names no images or no categories")

    def read(entry: tuple[int, Path, str]) -> DetectionScene:
        identifier, file, arrangement = entry
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if image is None:
            raise DataError(f"{file}: missing or not an image")
        fitted, fit = letterbox(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), size, region)
        found = objects[identifier]
        corners = np.array([o.corners for o in found], np.float64).reshape(-1, 4)
        outlines = ()
        if all(o.segmentation for o in found):
            try:
                points = [outline(o.segmentation, image.shape[:2]) for o in found]
            except (KeyError, TypeError, ValueError) as error:
                raise DataError(f"{path}: a mask of {file.name} cannot be read ({error})") from None
            outlines = tuple(
                fit.to_input(np.hstack([p, p]))[:, :2].astype(np.float32) for p in points
            )
        return DetectionScene(
            file.stem,
            fitted,
            fit.to_input(corners).astype(np.float32),
            np.array([o.label for o in found], np.int64),
            outlines,
            arrangement,
        )

    with ThreadPoolExecutor(workers) as pool:
        scenes = tuple(pool.map(read, files))
    return DetectionSet(scenes, tuple(str(c["name"]) for c in categories))


@dataclass(frozen=True)
class _Object:
    """A COCO annotation: corners x1, y1, x2, y2 px, class index, mask or None."""

    corners: tuple[float, float, float, float]
    label: int
    segmentation: Any


def outline(segmentation: Any, shape: tuple[int, int]) -> np.ndarray:
    """(K, 2) x, y: the corners of the pixels around a COCO mask in an image of (rows, columns)."""
    if isinstance(segmentation, list):
        segmentation = coco_mask.merge(coco_mask.frPyObjects(segmentation, *shape))
    elif isinstance(segmentation["counts"], list):
        segmentation = coco_mask.frPyObjects(segmentation, *shape)
    contours, _ = cv2.findContours(
        coco_mask.decode(segmentation), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    pixels = np.concatenate([c[:, 0] for c in contours])
    corners = pixels[:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    return np.unique(corners.reshape(-1, 2), axis=0)


def box_outline(box: np.ndarray) -> np.ndarray:
    """(K, 2) points along the edges of a corner box, at most a pixel apart."""
    x1, y1, x2, y2 = box
    x, y = np.linspace(x1, x2, int(x2 - x1) + 2), np.linspace(y1, y2, int(y2 - y1) + 2)
    return np.vstack(
        [
            np.column_stack(np.broadcast_arrays(*side))
            for side in ((x, y1), (x, y2), (x1, y), (x2, y))
        ]
    )


@dataclass(frozen=True)
class Augmentation:
    """Random change of a training image. The camera looks down, so every turn is a valid view."""

    scale: float = 1.15  # zoom between 1/scale and scale
    any_turn: float = 0.5  # share of the windows turned by any angle, where there are masks; the
    # others turn by quarters
    brightness: float = 0.35  # gain of the value channel, +-
    saturation: float = 0.5
    hue: float = 0.02  # of a full turn, +-
    noise: float = 6.0  # greatest standard deviation of pixel noise, grey levels
    min_visible: float = 0.25  # least part of an outline inside the window for it to count


class DetectionWindows(Dataset):
    """`count` random windows of the scenes, a function of (seed, epoch, index) alone.

    size: (rows, columns) of a window; zoom: its magnification against the scenes' own size. Items
    are (image (3, rows, columns) uint8, boxes (N, 4) float32 corners in px, labels (N,) int64).
    """

    def __init__(
        self,
        scenes: Sequence[DetectionScene],
        count: int,
        size: tuple[int, int],
        zoom: float,
        seed: int,
        epoch: int,
        augmentation: Augmentation | None = None,
    ) -> None:
        self.scenes = scenes
        self.count = count
        self.size = size
        self.zoom = zoom
        self.seed = (seed, epoch)
        self.augmentation = augmentation or Augmentation()
        # Piles are what is hard: an object is looked at once for itself and once for each
        # neighbour whose box overlaps its own.
        self.objects = [
            (i, k)
            for i, scene in enumerate(scenes)
            for k, count in enumerate(overlapping(scene.boxes))
            for _ in range(1 + count)
        ]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng((*self.seed, index))
        if self.objects and rng.random() < 0.9:
            i, k = self.objects[rng.integers(len(self.objects))]
            scene = self.scenes[i]
            looked_at = (scene.boxes[k, :2] + scene.boxes[k, 2:]) / 2
        else:
            scene = self.scenes[rng.integers(len(self.scenes))]
            looked_at = rng.uniform((0, 0), scene.image.shape[1::-1])
        matrix = self._view(scene, looked_at, rng)
        rows, columns = self.size
        # Boxes count from the corner of a pixel, warpAffine from its middle.
        half = matrix[:, :2].sum(1, keepdims=True) / 2 - 0.5
        image = cv2.warpAffine(
            scene.image,
            np.hstack([matrix[:, :2], matrix[:, 2:] + half]),
            (columns, rows),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(BORDER, BORDER, BORDER),
        )
        image = recolour(image, self.augmentation, rng)
        boxes, labels = self._boxes(scene, matrix)
        pixels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
        return pixels, torch.from_numpy(boxes), torch.from_numpy(labels)

    def _view(
        self, scene: DetectionScene, looked_at: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """(2, 3) affine: scene px -> window px. A turn, a flip, a zoom, a place."""
        rows, columns = self.size
        zoom = self.zoom * self.augmentation.scale ** rng.uniform(-1, 1)
        turn = rng.integers(4) * np.pi / 2
        if rng.random() < self.augmentation.any_turn and scene.outlines:
            turn = rng.uniform(0, 2 * np.pi)
        linear = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if rng.random() < 0.5:
            linear[0] *= -1
        linear[np.abs(linear) < 1e-9] = 0.0
        scene_rows, scene_columns = scene.image.shape[:2]
        # The point looked at may appear anywhere but near the edge, where its object is cut.
        place = np.array([columns, rows]) * rng.uniform(0.25, 0.75, 2)
        if rows >= scene_rows * zoom and columns >= scene_columns * zoom:
            looked_at = np.array([scene_columns, scene_rows]) / 2  # the whole scene fits
            place = np.array([columns, rows]) * rng.uniform(0.45, 0.55, 2)
        return np.hstack([linear, (place - linear @ looked_at)[:, None]])

    def _boxes(self, scene: DetectionScene, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of what the window shows of each object: a cut object's box ends where it is cut."""
        rows, columns = self.size
        boxes, labels = [], []
        outlines = scene.outlines or [box_outline(box) for box in scene.boxes]
        for points, label in zip(outlines, scene.labels, strict=True):
            points = points @ matrix[:, :2].T + matrix[:, 2]
            inside = points[((points >= 0) & (points <= (columns, rows))).all(1)]
            if len(inside) < max(self.augmentation.min_visible * len(points), 1):
                continue
            low, high = inside.min(0), inside.max(0)
            if (high - low).min() > 2:
                boxes.append([*low, *high])
                labels.append(label)
        return np.array(boxes, np.float32).reshape(-1, 4), np.array(labels, np.int64)


def overlapping(boxes: np.ndarray) -> np.ndarray:
    """How many of the other corner boxes (N, 4) overlap each one -> (N,)."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    return (high > low).all(-1).sum(1) - 1


def recolour(image: np.ndarray, change: Augmentation, rng: np.random.Generator) -> np.ndarray:
    """Another light: gains on hue, saturation and value, and pixel noise."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    level = np.arange(256)
    value = level * (1 + change.brightness * rng.uniform(-1, 1))
    saturation = level * (1 + change.saturation * rng.uniform(-1, 1))
    hue = (level + 180 * change.hue * rng.uniform(-1, 1)) % 180
    tables = [np.clip(t, 0, 255).astype(np.uint8) for t in (hue, saturation, value)]
    channels = [cv2.LUT(c, t) for c, t in zip(cv2.split(hsv), tables, strict=True)]
    image = cv2.cvtColor(cv2.merge(channels), cv2.COLOR_HSV2RGB)
    sigma = rng.uniform(-1, 1) * change.noise  # half of the images stay clean
    if sigma > 0.5:
        noise = rng.standard_normal(image.shape, np.float32) * sigma
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    return image


class WholeScenes(Dataset):
    """The scenes as they are, in order; items as DetectionWindows."""

    def __init__(self, scenes: Sequence[DetectionScene]) -> None:
        self.scenes = scenes

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        scene = self.scenes[index]
        pixels = torch.from_numpy(np.ascontiguousarray(scene.image.transpose(2, 0, 1)))
        return pixels, torch.from_numpy(scene.boxes), torch.from_numpy(scene.labels)


def collate(
    items: Sequence[tuple[torch.Tensor, torch.Tensor, torch.Tensor]],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B, 3, H, W) uint8 and targets (M, 6) float32: image, class, centre x, y, width,
    height in px."""
    targets = []
    for i, (_, boxes, labels) in enumerate(items):
        rows = torch.empty(len(boxes), 6)
        rows[:, 0] = i
        rows[:, 1] = labels
        rows[:, 2:4] = (boxes[:, :2] + boxes[:, 2:]) / 2
        rows[:, 4:] = boxes[:, 2:] - boxes[:, :2]
        targets.append(rows)
    return torch.stack([image for image, _, _ in items]), torch.cat(targets)
