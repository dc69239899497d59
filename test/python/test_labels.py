"""Rectangles, label maps and decoding: what is drawn is what is read back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwgnet_grasp.data.augmentation import Augmentation, centre_crop
from iwgnet_grasp.data.grasp_rectangle import (
    JAW,
    OPENING,
    QUALITY,
    THETA,
    X,
    Y,
    angle_between,
    corners,
    from_corners,
    iou,
    transform,
    wrap_theta,
)
from iwgnet_grasp.data.labels import label_maps
from iwgnet_grasp.networks.decode import PLACE_DISTANCE, decode_grasps, local_maxima

SIZE = 128


def row(x=64, y=64, theta=0.3, opening=60, jaw=24, quality=1.0):
    return np.array([[x, y, theta, opening, jaw, quality]], np.float32)


def decoded(rectangles, size=SIZE):
    maps = label_maps(rectangles, size, size)
    return decode_grasps(maps.q, maps.cos, maps.sin, maps.width)


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(40, 88),
    y=st.floats(40, 88),
    degrees=st.one_of(
        st.floats(-90, 90), st.sampled_from([90.0, -90.0, 89.9, -89.9, 0.0, 45.0, -45.0])
    ),
    opening=st.floats(30, 90),
    jaw=st.floats(14, 30),
)
def test_label_and_decode_give_the_rectangle_back(x, y, degrees, opening, jaw):
    truth = row(x, y, wrap_theta(np.radians(degrees)), opening, jaw)
    grasps = decoded(truth)
    assert grasps
    best = grasps[0]
    # The drawn third is flat, so that its smoothed peak may lie anywhere inside.
    dx, dy = best.x_px - x, best.y_px - y
    cos, sin = np.cos(truth[0, THETA]), np.sin(truth[0, THETA])
    assert abs(dx * cos - dy * sin) < opening / 6
    assert abs(dx * sin + dy * cos) < jaw / 2
    assert angle_between(best.theta_rad, truth[0, THETA]) < np.radians(0.5)
    assert best.width_px == pytest.approx(opening, rel=0.01)


def test_the_centre_third_is_drawn_across_the_whole_jaw():
    maps = label_maps(row(theta=0.0, opening=60, jaw=24), SIZE, SIZE)
    rows, columns = np.nonzero(maps.mask)
    assert np.ptp(columns) + 1 == pytest.approx(20, abs=1.5)  # opening / 3, along x at theta = 0
    assert np.ptp(rows) + 1 == pytest.approx(24, abs=1.5)


def test_there_is_no_angle_and_no_width_where_there_is_no_grasp():
    maps = label_maps(row(), SIZE, SIZE)
    empty = maps.mask == 0
    for values in (maps.q, maps.cos, maps.sin, maps.width):
        assert not values[empty].any()
    np.testing.assert_allclose(maps.cos**2 + maps.sin**2, maps.mask, atol=1e-5)


@pytest.mark.parametrize("reverse", [False, True])
def test_the_better_grasp_overwrites_the_worse_in_any_order(reverse):
    worse, better = row(theta=0.0, quality=0.4), row(theta=1.2, quality=0.9)
    both = np.concatenate([better, worse] if reverse else [worse, better])
    maps = label_maps(both, SIZE, SIZE)
    assert maps.q[64, 64] == pytest.approx(0.9)
    assert maps.cos[64, 64] == pytest.approx(np.cos(2.4), abs=1e-5)
    assert decoded(both)[0].theta_rad == pytest.approx(1.2, abs=0.02)


def test_the_angle_is_smoothed_across_the_wrap():
    """Neighbouring columns of +89 and -89 deg mean 90 deg; an averaged angle would be 0."""
    theta = np.where(np.arange(SIZE) % 2 == 0, np.radians(89), np.radians(-89))
    theta = np.broadcast_to(theta, (SIZE, SIZE))
    q = label_maps(row(), SIZE, SIZE).q
    cos, sin = np.cos(2 * theta).astype(np.float32), np.sin(2 * theta).astype(np.float32)
    best = decode_grasps(q, cos, sin, np.full((SIZE, SIZE), 0.5, np.float32))[0]
    assert angle_between(best.theta_rad, np.pi / 2) < np.radians(1)


def test_theta_is_counter_clockwise_as_seen():
    """A closing direction towards the upper right of the image (+x, -y) is at +45 deg."""
    first, second = corners(50, 50, np.pi / 4, 40, 0)[:2]
    assert second[0] > first[0] and second[1] < first[1]


@given(
    theta=st.floats(-1.57, 1.57),
    opening=st.floats(5, 90),
    jaw=st.floats(5, 40),
)
def test_corners_and_back(theta, opening, jaw):
    rectangle = from_corners(corners(30, 40, theta, opening, jaw), quality=0.5)
    assert rectangle[[X, Y]] == pytest.approx([30, 40], abs=1e-3)
    assert angle_between(rectangle[THETA], theta) < 1e-3
    assert rectangle[[OPENING, JAW, QUALITY]] == pytest.approx([opening, jaw, 0.5], rel=1e-4)


@given(st.floats(-20, 20))
def test_wrapped_theta_is_the_same_gripper_in_half_a_turn(theta):
    wrapped = wrap_theta(theta)
    assert -np.pi / 2 < wrapped <= np.pi / 2
    assert np.sin(2 * wrapped) == pytest.approx(np.sin(2 * theta), abs=1e-9)
    assert np.cos(2 * wrapped) == pytest.approx(np.cos(2 * theta), abs=1e-9)


@pytest.mark.parametrize("zoom", [0.5, 0.8, 1.0, 1.7])
@pytest.mark.parametrize("mirror", [1, -1])
def test_width_survives_crop_and_zoom(zoom, mirror):
    """Decoded in the zoomed crop and carried back, a width is what it was."""
    truth = row(x=150, y=140, theta=1.5, opening=60, jaw=24)
    angle = 0.7
    linear = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = linear @ np.diag([mirror, 1])
    affine = np.hstack([linear, (np.array([64, 64]) - linear @ [150, 140])[:, None]])
    best = decoded(transform(truth, affine))[0]
    assert best.width_px / zoom == pytest.approx(60, rel=0.02)
    assert np.hypot(best.x_px - 64, best.y_px - 64) < zoom * 12


def test_a_transform_moves_corners_like_pixels():
    truth = row(theta=0.4)[0]
    affine = np.array([[0.0, -1.5, 90.0], [-1.5, 0.0, 140.0]])  # turned, mirrored and zoomed
    moved = transform(truth[None], affine)[0]
    expected = corners(*truth[:5]) @ affine[:, :2].T + affine[:, 2]
    actual = corners(*moved[:5])
    distance = np.linalg.norm(actual[:, None] - expected[None], axis=2).min(axis=1)
    assert distance.max() < 1e-3


def test_augmentation_keeps_the_label_on_the_object():
    """A bright bar and its grasp stay together: the label lies on the bar, across it."""
    view = np.zeros((300, 300), np.float32)
    view[146:155, 100:200] = 1.0  # along x: closing direction is y
    truth = row(x=150, y=150, theta=np.pi / 2, opening=40, jaw=20)
    augmentation = Augmentation(noise=0, tilt=0, holes=0)
    for seed in range(20):
        crop, moved = augmentation(view, truth, 224, np.random.default_rng(seed))
        x, y = moved[0, X], moved[0, Y]
        assert crop[round(float(y)), round(float(x))] > 0.9
        along = 20 * np.array([np.cos(moved[0, THETA]), -np.sin(moved[0, THETA])])
        for sign in (1, -1):
            px, py = np.array([x, y]) + sign * along
            assert crop[round(float(py)), round(float(px))] < 0.1
        assert moved[0, OPENING] == pytest.approx(40 * moved[0, JAW] / 20, rel=1e-5)


def test_the_centre_crop_shifts_only():
    view = np.arange(300 * 300, dtype=np.float32).reshape(300, 300)
    crop, moved = centre_crop(view, row(x=150, y=140), 224)
    assert crop[0, 0] == view[38, 38]
    assert moved[0] == pytest.approx(row(x=112, y=102)[0])


def test_iou_of_known_rectangles():
    a = row(x=50, y=50, theta=0, opening=40, jaw=20)[0]
    assert iou(a, a) == pytest.approx(1, abs=1e-3)
    half = row(x=70, y=50, theta=0, opening=40, jaw=20)[0]
    assert iou(a, half) == pytest.approx(1 / 3, abs=1e-3)
    crossed = row(x=50, y=50, theta=np.pi / 2, opening=40, jaw=20)[0]
    assert iou(a, crossed) == pytest.approx(400 / 1200, abs=1e-3)
    assert iou(a, row(x=200, y=50)[0]) == 0


def test_peaks_are_sorted_distant_and_above_the_threshold():
    image = np.zeros((60, 60), np.float32)
    image[10, 10], image[10, 13], image[40, 40], image[50, 10] = 0.9, 0.8, 0.95, 0.05
    assert local_maxima(image, 6, 0.1, 10) == [(40, 40), (10, 10)]
    assert local_maxima(image, 2, 0.1, 10) == [(40, 40), (10, 10), (10, 13)]
    assert local_maxima(image, 2, 0.1, 1) == [(40, 40)]
    plateau = np.ones((20, 20), np.float32)
    assert len(local_maxima(plateau, 30, 0.1, 10)) == 1


def test_a_ridge_gives_further_places_that_stay_apart():
    rows, columns = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)
    along, across = columns - SIZE / 2, rows - SIZE / 2
    q = (0.8 - 0.002 * np.abs(along)) * np.exp(-((across / 4) ** 2))
    q = np.where(np.abs(along) < SIZE / 3, q, 0).astype(np.float32)
    ones = np.ones_like(q)
    grasps = decode_grasps(q, -ones, 0 * ones, 0.2 * ones, max_grasps=5)
    assert len(grasps) == 5
    assert [g.quality for g in grasps] == sorted((g.quality for g in grasps), reverse=True)
    assert abs(grasps[0].x_px - SIZE / 2) <= 1
    for i, a in enumerate(grasps):
        assert abs(a.y_px - SIZE / 2) <= 8
        for b in grasps[:i]:
            assert max(abs(a.x_px - b.x_px), abs(a.y_px - b.y_px)) > PLACE_DISTANCE
    # Where nothing is left above the threshold there are no further ones.
    assert len(decode_grasps(q, -ones, 0 * ones, 0.2 * ones, max_grasps=50)) < 50
