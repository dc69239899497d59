"""Perception on one look: merged depth, object pixels, candidates, refusals of bad input."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from iwgnet_grasp.data.grasp_rectangle import Grasp
from iwgnet_grasp.data.letterbox import WHOLE
from iwgnet_grasp.networks.yolov5s import YOLOv5s
from iwgnet_grasp.perception import (
    Box,
    Detection,
    GraspRectangle,
    Perception,
    PerceptionConfig,
    PerceptionError,
    load_perception,
)
from iwgnet_grasp.perception.detector import Detector
from iwgnet_grasp.perception.merged_depth import (
    centroid,
    covered_share,
    crop_window,
    distinct_objects,
    grasp_depth,
    lies_on,
    merge,
    metres,
    object_mask,
    own_share,
    pixel_owners,
    same_parts,
    standing,
    taken_away,
)
from iwgnet_grasp.perception.pipeline import DEFAULT_CONFIG, select
from iwgnet_grasp.perception.types import Window
from iwgnet_grasp.training.detector import save_detector

PACKAGE = Path(__file__).resolve().parents[2]
TABLE = 0.6  # m
TOP = 0.58  # m, of the object
BOX = Box(300, 200, 60, 40)


def table(shape=(480, 640)) -> np.ndarray:
    return np.full(shape, TABLE, np.float32)


def scene() -> np.ndarray:
    """An object that fills the middle half of BOX's columns."""
    depth = table()
    depth[200:240, 315:345] = TOP
    return depth


# Depth --------------------------------------------------------------------------------------------


def test_metres_reads_both_encodings_of_the_camera():
    millimetres = np.array([[600, 0], [580, 1]], np.uint16)
    expected = np.array([[0.6, np.nan], [0.58, 0.001]], np.float32)
    np.testing.assert_allclose(metres(millimetres), expected, rtol=1e-6)
    metric = np.array([[0.6, -1.0], [np.inf, 0.0]], np.float32)
    np.testing.assert_array_equal(metres(metric), np.float32([[0.6, np.nan], [np.nan, np.nan]]))


@pytest.mark.parametrize(
    ("depth", "complaint"),
    [
        (np.full((4, 4), np.nan, np.float32), "no pixel"),
        (np.zeros((4, 4), np.uint16), "no pixel"),
        (np.ones((4, 4), np.uint8), "uint8"),
        (np.ones((4, 4, 3), np.float32), "shape"),
        (np.ones((0, 4), np.float32), "shape"),
    ],
)
def test_metres_refuses_what_is_no_depth_in_one_line(depth, complaint):
    with pytest.raises(PerceptionError, match=complaint) as caught:
        metres(depth)
    assert "\n" not in str(caught.value)


def test_metres_leaves_its_input_alone():
    depth = np.array([[0.6, -1.0]], np.float32)
    metres(depth)
    assert depth[0, 1] == -1.0


def test_merge_takes_the_box_from_the_scene_and_mirrors_what_lies_around_it():
    depth = scene()
    depth[100, 100] = TABLE - 0.1  # another object
    depth[100, 101] = np.nan
    depth[210, 320] = np.nan
    merged = merge(depth, table(), BOX)
    np.testing.assert_array_equal(merged[BOX.slices], depth[BOX.slices])
    assert merged[100, 100] == pytest.approx(TABLE + 0.1)
    merged[100, 100] = TABLE
    outside = np.ones(depth.shape, bool)
    outside[BOX.slices] = False
    assert np.all(merged[outside] == np.float32(TABLE))


def test_window_is_centred_on_the_box_at_native_resolution():
    depth = scene()
    window = crop_window(depth, table(), BOX, 224)
    rows, columns = (slice(window.y, window.y + 224), slice(window.x, window.x + 224))
    assert window.depth.shape == window.empty.shape == (224, 224)
    np.testing.assert_array_equal(window.depth, merge(depth, table(), BOX)[rows, columns])
    u, v = BOX.center
    assert abs(window.x + 111.5 - u) <= 0.5
    assert abs(window.y + 111.5 - v) <= 0.5


