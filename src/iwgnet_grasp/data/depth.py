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


def support_plane(depth: np.ndarray, around: tuple[int, int, int, int] | None = None) -> np.ndarray:
    """Depth [H, W] (m) of the plane that most of the image shows.

    around: (top, left, height, width) of a larger image that this one is a part of, the upper left
    corner counted from this one's and not positive: the plane there.
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
    a, b = u[valid] / scale, v[valid] / scale
    one = np.ones_like(a)
    basis = np.stack([a, b, one])
    products = np.stack([a * a, a * b, a, b * b, b, one])  # of the normal equations
    target = z[valid].astype(np.float64)
    # The table lies between the object and what merging has mirrored below it.
    plane = np.array([0.0, 0.0, np.median(target)])
    for residual_scale in _PLANE_SCALES:
        residual = (target - plane @ basis) / residual_scale
        residual = np.maximum(residual, -2 * residual)
        weight = 1 / (1 + residual**2)
        aa, ab, a1, bb, b1, n = products @ weight
        normal = np.array([[aa, ab, a1], [ab, bb, b1], [a1, b1, n]]) + 1e-9 * np.eye(3)
        plane = np.linalg.solve(normal, basis @ (weight * target))
    top, left, rows, columns = around or (0, 0, height, width)
    row = plane[0] * np.arange(left, left + columns) / scale + plane[2]
    column = plane[1] * np.arange(top, top + rows) / scale
    return (column[:, None] + row[None, :]).astype(np.float32)


def fill_holes(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Invalid pixels get the mean of the valid ones around them, in growing windows (inpainting).

    float32 [H, W]; an image without valid pixels becomes 0.
    """
    if valid.all():
        return values.astype(np.float32, copy=False)
    counts = valid.astype(np.float32)
    filled = np.where(valid, values, 0).astype(np.float32)
    sums, pixels = filled.copy(), filled.ravel()
    missing = np.flatnonzero(~valid)
    window = 5
    while missing.size and window <= max(values.shape):
        blur = (window, window)
        weight = cv2.blur(counts, blur, borderType=cv2.BORDER_CONSTANT).ravel()[missing]
        value = cv2.blur(sums, blur, borderType=cv2.BORDER_CONSTANT).ravel()[missing]
        found = weight > 1e-6
        pixels[missing[found]] = value[found] / weight[found]
        missing = missing[~found]
        window = 4 * window + 1
    if missing.size and valid.any():  # nothing valid within half the image
        pixels[missing] = values[valid].mean()
    return filled


def normalise_depth(depth: np.ndarray, table: np.ndarray | None = None) -> np.ndarray:
    """Network input [H, W] float32: height above the table in units of HEIGHT_UNIT, holes filled.

    depth: m, invalid where not finite or <= 0. table: depth of the table's plane where it is known
    (support_plane of the empty scene), else it is fitted to `depth` itself. The plane and not the
    pixels of the empty scene is subtracted, so that noise, holes and what a merged depth took over
    from it look alike in both cases.
    """
    plane = support_plane(depth) if table is None else table
    valid = valid_depth(depth)
    height = np.where(valid, (plane - depth) / HEIGHT_UNIT, 0)
    return np.clip(fill_holes(height, valid), *HEIGHT_CLIP)
