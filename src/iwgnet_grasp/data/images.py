"""Depth images on disk."""

from pathlib import Path

import cv2
import numpy as np
import tifffile

from iwgnet_grasp.data.errors import DataError


def read_depth(path: Path) -> np.ndarray:
    """float32 [H, W] as stored. DataError when missing, truncated or of another type."""
    if not path.is_file():
        raise DataError(f"{path}: no such depth image")
    try:
        image = tifffile.imread(path)
    except Exception as error:  # tifffile raises whatever its parsing trips over
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if "codec" in str(error) else None
        if image is None:
            raise DataError(f"{path}: not a whole TIFF image ({_line(error)})") from None
    if image.size == 0:
        raise DataError(f"{path}: not a whole TIFF image (no pixels)")
    if image.ndim != 2 or image.dtype != np.float32:
        raise DataError(f"{path}: must be one channel of float32, is {image.dtype} {image.shape}")
    return image


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