@given(
    x=st.integers(0, 600),
    y=st.integers(0, 440),
    width=st.integers(1, 640),
    height=st.integers(1, 480),
)
def test_window_never_leaves_the_image(x, y, width, height):
    box = Box(x, y, min(width, 640 - x), min(height, 480 - y))
    depth = np.random.default_rng(0).uniform(0.5, 0.6, (480, 640)).astype(np.float32)
    window = crop_window(depth, table(), box, 224)
    assert 0 <= window.x <= 640 - 224
    assert 0 <= window.y <= 480 - 224
    expected = merge(depth, table(), box)
    np.testing.assert_array_equal(
        window.depth, expected[window.y : window.y + 224, window.x : window.x + 224]
    )


def test_window_larger_than_the_image_is_refused():
    with pytest.raises(PerceptionError, match="window of 224 px"):
        crop_window(table((100, 300)), table((100, 300)), Box(10, 10, 5, 5), 224)


# Pixels of the object -----------------------------------------------------------------------------


def test_object_pixels_are_those_nearer_than_the_empty_scene():
    depth = scene()
    depth[200, 315:345] = np.nan  # not measured
    mask = object_mask(depth, table(), BOX, 0.004)
    assert mask.shape == (40, 60)
    assert mask.sum() == 39 * 30
    assert not mask[0].any()


def test_object_pixels_where_the_empty_scene_has_a_hole():
    empty = table()
    empty[200:240, 320:330] = np.nan
    assert object_mask(scene(), empty, BOX, 0.004).sum() == 40 * 30
    empty[:] = np.nan
    assert object_mask(scene(), empty, BOX, 0.004).sum() == 0


def test_of_objects_that_claim_a_pixel_the_likeliest_has_it_and_none_beyond_its_box():
    left, right = Box(300, 200, 40, 40), Box(330, 200, 30, 40)
    windows = [crop_window(scene(), table(), box, 64) for box in (left, right)]
    logits = np.full((2, 64, 64), -1.0, np.float32)
    logits[0] = 1.0  # all of its window, which is larger than its box
    logits[1, :, 5 + 330 - windows[1].x :] = 2.0
    owners = pixel_owners(logits, windows, (left, right), (480, 640))
    expected = np.full((480, 640), -1)
    expected[left.slices] = 0
    expected[200:240, 335:360] = 1
    np.testing.assert_array_equal(owners, expected)


def test_a_grasp_belongs_to_the_object_between_its_jaws():
    seen = np.zeros((40, 60), bool)
    seen[:, 10:] = True
    left, right = seen.copy(), seen.copy()
    left[:, 30:], right[:, :30] = False, False
    across = GraspRectangle(330.0, 220.0, 0.0, 20.0, 0.5)  # half on each
    assert own_share(seen, left, BOX, across) == pytest.approx(0.5, abs=0.05)
    along = GraspRectangle(345.0, 220.0, math.pi / 2, 25.0, 0.5)
    assert own_share(seen, left, BOX, along) == 0.0 and own_share(seen, right, BOX, along) == 1.0
    over_the_edge = GraspRectangle(312.0, 220.0, 0.0, 20.0, 0.5)  # the table says nothing
    assert own_share(seen, left, BOX, over_the_edge) == 1.0
    assert own_share(seen, left, BOX, GraspRectangle(100.0, 100.0, 0.0, 25.0, 0.5)) == 0.0


def test_where_an_object_was_taken_away_the_empty_scene_is_seen():
    depth = scene()
    depth[200:240, 345:360] = TABLE - 0.04  # a neighbour that touches it
    owners = np.full(depth.shape, -1, np.int16)
    owners[202:238, 317:345] = 0  # but for its edges
    owners[200:240, 345:360] = 1
    left, left_owners = taken_away(depth, table(), owners, [0], 0.008)
    expected = table()
    expected[200:240, 345:360] = TABLE - 0.04
    np.testing.assert_array_equal(left, expected)
    assert set(np.unique(left_owners)) == {-1, 1}


def crossing_bars(slope=0.0):
    """Depth (m) and owners of a bar, 1, that rises by `slope` a px, with a higher bar, 0, across
    it; and the depth without that."""
    rows, columns = np.mgrid[0:480, 0:640]
    below = table()
    lower = (rows >= 210) & (rows < 230) & (columns >= 270) & (columns < 470)
    below[lower] = (TOP - slope * (columns - 270))[lower]
    depth = below.copy()
    depth[160:280, 320:340] = TABLE - 0.06
    owners = np.where(lower, 1, -1).astype(np.int16)
    owners[160:280, 320:340] = 0
    return depth, owners, below


