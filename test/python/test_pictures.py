"""Pictures of one look: they are written, show what they say and survive the odd cases."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from iwgnet_grasp.perception import (
    Box,
    CameraIntrinsics,
    GraspRectangle,
    Look,
    ObjectGrasps,
)
from iwgnet_grasp.perception.merged_depth import crop_window
from iwgnet_grasp.priority import PriorityConfig, rank
from iwgnet_grasp.report.pictures import (
    INVALID,
    View,
    colored_depth,
    grasp_corners,
    write_pictures,
)

CAMERA = CameraIntrinsics(640.0, 640.0, 639.5, 399.5)


def look(count: int) -> Look:
    color = np.full((800, 1280, 3), (90, 100, 110), np.uint8)
    empty = np.full((800, 1280), 0.6, np.float32)
    depth = empty.copy()
    objects, windows = [], []
    for i in range(count):
        box = Box(400 + 70 * i, 300 + 20 * i, 80, 60)
        depth[box.slices] = 0.58
        u, v = box.center
        grasp = GraspRectangle(u, v, 0.4 * i, 40.0, 0.8, 0.58)
        objects.append(ObjectGrasps(i, "connecting_rod", 0.9, box, u, v, 0.58, 4800, (grasp,)))
        windows.append(crop_window(depth, empty, box, 224))
    depth[10, 10] = np.nan
    return Look(color, depth, empty, tuple(objects), tuple(windows))


@pytest.mark.parametrize("count", [0, 1, 5, 12])
def test_four_readable_pictures(tmp_path, count):
    seen = look(count)
    paths = write_pictures(
        tmp_path / "pictures", seen, rank(seen.objects, CAMERA, PriorityConfig.load()), prefix="1_"
    )
    assert [p.name for p in paths] == [
        "1_scene.png",
        "1_boxes.png",
        "1_merged_depth.png",
        "1_grasps.png",
    ]
    for path in paths:
        image = cv2.imread(str(path))
        assert image is not None and min(image.shape[:2]) > 200
        assert image.std() > 1.0


def test_objects_without_depth_or_grasp_are_drawn_too(tmp_path):
    seen = look(3)
    nan = math.nan
    blind = replace(
        seen.objects[1],
        centroid_u_px=nan,
        centroid_v_px=nan,
        centroid_depth_m=nan,
        valid_pixels=0,
    )
    seen = replace(seen, objects=(seen.objects[0], blind, replace(seen.objects[2], grasps=())))
    ranking = rank(seen.objects, CAMERA, PriorityConfig.load())
    assert len(write_pictures(tmp_path, seen, ranking)) == 4


def test_chosen_grasp_is_drawn_instead_of_the_best(tmp_path):
    seen = look(1)
    ranking = rank(seen.objects, CAMERA, PriorityConfig.load())
    other = GraspRectangle(420.0, 310.0, 1.2, 60.0, 0.3, 0.58)
    best = write_pictures(tmp_path / "best", seen, ranking)[3].read_bytes()
    chosen = write_pictures(tmp_path / "chosen", seen, ranking, {0: other})[3].read_bytes()
    assert best != chosen


def test_colour_of_depth_tells_near_far_and_nothing():
    image = colored_depth(np.array([[0.5, 0.6, np.nan]], np.float32), 0.5, 0.6)
    near, far, nothing = image[0].astype(int)
    assert near[0] > near[2]  # warm
    assert far[2] > far[0]  # cold
    assert tuple(nothing) == INVALID


def test_jaws_close_along_theta():
    # 30 deg counter-clockwise as seen: to the right and up, so to smaller y.
    corners = grasp_corners(GraspRectangle(100.0, 100.0, math.radians(30), 40.0, 1.0))
    opening = corners[2:].mean(0) - corners[:2].mean(0)
    assert opening == pytest.approx([40 * math.cos(math.pi / 6), -40 * math.sin(math.pi / 6)])


def test_view_maps_pixels_to_the_magnified_picture():
    seen = look(2)
    view = View.around(seen)
    marked = seen.color.copy()
    marked[333, 444] = (255, 0, 0)
    shown = view.image(marked)
    u, v = view.points([[444, 333]])[0]
    brightest = np.unravel_index(np.argmax(shown[..., 0]), shown.shape[:2])
    assert (brightest[1], brightest[0]) == pytest.approx((u, v), abs=1.0)
