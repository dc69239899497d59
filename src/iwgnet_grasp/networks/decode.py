"""Maps -> grasps."""

import cv2
import numpy as np

from iwgnet_grasp.data.grasp_rectangle import Grasp, wrap_theta
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX

# px. GG-CNN's 2 would blunt the narrow peaks (a third of a 20 px opening) more than the wide ones.
Q_SIGMA = 1.0
MAP_SIGMA = 1.0  # px, of cos, sin and width
# px (about mm at 0.6 m), across the closing direction. The best place on a shank is often right
# beside a shoulder, where three millimetres decide between a face and an edge under the pads: a
# grasp counts as what it is worth on average over so much error of its place.
PLACE_SIGMA = 3.0
PLACE_DISTANCE = 12  # px, half a pad, of further places on a ridge of the quality


def decode_grasps(
    q: np.ndarray,
    cos: np.ndarray,
    sin: np.ndarray,
    width: np.ndarray,
    max_grasps: int = 20,
    min_distance_px: int = 6,
    threshold: float = 0.02,
) -> list[Grasp]:
    """Local maxima of the expected quality and, while they are fewer than `max_grasps`, the best
    places between them; best first. All maps float32 [H, W].

    cos 2theta and sin 2theta are smoothed, never the angle, which jumps at +-90 deg. Where two
    directions are as likely (where the arms of a tee meet) a network gives their mean, which is
    short and points at neither: a grasp's quality counts by the length of (cos, sin). Grasps closer
    than `min_distance_px` to a better one and below `threshold` are left out.
    """
    q = q * np.minimum(np.hypot(cos, sin), 1)
    q = cv2.GaussianBlur(q, (0, 0), Q_SIGMA)
    cos = cv2.GaussianBlur(cos, (0, 0), MAP_SIGMA)
    sin = cv2.GaussianBlur(sin, (0, 0), MAP_SIGMA)
    width = cv2.GaussianBlur(width, (0, 0), MAP_SIGMA)
    q = expected_quality(q, cos, sin, PLACE_SIGMA, threshold)
    grasps = []
    peaks = local_maxima(q, min_distance_px, threshold, max_grasps)
    places = peaks + places_between(q, peaks, threshold, max_grasps - len(peaks))
    for y, x in sorted(places, key=lambda place: -q[place]):
        theta = float(wrap_theta(0.5 * np.arctan2(sin[y, x], cos[y, x])))
        opening = max(float(width[y, x]), 0.0) * WIDTH_REFERENCE_PX
        quality = float(np.clip(q[y, x], 0, 1))
        grasps.append(Grasp(float(x), float(y), theta, opening, quality))
    return grasps


def expected_quality(
    q: np.ndarray, cos: np.ndarray, sin: np.ndarray, sigma: float, least: float = 0.0
) -> np.ndarray:
    """Gaussian mean of the quality along the jaws, across each pixel's closing direction; 0 where
    no q is above `least` within its reach, for the mean is not either."""
    mean = np.zeros_like(q)
    reach = int(np.ceil(2 * sigma))
    good = q > least
    rows, columns = np.flatnonzero(good.any(axis=1)), np.flatnonzero(good.any(axis=0))
    if not rows.size:
        return mean
    top, left = max(rows[0] - reach - 1, 0), max(columns[0] - reach - 1, 0)
    window = np.s_[top : rows[-1] + reach + 2, left : columns[-1] + reach + 2]
    theta = 0.5 * np.arctan2(sin[window], cos[window])
    dx, dy = np.sin(theta), np.cos(theta)  # the closing direction is (cos, -sin) in the image
    y, x = np.mgrid[0 : theta.shape[0], 0 : theta.shape[1]].astype(np.float32)
    x, y = x + np.float32(left), y + np.float32(top)
    steps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (steps / sigma) ** 2)
    for step, weight in zip(steps, weights / weights.sum(), strict=True):
        at = x + np.float32(step) * dx, y + np.float32(step) * dy
        mean[window] += np.float32(weight) * cv2.remap(q, *at, cv2.INTER_LINEAR)
    return mean


def local_maxima(
    image: np.ndarray, min_distance: int, threshold: float, max_peaks: int
) -> list[tuple[int, int]]:
    """(row, column) of the peaks above the threshold, highest first, min_distance apart."""
    size = 2 * min_distance + 1
    highest = cv2.dilate(image, np.ones((size, size), np.uint8))
    rows, columns = np.nonzero((image >= highest) & (image > threshold))
    order = np.argsort(-image[rows, columns], kind="stable")
    peaks: list[tuple[int, int]] = []
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if len(peaks) == max_peaks:
            break
        # Plateaus: equal neighbours are all maxima, one of them is enough.
        if all(max(abs(row - r), abs(column - c)) > min_distance for r, c in peaks):
            peaks.append((row, column))
    return peaks


def places_between(
    image: np.ndarray, peaks: list[tuple[int, int]], threshold: float, count: int
) -> list[tuple[int, int]]:
    """Up to `count` (row, column) of the highest values above the threshold, PLACE_DISTANCE apart
    from each other and from the peaks.

    A straight shank is one ridge with a single maximum, which the fingers may have no room at.
    """
    left = image.copy()

    def take(row: int, column: int) -> None:
        top, start = max(row - PLACE_DISTANCE, 0), max(column - PLACE_DISTANCE, 0)
        left[top : row + PLACE_DISTANCE + 1, start : column + PLACE_DISTANCE + 1] = 0

    for row, column in peaks:
        take(row, column)
    places: list[tuple[int, int]] = []
    while len(places) < count:
        row, column = divmod(int(left.argmax()), left.shape[1])
        if left[row, column] <= threshold:
            break
        places.append((row, column))
        take(row, column)
    return places