def test_an_object_goes_on_beneath_what_was_taken_from_it():
    depth, owners, below = crossing_bars(slope=1e-4)  # 20 mm in all
    left, left_owners = taken_away(depth, table(), owners, [0], 0.008)
    np.testing.assert_allclose(left, below, atol=2e-4)
    np.testing.assert_array_equal(left_owners == 1, below < TABLE - 0.004)
    # Nothing is known to be hidden by what stands beside it, no higher than it does.
    depth[owners == 0] = TOP
    left, left_owners = taken_away(depth, table(), owners, [0], 0.008)
    assert np.all(left[160:280, 320:340] == np.float32(TABLE))
    assert np.all(left_owners[160:280, 320:340] == -1)


def test_what_crosses_higher_lies_on_the_other():
    depth, owners, _ = crossing_bars()
    heights = table() - depth
    count = lies_on(owners, heights, 0.004)
    # Two borders of 20 px, passed by steps of 6 px at most in three of four directions.
    assert 2 * 20 * 4 < count[1, 0] < 2 * 20 * 6 * 3
    assert count[0, 1] == -count[1, 0] and count[0, 0] == count[1, 1] == 0
    assert not lies_on(owners, np.where(owners == 0, heights[220, 300], heights), 0.004).any()
    assert lies_on(np.full((4, 5), -1, np.int16), np.zeros((4, 5)), 0.004).shape == (0, 0)


def test_a_part_is_covered_where_something_higher_stands_beside_it():
    # A bar of 60 x 20 px with a bar across its middle that is 20 px wide and 25 mm higher.
    depth = table()
    depth[210:230, 300:360] = TABLE - 0.02
    crossing = depth.copy()
    crossing[200:240, 320:340] = TABLE - 0.045
    left = np.zeros((40, 60), bool)
    left[10:30, 0:20] = True  # what is seen of the lower bar on the left
    assert covered_share(depth, left, BOX, 0.008) == 0.0
    share = covered_share(crossing, left, BOX, 0.008)
    # One of the three sides that the box shows, all of about 20 px.
    assert 0.2 < share < 0.5
    top = np.zeros((40, 60), bool)
    top[:, 20:40] = True
    assert covered_share(crossing, top, BOX, 0.008) == 0.0


def test_centroid_is_the_mean_pixel():
    mask = np.zeros((40, 60), bool)
    mask[10, 20] = mask[12, 20] = mask[11, 26] = True
    u, v, pixels = centroid(mask, BOX)
    assert (u, v, pixels) == (300 + 22, 200 + 11, 3)


def test_centroid_of_nothing():
    u, v, pixels = centroid(np.zeros((40, 60), bool), BOX)
    assert math.isnan(u) and math.isnan(v) and pixels == 0


def test_grasp_depth_is_the_surface_not_the_bore():
    depth = scene()
    depth[215:225, 325:335] = TABLE  # a bore seen through to the table
    mask = object_mask(depth, table(), BOX, 0.004)
    over_bore = GraspRectangle(330, 220, 0.0, 30.0, 0.9)
    assert grasp_depth(depth, mask, BOX, over_bore, 3.0) == pytest.approx(TOP)
    on_top = GraspRectangle(320, 220, 0.0, 30.0, 0.9)
    assert grasp_depth(depth, mask, BOX, on_top, 3.0) == pytest.approx(TOP)
    beside = GraspRectangle(305, 220, math.pi / 2, 10.0, 0.9)
    assert math.isnan(grasp_depth(depth, mask, BOX, beside, 3.0))


# Candidates ---------------------------------------------------------------------------------------


def at(x: float, y: float, theta: float, quality: float) -> GraspRectangle:
    return GraspRectangle(x, y, theta, 30.0, quality)


DETECTION = Detection("connecting_rod", 0.9, BOX)


def test_candidates_are_distinct_in_place_or_direction():
    best = at(330, 220, math.radians(85), 0.9)
    repeat = at(335, 220, math.radians(-85), 0.8)  # 10 deg apart across the wrap
    turned = at(335, 220, math.radians(30), 0.7)
    moved = at(345, 220, math.radians(85), 0.6)
    kept = select([moved, repeat, turned, best], DETECTION, 8, 12.0, math.radians(20))
    assert kept == [best, turned, moved]


