"""Priority of objects: Eq. 17-21 against hand-computed values, the degenerate cases, memory."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwgnet_grasp.perception import (
    Box,
    CameraIntrinsics,
    GraspRectangle,
    ObjectGrasps,
    PerceptionError,
)
from iwgnet_grasp.priority import (
    PriorityConfig,
    centroid_distance,
    normalised,
    rank,
    without_failed,
)

CAMERA = CameraIntrinsics(640.0, 640.0, 639.5, 399.5)
CONFIG = PriorityConfig(  # Eq. 17 as it is, with equal weights
    alpha=1.0,
    beta=1.0,
    failed_radius_px=15.0,
    failed_angle_rad=math.radians(25.0),
    random_order=False,
)


def grasp(x=700.0, y=400.0, depth=0.58, theta=0.0, quality=0.9) -> GraspRectangle:
    return GraspRectangle(x, y, theta, 40.0, quality, depth)


def thing(object_id=0, *grasps, u=700.0, v=400.0, depth=0.58, pixels=1000) -> ObjectGrasps:
    return ObjectGrasps(
        object_id, "connecting_rod", 0.9, Box(650, 350, 100, 100), u, v, depth, pixels, grasps
    )


def ids(ranking) -> list[int]:
    return [entry.object.object_id for entry in ranking.objects]


def test_centroid_distance_is_metric_distance_in_the_camera_frame():
    # 64 px at 0.6 m and 640 px focal length are 60 mm; 80 mm of depth on top.
    at_centroid = thing(0, u=639.5, v=399.5, depth=0.6)
    beside = grasp(x=639.5 + 64, y=399.5, depth=0.6)
    assert centroid_distance(at_centroid, beside, CAMERA) == pytest.approx(0.06)
    above = grasp(x=639.5, y=399.5, depth=0.52)
    assert centroid_distance(at_centroid, above, CAMERA) == pytest.approx(0.08)
    # (64 px, 0.5 m) -> 50 mm to the side and 100 mm up.
    both = grasp(x=639.5 + 64, y=399.5, depth=0.5)
    assert centroid_distance(at_centroid, both, CAMERA) == pytest.approx(math.hypot(0.05, 0.1))


def test_terms_and_order_of_three_objects():
    near = thing(0, grasp(depth=0.55), depth=0.55)  # G = 0
    far = thing(1, grasp(depth=0.59), depth=0.59)  # G = 0
    # 32 px at 0.56 m: G = 0.028 m
    off = thing(2, grasp(x=732.0, depth=0.56), depth=0.56)
    ranking = rank([far, off, near], CAMERA, replace(CONFIG, alpha=1.0, beta=0.5))
    assert ids(ranking) == [0, 2, 1]
    first, second, third = ranking.objects
    assert (first.score, second.score, third.score) == pytest.approx((0.55, 0.574, 0.59))
    assert second.depth_distance_m == pytest.approx(0.56)
    assert second.centroid_distance_m == pytest.approx(0.028)
    # S* = 1 - (0.574 - 0.55) / 0.04
    assert [e.priority for e in ranking.objects] == pytest.approx([1.0, 0.4, 0.0])


def test_weights_decide_between_height_and_centroid():
    high_off_centre = thing(0, grasp(x=760.0, depth=0.56), depth=0.56)  # D 0.56, G 0.0525
    low_centred = thing(1, grasp(depth=0.59), depth=0.59)  # D 0.59, G 0
    objects = [high_off_centre, low_centred]
    assert ids(rank(objects, CAMERA, replace(CONFIG, alpha=1.0, beta=0.0))) == [0, 1]
    assert ids(rank(objects, CAMERA, replace(CONFIG, alpha=0.0, beta=1.0))) == [1, 0]
    assert ids(rank(objects, CAMERA, CONFIG)) == [1, 0]


def test_one_object_has_full_priority():
    (only,) = rank([thing(0, grasp())], CAMERA, CONFIG).objects
    assert only.priority == 1.0


def test_equal_scores_have_full_priority_and_keep_their_order():
    ranking = rank([thing(i, grasp()) for i in (4, 2, 7)], CAMERA, CONFIG)
    assert ids(ranking) == [4, 2, 7]
    assert [e.priority for e in ranking.objects] == [1.0, 1.0, 1.0]


def test_nothing_ranks_to_nothing():
    ranking = rank([], CAMERA, CONFIG)
    assert ranking.objects == () and ranking.dropped == ()


def test_object_without_valid_pixels_goes_last_with_its_reason():
    blind = thing(0, grasp(depth=math.nan), u=math.nan, v=math.nan, depth=math.nan, pixels=0)
    ranking = rank([blind, thing(1, grasp()), thing(2, grasp(depth=0.6))], CAMERA, CONFIG)
    assert ids(ranking) == [1, 2, 0]
    last = ranking.objects[-1]
    assert last.priority == 0.0 and math.isnan(last.score)
    assert "no valid depth" in last.reason
    # and does not disturb the others' normalisation
    assert [e.priority for e in ranking.objects[:2]] == [1.0, 0.0]


def test_object_without_depth_at_its_grasp_goes_last():
    ranking = rank([thing(0, grasp(depth=math.nan)), thing(1, grasp())], CAMERA, CONFIG)
    assert ids(ranking) == [1, 0]
    assert "grasp point" in ranking.objects[1].reason


def test_object_without_grasp_is_dropped_with_its_reason():
    ranking = rank([thing(0), thing(1, grasp())], CAMERA, CONFIG)
    assert ids(ranking) == [1]
    ((dropped, reason),) = ranking.dropped
    assert dropped.object_id == 0 and reason == "no grasp was found"


def test_failed_grasp_gives_way_to_the_next_candidate():
    first, second = grasp(x=700, depth=0.55), grasp(x=740, depth=0.57, quality=0.5)
    failed = [grasp(x=706, y=408)]  # 10 px away
    ranking = rank([thing(0, first, second)], CAMERA, CONFIG, failed)
    (entry,) = ranking.objects
    assert entry.object.grasps == (second,)
    assert entry.depth_distance_m == pytest.approx(0.57)


def test_failed_grasp_counts_across_the_wrap_of_the_angle():
    failed = [grasp(theta=math.radians(88))]
    left = without_failed(thing(0, grasp(theta=math.radians(-88))), failed, CONFIG)
    assert left.grasps == ()


def test_another_direction_or_place_is_another_grasp():
    turned, moved = grasp(theta=math.radians(40)), grasp(x=720)
    left = without_failed(thing(0, turned, moved), [grasp()], CONFIG)
    assert left.grasps == (turned, moved)


def test_object_with_only_failed_grasps_is_dropped():
    ranking = rank([thing(0, grasp())], CAMERA, CONFIG, [grasp()])
    assert ranking.objects == ()
    assert ranking.dropped[0][1] == "all its grasps have failed"


@given(st.lists(st.floats(-10, 10, allow_subnormal=False), min_size=1, max_size=12))
def test_normalised_scores_span_one_to_zero_in_reverse_order(scores):
    stars = normalised(scores)
    assert all(0.0 <= s <= 1.0 for s in stars)
    assert stars[scores.index(min(scores))] == 1.0
    if max(scores) > min(scores):
        assert stars[scores.index(max(scores))] == 0.0
        by_score = sorted(range(len(scores)), key=lambda i: scores[i])
        assert all(stars[a] >= stars[b] for a, b in zip(by_score, by_score[1:], strict=False))


def test_common_offset_of_depth_does_not_change_the_priorities():
    objects = [thing(i, grasp(depth=d), depth=d) for i, d in enumerate((0.55, 0.57, 0.6))]
    lifted = [
        replace(o, centroid_depth_m=o.centroid_depth_m + 1, grasps=(grasp(depth=d + 1),))
        for o, d in zip(objects, (0.55, 0.57, 0.6), strict=True)
    ]
    here, there = rank(objects, CAMERA, CONFIG), rank(lifted, CAMERA, CONFIG)
    assert [e.priority for e in here.objects] == pytest.approx(
        [e.priority for e in there.objects], abs=1e-6
    )


def test_config_of_the_package_loads():
    config = PriorityConfig.load()
    assert config.alpha > 0 and config.beta > 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("alpha: 1", "missing"),
        ("alpha: x", "not a valid"),
        (
            "alpha: -1\nbeta: 1\nfailed_radius_px: 1\nfailed_angle_deg: 1\nrandom_order: false",
            "finite and >= 0",
        ),
        (
            "alpha: .nan\nbeta: 1\nfailed_radius_px: 1\nfailed_angle_deg: 1\nrandom_order: false",
            "finite and >= 0",
        ),
    ],
)
def test_malformed_config_is_one_line_with_the_file(tmp_path, text, complaint):
    path = tmp_path / "priority.yaml"
    path.write_text(text)
    with pytest.raises(PerceptionError, match=complaint) as caught:
        PriorityConfig.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_random_order_is_drawn_by_the_seed_and_not_by_the_score():
    objects = [thing(i, grasp(depth=0.5 + 0.01 * i), depth=0.5 + 0.01 * i) for i in range(6)]
    config = replace(CONFIG, random_order=True)
    orders = {seed: ids(rank(objects, CAMERA, config, seed=(seed,))) for seed in range(40)}
    assert all(sorted(order) == list(range(6)) for order in orders.values())
    assert orders[3] == ids(rank(objects, CAMERA, config, seed=(3,)))
    assert {order[0] for order in orders.values()} == set(range(6))  # each comes first at times
    priorities = [e.priority for e in rank(objects, CAMERA, config, seed=(3,)).objects]
    assert priorities == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
