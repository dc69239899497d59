"""Typical inputs to try networks on, always the same: a few blocks on a table."""

import cv2
import numpy as np

from iwgnet_grasp.data.letterbox import BORDER


def probe_heights(size: int) -> np.ndarray:
    """[size, size] float32, as data.depth.normalise_depth gives them."""
    rng = np.random.default_rng(0)
    image = _with_blocks(np.zeros((size, size), np.float32), lambda: rng.uniform(0.3, 3), rng)
    return image + rng.normal(0, 0.03, image.shape).astype(np.float32)


def probe_image(size: tuple[int, int]) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB."""
    rng = np.random.default_rng(0)
    image = np.full((*size, 3), BORDER, np.uint8)
    image = _with_blocks(image, lambda: rng.integers(20, 235, 3).tolist(), rng)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def _with_blocks(image, value, rng):
    rows, columns = image.shape[:2]
    for _ in range(6):
        center = rng.uniform(0.1, 0.9, 2) * (columns, rows)
        sides = rng.uniform(0.05, 0.5, 2) * rows
        corners = cv2.boxPoints((tuple(center), tuple(sides), rng.uniform(0, 180)))
        cv2.fillConvexPoly(image, corners.astype(np.int32), value())
    return image