def test_candidates_lie_in_the_box_and_are_limited():
    outside = at(299.4, 220, 0.0, 0.99)
    row = [at(300 + 14 * i, 220, 0.0, 0.5 + 0.1 * i) for i in range(4)]
    kept = select([outside, *row], DETECTION, 3, 12.0, math.radians(20))
    assert [g.quality for g in kept] == pytest.approx([0.8, 0.7, 0.6])


def test_what_stands_there_is_higher_or_unmeasured_and_no_speck():
    heights, empty = np.zeros((80, 100), np.float32), np.ones((80, 100), np.float32)
    part = Box(10, 10, 80, 60)
    assert standing(heights, empty, part, 0.004) is None
    heights[20:30, 40:60] = 0.02
    heights[50:60, 30:36] = np.nan  # measured in the empty scene only
    heights[0:9, 0:100] = 0.5  # outside of the part
    heights[65, 80] = 0.1  # a speck
    empty[40:69, 11:20] = heights[40:69, 11:20] = np.nan  # never measured
    assert standing(heights, empty, part, 0.004) == Box(30, 20, 30, 40)


# The whole look -----------------------------------------------------------------------------------


class KnownBoxes:
    """A detector that knows where the objects are."""

    region = WHOLE

    def __init__(self, *boxes: Box) -> None:
        self.boxes = boxes

    def detect(self, color: np.ndarray, where: Box | None = None) -> list[Detection]:
        return [Detection("connecting_rod", 0.9, box) for box in self.boxes]


class HighestPoint:
    """An estimator that grasps each window's object pixels at their middle."""

    input_px = 224

    def predict(self, depth: np.ndarray, empty: np.ndarray) -> list[list[Grasp]]:
        found = []
        for d, e in zip(depth, empty, strict=True):
            rows, columns = np.nonzero(e - d > 0.004)
            found.append([Grasp(columns.mean(), rows.mean(), 0.2, 25.0, 0.7)] if len(rows) else [])
        return found


class AllOfTheBox:
    """Masks that claim whole windows."""

    input_px = 208
    backend = "none"

    def predict(self, heights: np.ndarray, greys: np.ndarray) -> np.ndarray:
        assert greys.dtype == np.uint8 and heights.shape == greys.shape
        return np.ones(heights.shape, np.float32)


class AsGood:
    """Outcomes: the share of a view that shows no other object, within 40 px of the grasp."""

    backend = "none"

    def predict(self, views: np.ndarray) -> np.ndarray:
        near = views[:, 3, 28:68, 28:68]
        return np.repeat(1 - near.mean((1, 2))[:, None], 2, axis=1)


class SameRow:
    """Patches: what stands in the rows of a patch is of the same part."""

    backend = "none"

    def predict(
        self, heights: np.ndarray, grey: np.ndarray, patches: list[np.ndarray]
    ) -> list[np.ndarray]:
        shape = heights.shape
        return [np.broadcast_to(p.any(1)[:, None], shape).astype(np.float32) for p in patches]


@pytest.fixture
def config() -> PerceptionConfig:
    return PerceptionConfig.load()


def color(shape=(480, 640)) -> np.ndarray:
    return np.full((*shape, 3), 128, np.uint8)


def test_a_look_gives_grasps_in_pixels_of_the_full_image(config):
    boxes = KnownBoxes(BOX, Box(10, 10, 40, 40))
    perception = Perception(config, boxes, HighestPoint(), AllOfTheBox(), AsGood(), SameRow())
    look = perception.look(color(), scene(), table())
    first, second = look.objects
    assert (first.object_id, second.object_id) == (0, 1)
    assert first.valid_pixels == 40 * 30
    assert (first.centroid_u_px, first.centroid_v_px) == pytest.approx((329.5, 219.5))
    assert first.centroid_depth_m == pytest.approx(TOP)
    (grasp,) = first.grasps
    assert (grasp.x_px, grasp.y_px) == pytest.approx((329.5, 219.5))
    assert (grasp.theta_rad, grasp.width_px, grasp.quality) == pytest.approx((0.2, 25.0, 0.7))
    assert grasp.depth_m == pytest.approx(TOP)
    assert second.valid_pixels == 0 and second.grasps == ()
    assert math.isnan(second.centroid_depth_m)


