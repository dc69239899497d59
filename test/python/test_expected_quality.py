"""Decoding prefers a place that forgives an error of a few pixels and whose angle is clear."""

import numpy as np
import pytest

from iwgnet_grasp.networks.decode import PLACE_SIGMA, decode_grasps, expected_quality


def shank(theta: float, size: int = 96) -> tuple[np.ndarray, ...]:
    """Maps of a shank of 30 px through the middle whose quality rises up to its abrupt end."""
    rows, columns = np.mgrid[0:size, 0:size] - (size - 1) / 2
    closing = np.array([np.cos(theta), -np.sin(theta)])
    along = -columns * closing[1] + rows * closing[0]
    across = columns * closing[0] + rows * closing[1]
    on = (np.abs(along) <= 15) & (np.abs(across) <= 3)
    q = np.where(on, 0.6 + 0.01 * along, 0).astype(np.float32)
    full = np.ones_like(q)
    return q, np.cos(2 * theta) * full, np.sin(2 * theta) * full, 0.2 * full, along


@pytest.mark.parametrize("theta", [0.0, 0.5, 1.2, -0.9, np.pi / 2])
def test_the_best_grasp_keeps_clear_of_a_shanks_abrupt_end(theta):
    q, cos, sin, width, along = shank(theta)
    steepest = along.ravel()[np.argmax(q)]
    assert steepest > 14
    best = decode_grasps(q, cos, sin, width)[0]
    at = along[round(best.y_px), round(best.x_px)]
    assert 0 < at < 15 - 0.8 * PLACE_SIGMA


def test_the_mean_runs_along_the_jaws_and_not_across_them():
    theta = 0.5
    q, cos, sin, _, along = shank(theta)
    mean = expected_quality(q, cos, sin, PLACE_SIGMA)
    middle = np.abs(along) < 1
    assert mean[middle].max() == pytest.approx(q[middle].max(), abs=0.03)
    # The shank stays as narrow as it was.
    assert np.count_nonzero(mean[middle] > 0.3) == pytest.approx(
        np.count_nonzero(q[middle] > 0.3), abs=4
    )


def test_an_even_quality_stays_as_it_is():
    flat = np.full((40, 40), 0.7, np.float32)
    mean = expected_quality(flat, np.ones_like(flat), np.zeros_like(flat), PLACE_SIGMA)
    np.testing.assert_allclose(mean[10:30, 10:30], 0.7, rtol=1e-5)


def test_where_two_directions_are_as_likely_their_mean_is_no_grasp():
    """As much pull towards 0 as towards 90 deg: a short vector, here one that points at 32 deg."""
    q, cos, sin, width, _ = shank(0.0)
    q, cos, sin, width = (np.hstack([m, m]) for m in (q, cos, sin, width))
    half = q.shape[1] // 2
    q[:, half:] *= 1.2
    cos[:, half:], sin[:, half:] = 0.05, 0.1
    best = decode_grasps(q, cos, sin, width)[0]
    assert best.x_px < half
    assert best.theta_rad == pytest.approx(0.0, abs=1e-3)
