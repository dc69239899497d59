"""Depth image -> network input: height above the table. One function for training and inference."""

import cv2
import numpy as np

# Height (m) that the network sees as 1: parts are some 20 mm thick. Negative heights are
# what lies around the object (perception.merged_depth.merge).
HEIGHT_UNIT = 0.02
HEIGHT_CLIP = (-5.0, 5.0)
_PLANE_STEP = 4  # px between the samples that the plane is fitted to
_PLANE_SCALES = (0.03, 0.015, 0.008, 0.004, 0.003, 0.003)  # m, residual at half weight, by round


def valid_depth(depth: np.ndarray) -> np.ndarray:
    """True where a depth exists: finite and positive (NaN, 0 and Jacquard's -1 are not)."""
    return np.isfinite(depth) & (depth > 0)


def support_plane(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W] (m) of the plane that most of the image shows.

    Iteratively reweighted least squares of z = a u + b v + c with Cauchy weights; pixels nearer
    than the plane, which are objects, lose weight twice as fast as farther ones. ValueError when
    fewer than ten samples are valid.
    """
    height, width = depth.shape
    v, u = np.mgrid[0:height:_PLANE_STEP, 0:width:_PLANE_STEP]
    z = depth[::_PLANE_STEP, ::_PLANE_STEP]
    valid = valid_depth(z)
    if np.count_nonzero(valid) < 10:
        raise ValueError("depth image has no valid pixels to find the table in")
    scale = float(max(height, width))
    basis = np.stack([u[valid] / scale, v[valid] / scale, np.ones(valid.sum())], axis=1)
    target = z[valid].astype(np.float64)
    # The table lies between the object and what merging has mirrored below it.
    plane = np.array([0.0, 0.0, np.median(target)])
    for residual_scale in _PLANE_SCALES:
        residual = (target - basis @ plane) / residual_scale
        residual[residual < 0] *= 2
        weight = 1 / (1 + residual**2)
        weighted = basis * weight[:, None]
        normal = weighted.T @ basis + 1e-9 * np.eye(3)
        plane = np.linalg.solve(normal, weighted.T @ target)
    row = plane[0] * np.arange(width) / scale + plane[2]
    column = plane[1] * np.arange(height) / scale
    return (column[:, None] + row[None, :]).astype(np.float32)


def fill_holes(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Invalid pixels get the mean of the valid ones around them, in growing windows (inpainting).

    float32 [H, W]; an image without valid pixels becomes 0.
    """
    if valid.all():
        return values.astype(np.float32, copy=False)
    weight = valid.astype(np.float32)
    filled = np.where(valid, values, 0).astype(np.float32)
    missing = ~valid
    window = 5
    sums, counts = filled.copy(), weight.copy()
    while missing.any() and window <= max(values.shape):
        blur = (window, window)
        mean_weight = cv2.blur(counts, blur, borderType=cv2.BORDER_CONSTANT)
        mean_value = cv2.blur(sums, blur, borderType=cv2.BORDER_CONSTANT)
        found = missing & (mean_weight > 1e-6)
        filled[found] = mean_value[found] / mean_weight[found]
        missing &= ~found
        window = 4 * window + 1
    if missing.any() and valid.any():  # nothing valid within half the image
        filled[missing] = values[valid].mean()
    return filled


def normalise_depth(depth: np.ndarray, empty: np.ndarray | None = None) -> np.ndarray:
    """Network input [H, W] float32: height above the table in units of HEIGHT_UNIT, holes filled.

    depth: m, invalid where not finite or <= 0. The table is the plane fitted to `empty`, the depth
    of the same view without objects, where there is one, else to `depth` itself. The plane and not
    the pixels of `empty` is subtracted, so that noise, holes and what a merged depth took over from
    the empty scene look alike with and without it.
    """
    plane = support_plane(depth if empty is None else empty)
    valid = valid_depth(depth)
    height = np.where(valid, (plane - depth) / HEIGHT_UNIT, 0)
    return np.clip(fill_holes(height, valid), *HEIGHT_CLIP)