def test_a_box_counts_when_its_mask_shows_what_no_better_one_does():
    seen = np.zeros((100, 200), bool)
    seen[40:60, 20:180] = True
    windows = [Window(0, 0, None, None)] * 4
    logits = np.full((4, 100, 100), -1.0, np.float32)
    logits[0, 40:60, 20:60] = 1  # 800 px
    logits[1, 40:60, 20:70] = 1  # 200 of 1000 are new: another box of the first
    logits[2, 30:60, 50:90] = 1  # 600 of 800 that stand on the table
    logits[3, 40:60, 85:96] = 1  # 120 of 220

    def kept(score, pixels):
        boxes = [Box(0, 0, 100, 100)] * 3 + [Box(0, 0, 96, 100)]
        found = [
            Detection("rod", s, box) for s, box in zip((0.9, 0.8, 0.7, score), boxes, strict=True)
        ]
        return distinct_objects(logits, windows, found, seen, 0.4, 0.35, pixels)

    assert kept(0.5, 200) == [0, 2, 3]
    assert kept(0.3, 200) == [0, 2]  # doubtful, and too little new
    assert kept(0.3, 100) == [0, 2, 3]


def test_what_stands_there_without_a_box_is_an_object(config):
    depth = scene()
    depth[300:330, 100:200] = TOP  # 3000 px
    depth[400:420, 100:150] = TOP  # 1000 px
    perception = Perception(
        config, KnownBoxes(BOX), HighestPoint(), AllOfTheBox(), AsGood(), SameRow()
    )
    look = perception.look(color(), depth, table())
    known, found = look.objects
    assert known.box == BOX and found.box == Box(100, 300, 100, 30)
    assert (found.object_id, found.label, found.score) == (1, "connecting_rod", 0.0)
    assert found.valid_pixels == 3000 and len(found.grasps) == 1
    elsewhere = KnownBoxes(BOX)
    elsewhere.region = (0.4, 0.0, 1.0, 1.0)  # the detector does not look there: a tray, say
    perception = Perception(config, elsewhere, HighestPoint(), AllOfTheBox(), AsGood(), SameRow())
    assert len(perception.look(color(), depth, table()).objects) == 1


def test_what_lies_on_both_sides_of_another_object_is_one_once_that_is_gone(config):
    depth, _, below = crossing_bars()
    depth[210:230, 400:410] = TABLE  # a gap, from where on the bar has a box of its own
    upper, end = Box(320, 160, 20, 120), Box(410, 210, 60, 20)

    class Doubtful(KnownBoxes):
        def detect(self, color, where=None):
            return [Detection("rod", 0.9, upper), Detection("rod", 0.5, end)]

    perception = Perception(config, Doubtful(), HighestPoint(), AllOfTheBox(), AsGood(), SameRow())
    look = perception.look(color(), depth, table())
    assert [o.valid_pixels for o in look.objects] == [120 * 20, 60 * 20]  # nothing of 1500 px
    assert [o.covered_px for o in look.objects] == [0, 0]
    left = perception.without(look, [0])
    (bar,) = left.objects
    assert (bar.object_id, bar.score, bar.box) == (1, 0.5, Box(270, 210, 200, 20))
    assert bar.valid_pixels == 190 * 20
    below[210:230, 400:410] = TABLE
    np.testing.assert_allclose(left.depth, below, atol=1e-4)
    # Whoever takes one of two objects that are one part takes both.
    assert [o.object_id for o in perception.without(look, [1]).objects] == [0]


def test_pieces_are_joined_from_the_likeliest_pair_on():
    nan = math.nan
    alike = np.array(
        [
            [nan, nan, nan, nan],
            [nan, nan, nan, nan],
            [0.6, 0.9, 1.0, 0.2],
            [0.8, 0.1, 0.6, 1.0],
        ]
    )
    # 2 goes to 1 and 3 to 0; 2 and 3 (0.4) stay apart, as must 0 and 1.
    assert same_parts(alike, [True, True, False, False], 0.5) == [[0, 3], [1, 2]]
    assert same_parts(alike, [True, True, False, False], 0.85) == [[0], [1, 2], [3]]
    assert same_parts(alike, [False] * 4, 0.5) == [[0, 1, 2, 3]]
    assert same_parts(np.empty((0, 0)), [], 0.5) == []


