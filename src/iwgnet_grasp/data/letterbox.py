"""A region of an image fitted into a network's input, and boxes from one to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

BORDER = 114  # grey around a letterboxed image
Region = tuple[float, float, float, float]  # left, top, right, bottom as parts of the image's size
WHOLE: Region = (0.0, 0.0, 1.0, 1.0)


def checked_region(value: Sequence[float]) -> Region:
    """Raises ValueError for what is not left < right, top < bottom in [0, 1]."""
    left, top, right, bottom = (float(v) for v in value)
    if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
        raise ValueError(f"region {value} is not left, top, right, bottom in 0..1")
    return left, top, right, bottom


def region_corners(shape: Sequence[int], region: Region) -> tuple[int, int, int, int]:
    """Left, top, right and bottom px of the region of an image (rows, columns, ...)."""
    left, right = (round(shape[1] * part) for part in region[::2])
    top, bottom = (round(shape[0] * part) for part in region[1::2])
    return left, top, right, bottom


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


def letterbox(
    image: np.ndarray, size: tuple[int, int], region: Region = WHOLE
) -> tuple[np.ndarray, Letterbox]:
    """A region of the image in (rows, columns), its aspect ratio kept, the rest grey.

    Pixels here count from the image's corner: a box's edge lies on the border of two pixels.
    """
    x1, y1, x2, y2 = region_corners(image.shape, region)
    image = image[y1:y2, x1:x2]
    rows, columns = image.shape[:2]
    scale = min(size[0] / rows, size[1] / columns)
    height, width = min(round(rows * scale), size[0]), min(round(columns * scale), size[1])
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    fitted = np.full((*size, 3), BORDER, np.uint8)
    fitted[top : top + height, left : left + width] = cv2.resize(
        image, (width, height), interpolation=method
    )
    return fitted, Letterbox(scale, left - scale * x1, top - scale * y1)
