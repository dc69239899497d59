"""Random views of a training image. Image and rectangles go through the same similarity."""

from dataclasses import dataclass

import cv2
import numpy as np

from iwgnet_grasp.data.grasp_rectangle import transform


@dataclass(frozen=True)
class Augmentation:
    """Rotation and mirroring, and up to the amounts below; heights in network units."""

    zoom: float = 0.12  # largest relative change of size
    shift_px: float = 8.0
    noise: float = 0.03  # largest standard deviation of white noise
    tilt: float = 0.05  # largest height of a tilted table at the border
    holes: int = 4  # most patches whose depth is lost and filled from around
    hole_px: int = 10
    any_turn: bool = True  # else quarters of a turn: an upright box stays one

    def __call__(
        self, height: np.ndarray, rectangles: np.ndarray, size: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Height [S, S] float32 and rectangles of a random crop."""
        affine = self.similarity(height.shape, size, rng)
        crop = cv2.warpAffine(height, affine, (size, size), flags=cv2.INTER_LINEAR)
        self.disturb(crop, rng)
        return crop, transform(rectangles, affine)

    def similarity(self, shape: tuple[int, int], size: int, rng: np.random.Generator) -> np.ndarray:
        """(2, 3) px of an image of this shape -> px of a random crop [size, size]."""
        angle = rng.uniform(0, 2 * np.pi)
        if not self.any_turn:
            angle = np.floor(angle / (np.pi / 2)) * np.pi / 2
        zoom = np.exp(rng.uniform(-1, 1) * np.log1p(self.zoom))
        linear = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        if rng.random() < 0.5:
            linear = linear @ np.diag([-1, 1])
        centre = (np.array(shape[::-1]) - 1) / 2 + rng.uniform(-1, 1, 2) * self.shift_px
        offset = np.full(2, (size - 1) / 2) - linear @ centre
        return np.hstack([linear, offset[:, None]])

    def disturb(self, crop: np.ndarray, rng: np.random.Generator) -> None:
        """Holes, a tilted table and noise, in place."""
        size = crop.shape[0]
        for _ in range(rng.integers(self.holes + 1)):
            w, h = rng.integers(2, self.hole_px + 1, 2)
            x, y = rng.integers(1, size - w - 1), rng.integers(1, size - h - 1)
            border = crop[y - 1 : y + h + 1, x - 1 : x + w + 1]
            ring = border.sum() - crop[y : y + h, x : x + w].sum()
            crop[y : y + h, x : x + w] = ring / (border.size - w * h)
        slope = rng.uniform(-self.tilt, self.tilt, 2)
        ramp = np.linspace(-1, 1, size, dtype=np.float32)
        crop += np.float32(slope[0]) * ramp + np.float32(slope[1]) * ramp[:, None]
        noise = rng.standard_normal(crop.shape, dtype=np.float32)
        crop += noise * np.float32(rng.uniform(0, self.noise))


def centre_crop(
    height: np.ndarray, rectangles: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """The middle [S, S] of a view of at least that size, and the rectangles in it."""
    top, left = ((n - size) // 2 for n in height.shape)
    moved = transform(rectangles, np.array([[1, 0, -left], [0, 1, -top]], np.float64))
    return np.ascontiguousarray(height[top : top + size, left : left + size]), moved