def test_a_grasp_counts_for_less_where_its_outcome_looks_bad(config):
    depth = scene()
    depth[200:240, 350:400] = TOP  # another object beside it
    beside = Box(350, 200, 50, 40)
    alone = Perception(config, KnownBoxes(BOX), HighestPoint(), AllOfTheBox(), AsGood(), SameRow())
    crowded = Perception(
        config, KnownBoxes(BOX, beside), HighestPoint(), AllOfTheBox(), AsGood(), SameRow()
    )
    (first,) = alone.look(color(), scene(), table()).objects
    second = crowded.look(color(), depth, table()).objects[0]
    assert first.grasps[0].quality == pytest.approx(0.7)
    assert second.grasps[0].quality < 0.95 * first.grasps[0].quality


def test_a_look_without_an_object_shows_what_lay_behind_it(config):
    depth, _, below = crossing_bars()  # the box of the lower one shows the other as well
    upper, lower = Box(320, 160, 20, 120), Box(270, 210, 200, 20)
    perception = Perception(
        config, KnownBoxes(upper, lower), HighestPoint(), AllOfTheBox(), AsGood(), SameRow()
    )
    look = perception.look(color(), depth, table())
    left = perception.without(look, [0])
    (seen,) = left.objects
    assert (seen.object_id, seen.box) == (1, lower)
    assert look.objects[1].covered_px > 0 and seen.covered_px == 0
    assert look.objects[1].valid_pixels == 180 * 20 and seen.valid_pixels == 200 * 20
    assert seen.grasps[0].quality > look.objects[1].grasps[0].quality  # it is covered no more
    np.testing.assert_allclose(left.depth, below, atol=1e-4)
    assert perception.without(look, [0, 1]).objects == ()


def test_an_empty_table_is_no_error(config):
    perception = Perception(
        config, KnownBoxes(), HighestPoint(), AllOfTheBox(), AsGood(), SameRow()
    )
    look = perception.look(color(), table(), table())
    assert look.objects == () and look.windows == ()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"color": np.zeros((480, 640), np.uint8)}, "color: shape"),
        ({"color": np.zeros((480, 640, 3), np.float32)}, "color: type"),
        ({"depth": np.full((480, 640), np.nan, np.float32)}, "depth: no pixel"),
        ({"depth": np.full((240, 320), 0.6, np.float32)}, "depth: 320x240 px differs"),
        ({"empty_depth": np.zeros((480, 640), np.float32)}, "empty_depth: no pixel"),
        ({"empty_depth": np.full((480, 640), 1, np.int32)}, "empty_depth: type"),
    ],
)
def test_bad_images_are_refused_by_name(config, change, complaint):
    perception = Perception(
        config, KnownBoxes(BOX), HighestPoint(), AllOfTheBox(), AsGood(), SameRow()
    )
    images = {"color": color(), "depth": scene(), "empty_depth": table()} | change
    with pytest.raises(PerceptionError, match=complaint) as caught:
        perception.look(**images)
    assert "\n" not in str(caught.value)


# Detector -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(3)
    folder = tmp_path_factory.mktemp("models")
    return save_detector(YOLOv5s(1), folder / "random.safetensors", (96, 160), ["rod"], {})


def test_backends_see_the_same(weights):
    image = np.random.default_rng(0).integers(0, 255, (200, 320, 3), dtype=np.uint8)
    maps = {}
    for backend in ("torch", "openvino"):
        detector = Detector(weights, backend=backend, score_threshold=0.0)
        pixels = image[:96, :160].transpose(2, 0, 1)[None]
        maps[backend] = detector._runners[96, 160](pixels)
    for ours, theirs in zip(maps["torch"], maps["openvino"], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0.05, atol=0.05)


def test_boxes_stay_inside_the_image_and_are_sorted(weights):
    image = np.random.default_rng(1).integers(0, 255, (250, 320, 3), dtype=np.uint8)
    found = Detector(weights, backend="torch", score_threshold=0.0).detect(image)
    assert 0 < len(found) <= 30
    assert [d.score for d in found] == sorted((d.score for d in found), reverse=True)
    for d in found:
        assert d.label == "rod"
        assert 0 <= d.box.x < d.box.x + d.box.width <= 320
        assert 0 <= d.box.y < d.box.y + d.box.height <= 250


