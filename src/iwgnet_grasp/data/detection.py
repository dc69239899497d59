"""Images and boxes to train the object detector on, in COCO's layout, and their augmentation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from iwgnet_grasp.data.errors import DataError

BORDER = 114  # grey around a letterboxed image


@dataclass(frozen=True)
class Letterbox:
    """How an image was fitted into the network's input: input px = scale * image px + offset."""

    scale: float
    left: float
    top: float

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Corner boxes (N, 4) in input px -> image px."""
        offset = np.array([self.left, self.top] * 2)
        return (boxes - offset) / self.scale

    def to_input(self, boxes: np.ndarray) -> np.ndarray:
        """Corner boxes (N, 4) in image px -> input px."""
        return boxes * self.scale + np.array([self.left, self.top] * 2)


def letterbox(image: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, Letterbox]:
    """The whole image in (rows, columns), its aspect ratio kept, the rest grey.

    Pixels here count from the image's corner: a box's edge lies on the border of two pixels.
    """
    rows, columns = image.shape[:2]
    scale = min(size[0] / rows, size[1] / columns)
    height, width = min(round(rows * scale), size[0]), min(round(columns * scale), size[1])
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    fitted = np.full((*size, 3), BORDER, np.uint8)
    fitted[top : top + height, left : left + width] = cv2.resize(
        image, (width, height), interpolation=method
    )
    return fitted, Letterbox(scale, left, top)


@dataclass(frozen=True)
class DetectionScene:
    """One image in the network's input size with its true boxes."""

    name: str
    image: np.ndarray  # (rows, columns, 3) uint8 RGB
    boxes: np.ndarray  # (N, 4) float32 corners x1, y1, x2, y2 in px of `image`
    labels: np.ndarray  # (N,) int64 index into the set's classes


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
    folder: str | Path, size: tuple[int, int], limit: int | None = None, workers: int = 2
) -> DetectionSet:
    """Reads FOLDER/detector/{annotations.json, images/*.png}; images letterboxed to `size`.

    folder: a data set made by 'iwgnet dataset' (or its detector folder). limit: at most that many
    scenes. Boxes of COCO [x, y, width, height]; crowd regions are left out. Classes are ordered by
    category id. Raises DataError.
    """
    root = Path(folder)
    root = root / "detector" if (root / "detector").is_dir() else root
    path = root / "annotations.json"
    try:
        text = json.loads(path.read_text())
        categories = sorted(text["categories"], key=lambda c: c["id"])
        index = {c["id"]: i for i, c in enumerate(categories)}
        boxes: dict[int, list[tuple[list[float], int]]] = {i["id"]: [] for i in text["images"]}
        for annotation in text["annotations"]:
            if not annotation.get("iscrowd", 0):
                x, y, w, h = (float(v) for v in annotation["bbox"])
                boxes[annotation["image_id"]].append(
                    ([x, y, x + w, y + h], index[annotation["category_id"]])
                )
        images = sorted(text["images"], key=lambda i: i["file_name"])[:limit]
        files = [(i["id"], root / "images" / Path(i["file_name"]).name) for i in images]
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; make data with 'iwgnet dataset'") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        line = " ".join(str(error).split())
        raise DataError(f"{path}: not COCO annotations ({line})") from None
    if not files or not categories:
        raise DataError(f"{path}: names no images or no categories")

    def read(entry: tuple[int, Path]) -> DetectionScene:
        identifier, file = entry
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if image is None:
            raise DataError(f"{file}: missing or not an image")
        fitted, fit = letterbox(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), size)
        corners = np.array([b for b, _ in boxes[identifier]], np.float64).reshape(-1, 4)
        labels = np.array([label for _, label in boxes[identifier]], np.int64)
        return DetectionScene(file.stem, fitted, fit.to_input(corners).astype(np.float32), labels)

    with ThreadPoolExecutor(workers) as pool:
        scenes = tuple(pool.map(read, files))
    return DetectionSet(scenes, tuple(str(c["name"]) for c in categories))


@dataclass(frozen=True)
class Augmentation:
    """Random change of a training image. The camera looks down, so every turn is a valid view."""

    scale: float = 1.25  # zoom between 1/scale and scale
    brightness: float = 0.35  # gain of the value channel, +-
    saturation: float = 0.5
    hue: float = 0.02  # of a full turn, +-
    noise: float = 6.0  # greatest standard deviation of pixel noise, grey levels
    min_visible: float = 0.25  # least part of a box inside the window for it to count


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

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng((*self.seed, index))
        scene = self.scenes[rng.integers(len(self.scenes))]
        matrix = self._view(scene, rng)
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

    def _view(self, scene: DetectionScene, rng: np.random.Generator) -> np.ndarray:
        """(2, 3) affine: scene px -> window px. A quarter turn, a flip, a zoom, a place."""
        rows, columns = self.size
        zoom = self.zoom * self.augmentation.scale ** rng.uniform(-1, 1)
        turn = rng.integers(4) * np.pi / 2
        linear = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if rng.random() < 0.5:
            linear[0] *= -1
        linear[np.abs(linear) < 1e-9] = 0.0
        scene_rows, scene_columns = scene.image.shape[:2]
        if len(scene.boxes) and rng.random() < 0.85:
            box = scene.boxes[rng.integers(len(scene.boxes))]
            looked_at = (box[:2] + box[2:]) / 2
        else:
            looked_at = rng.uniform((0, 0), (scene_columns, scene_rows))
        # The point looked at may appear anywhere but near the edge, where its object is cut.
        place = np.array([columns, rows]) * rng.uniform(0.25, 0.75, 2)
        if rows >= scene_rows * zoom and columns >= scene_columns * zoom:
            looked_at = np.array([scene_columns, scene_rows]) / 2  # the whole scene fits
            place = np.array([columns, rows]) * rng.uniform(0.45, 0.55, 2)
        return np.hstack([linear, (place - linear @ looked_at)[:, None]])

    def _boxes(self, scene: DetectionScene, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = self.size
        corners = scene.boxes.reshape(-1, 2, 2) @ matrix[:, :2].T + matrix[:, 2]
        low, high = corners.min(1), corners.max(1)
        limit = np.array([columns, rows])
        inside = np.hstack([np.clip(low, 0, limit), np.clip(high, 0, limit)])
        visible = np.prod(inside[:, 2:] - inside[:, :2], 1) / np.prod(high - low, 1).clip(1e-6)
        kept = (visible >= self.augmentation.min_visible) & (
            (inside[:, 2:] - inside[:, :2]).min(1, initial=np.inf) > 2
        )
        return inside[kept].astype(np.float32), scene.labels[kept]


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