def overlaps(a: Box, b: Box) -> bool:
    across = min(a.x + a.width, b.x + b.width) - max(a.x, b.x)
    down = min(a.y + a.height, b.y + b.height) - max(a.y, b.y)
    return across > 0 and down > 0


def test_only_the_region_is_looked_at(weights):
    region = (0.25, 0.1, 0.75, 0.9)
    image = np.random.default_rng(1).integers(0, 255, (250, 320, 3), dtype=np.uint8)
    detector = Detector(weights, backend="torch", score_threshold=0.0, region=region)
    found = detector.detect(image)
    elsewhere = image.copy()
    elsewhere[:25], elsewhere[225:], elsewhere[:, :80], elsewhere[:, 240:] = 0, 0, 0, 0
    assert detector.detect(elsewhere) == found
    cut = Detector(weights, backend="torch", score_threshold=0.0).detect(image[25:225, 80:240])
    # The cut image has no room for boxes in the grey beside the region.
    inside = [d for d in found if overlaps(d.box, Box(80, 25, 160, 200))]
    assert [d.score for d in inside] == pytest.approx([d.score for d in cut])


def test_a_window_around_what_stands_there_shows_the_same_objects():
    core = pytest.importorskip("iwgnet_grasp._core")
    cell = core.SimulatedCell(str(PACKAGE))
    cell.load_scene("ten_stacked", 4)
    color = cell.color()
    detector = Detector(PACKAGE / "models" / "yolov5s.safetensors", score_threshold=0.5)
    whole = detector.detect(color)
    left, top = (min(getattr(d.box, side) for d in whole) for side in "xy")
    right = max(d.box.x + d.box.width for d in whole)
    bottom = max(d.box.y + d.box.height for d in whole)
    where = Box(left, top, right - left, bottom - top)
    found = detector.detect(color, where)
    assert len(whole) == len(found) >= 8
    for one in whole:
        nearest = min(found, key=lambda d: math.dist(d.box.center, one.box.center))
        assert math.dist(nearest.box.center, one.box.center) < 10
    # What lies farther away than a window's margin is not looked at.
    small = detector.detect(color, whole[0].box)
    assert any(math.dist(d.box.center, whole[0].box.center) < 10 for d in small)
    assert len(small) < len(whole)


def test_a_missing_weight_file_says_how_to_make_it(tmp_path):
    with pytest.raises(PerceptionError, match="train"):
        Detector(tmp_path / "none.safetensors")


def test_a_broken_weight_file_is_one_line(weights, tmp_path):
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(weights.read_bytes()[:1000])
    broken.with_suffix(".json").write_text(weights.with_suffix(".json").read_text())
    with pytest.raises(PerceptionError, match="broken.safetensors") as caught:
        Detector(broken)
    assert "\n" not in str(caught.value)


def test_a_card_of_another_network_is_refused(weights, tmp_path):
    other = tmp_path / "other.safetensors"
    other.write_bytes(weights.read_bytes())
    other.with_suffix(".json").write_text(json.dumps({"network": "iwgnet", "input_px": 224}))
    with pytest.raises(PerceptionError, match="other.json"):
        Detector(other)


def test_unknown_backend_is_refused(weights):
    with pytest.raises(PerceptionError, match="no backend 'caffe'; known: auto, torch"):
        Detector(weights, backend="caffe")


# Config -------------------------------------------------------------------------------------------


def test_config_of_the_package_names_its_weights(config):
    assert config.detector_weights.name == "yolov5s.safetensors"
    assert config.min_angle_rad == pytest.approx(math.radians(20))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("detector: [", "not a valid"),
        ("detector: {weights: a}", "missing"),
        ("", "not a valid"),
        ("42", "not a valid"),
    ],
)
def test_malformed_config_is_one_line_with_the_file(tmp_path, text, complaint):
    path = tmp_path / "perception.yaml"
    path.write_text(text)
    with pytest.raises(PerceptionError, match=complaint) as caught:
        PerceptionConfig.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_perception_without_weights_says_so(tmp_path):
    path = tmp_path / "perception.yaml"
    path.write_text(DEFAULT_CONFIG.read_text().replace("models/", f"{tmp_path}/"))
    with pytest.raises(PerceptionError, match="yolov5s.safetensors"):
        load_perception(path)
