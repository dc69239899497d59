"""Data sets on disk: Jacquard's and Cornell's layouts, depth, splits, broken files."""

import logging

import numpy as np
import pytest
import tifffile

from iwgnet_grasp.data.cornell import find_cornell, read_corners
from iwgnet_grasp.data.depth import (
    HEIGHT_CLIP,
    HEIGHT_UNIT,
    fill_holes,
    normalise_depth,
    support_plane,
)
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_dataset import (
    VIEW_PX,
    GraspDataset,
    find_samples,
    load_views,
    square_view,
)
from iwgnet_grasp.data.grasp_rectangle import JAW, OPENING, QUALITY, THETA, X, Y
from iwgnet_grasp.data.images import read_depth
from iwgnet_grasp.data.jacquard import format_grasps, read_grasps
from iwgnet_grasp.data.sample import image_wise_split, object_wise_split

TABLE = 0.6


def table(size=VIEW_PX, seed=0):
    noise = np.random.default_rng(seed).normal(0, 4e-4, (size, size))
    return (TABLE + noise).astype(np.float32)


def write_sample(root, name="0_7", grasps="150;150;30;60;24\r\n", quality=None, depth=None):
    folder = root / name.partition("_")[2]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}_grasps.txt").write_bytes(grasps.encode())
    if quality is not None:
        (folder / f"{name}_quality.txt").write_text(quality)
    tifffile.imwrite(folder / f"{name}_stereo_depth.tiff", table() if depth is None else depth)
    return folder


def test_jacquard_grasps_with_crlf_negated_angle_and_quality(tmp_path):
    write_sample(
        tmp_path,
        grasps="150.5;140;30;60;24\r\n10;20;-100;40;20\r\n",
        quality="0.25\n1\n",
    )
    (sample,) = find_samples(tmp_path)
    assert (sample.name, sample.group) == ("0_7", "7")
    first, second = sample.rectangles()
    assert first[[X, Y, OPENING, JAW, QUALITY]] == pytest.approx([150.5, 140, 60, 24, 0.25])
    assert first[THETA] == pytest.approx(-np.radians(30))
    assert second[THETA] == pytest.approx(np.radians(-80))  # +100 deg is -80 deg
    assert second[QUALITY] == 1


def test_jacquard_without_a_quality_file_counts_all_grasps_alike(tmp_path):
    write_sample(tmp_path)
    assert find_samples(tmp_path)[0].rectangles()[0, QUALITY] == 1


def test_written_grasps_are_read_back(tmp_path):
    rows = np.array([[10, 20, 1.5, 40, 22, 1], [30, 40, -1.5, 41, 22, 1]], np.float32)
    path = tmp_path / "0_1_grasps.txt"
    path.write_bytes(format_grasps(rows).encode())
    np.testing.assert_allclose(read_grasps(path), rows, atol=1e-3)


@pytest.mark.parametrize(
    "text, message",
    [
        ("1;2;3;4;5\n1;2;drei;4;5\n", "grasps.txt:2: must be 'x;y;theta;opening;jaw'"),
        ("1;2;3;4\n", "grasps.txt:1: must be"),
        ("1;2;nan;4;5\n", "grasps.txt:1: not a rectangle"),
        ("1;2;3;-4;5\n", "grasps.txt:1: not a rectangle"),
        ("\r\n", "holds no grasp"),
    ],
)
def test_a_broken_grasp_file_is_named_with_its_line(tmp_path, text, message):
    write_sample(tmp_path, grasps=text)
    with pytest.raises(DataError, match=message) as caught:
        find_samples(tmp_path)[0].rectangles()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text, message",
    [("0.5\n0.5\n", "2 numbers for 1"), ("gut\n", "one number a line"), ("1.5\n", r"in \(0, 1\]")],
)
def test_a_broken_quality_file_is_named(tmp_path, text, message):
    write_sample(tmp_path, quality=text)
    with pytest.raises(DataError, match=message):
        find_samples(tmp_path)[0].rectangles()


def test_a_truncated_image_is_named_and_the_rest_goes_on(tmp_path, caplog):
    write_sample(tmp_path, "0_1")
    folder = write_sample(tmp_path, "0_2")
    image = folder / "0_2_stereo_depth.tiff"
    image.write_bytes(image.read_bytes()[:100_000])
    write_sample(tmp_path, "0_3", depth=np.zeros((VIEW_PX, VIEW_PX), np.uint8))
    (write_sample(tmp_path, "0_4") / "0_4_stereo_depth.tiff").unlink()
    write_sample(tmp_path, "0_5", depth=np.full((VIEW_PX, VIEW_PX), -1, np.float32))
    with caplog.at_level(logging.WARNING):
        views = load_views(find_samples(tmp_path))
    assert views.names == ["0_1"]
    lines = [record.getMessage() for record in caplog.records]
    assert lines.pop() == "4 of 5 samples were left out"
    assert len(lines) == 4 and not any("\n" in line for line in lines)
    assert "0_2_stereo_depth.tiff: not a whole TIFF" in lines[0]
    assert "one channel of float32" in lines[1]
    assert "no such depth image" in lines[2]
    assert "0_5: depth image has no valid pixels" in lines[3]


def test_no_usable_sample_is_an_error(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        find_samples(tmp_path / "absent")
    with pytest.raises(DataError, match="holds no"):
        find_samples(tmp_path)
    (write_sample(tmp_path) / "0_7_stereo_depth.tiff").write_bytes(b"")
    with pytest.raises(DataError, match="none of 1 samples could be read"):
        load_views(find_samples(tmp_path))


def test_deflated_images_are_read(tmp_path):
    image = table()
    tifffile.imwrite(tmp_path / "a.tiff", image, compression="zlib")
    np.testing.assert_array_equal(read_depth(tmp_path / "a.tiff"), image)


CORNELL = """253 319.7
309 324
307 350
251 345.7
NaN NaN
200 300
210 310
190 310
100 200
100 160
80 160
80 200
"""


def write_cornell(root, number, text=CORNELL):
    (root / f"pcd{number:04d}cpos.txt").write_text(text.replace("\n", "\r\n"))
    depth = np.full((480, 640), 0.8, np.float32)
    depth[100:120, 100:130] = np.nan
    tifffile.imwrite(root / f"pcd{number:04d}d.tiff", depth)


def test_cornell_corners_with_nan_and_crlf(tmp_path):
    write_cornell(tmp_path, 100)
    rows = read_corners(tmp_path / "pcd0100cpos.txt")
    assert len(rows) == 2  # the one with NaN corners is left out
    assert rows[0, [X, Y]] == pytest.approx([280, 334.85])
    assert rows[0, THETA] == pytest.approx(np.arctan2(-4.3, 56))
    assert rows[0, [OPENING, JAW]] == pytest.approx([np.hypot(56, 4.3), np.hypot(2, 26)], rel=1e-5)
    assert abs(rows[1, THETA]) == pytest.approx(np.pi / 2)  # opens along y
    assert rows[1, OPENING] == pytest.approx(40)


def test_cornell_view_is_cut_around_the_grasps_without_scaling(tmp_path):
    write_cornell(tmp_path, 100)
    (sample,) = find_samples(tmp_path)
    height, rows = square_view(sample.depth(), sample.rectangles())
    assert height.shape == (VIEW_PX, VIEW_PX) and np.isfinite(height).all()
    assert rows[0, OPENING] == pytest.approx(np.hypot(56, 4.3), rel=1e-5)
    assert ((rows[:, [X, Y]] >= 0) & (rows[:, [X, Y]] < VIEW_PX)).all()


@pytest.mark.parametrize(
    "text, message", [("1 2\n3 4\n5 6\n", "not a multiple of four"), ("1 zwei\n", ":1: must be")]
)
def test_broken_cornell_corners(tmp_path, text, message):
    write_cornell(tmp_path, 1, text)
    with pytest.raises(DataError, match=message):
        read_corners(tmp_path / "pcd0001cpos.txt")


def test_cornell_objects_come_from_z_txt(tmp_path):
    for number in (100, 101, 102):
        write_cornell(tmp_path, number)
    (tmp_path / "z.txt").write_text("100 1 cup 1\n101 1 cup 1\n102 2 pen 1\n")
    assert [s.group for s in find_cornell(tmp_path)] == ["1", "1", "2"]


def test_splits(tmp_path):
    for scene in range(6):
        for item in range(3):
            write_sample(tmp_path, f"{item}_{scene}")
    samples = find_samples(tmp_path)
    assert len(samples) == 18
    train, test = object_wise_split(samples, 1 / 3, seed=1)
    assert len(test) == 6 and len(train) == 12
    assert not {s.group for s in train} & {s.group for s in test}
    train, test = image_wise_split(samples, 1 / 3, seed=1)
    assert len(test) == 6 and len(train) == 12
    assert {s.group for s in train} & {s.group for s in test}
    again = image_wise_split(samples, 1 / 3, seed=1)
    assert [s.name for s in again[1]] == [s.name for s in test]
    assert [s.name for s in image_wise_split(samples, 1 / 3, seed=2)[1]] != [s.name for s in test]


def test_jacquard_images_are_scaled_to_the_view_with_their_widths():
    depth = np.full((1024, 1024), 1.5, np.float32)
    rows = np.array([[511.5, 511.5, 0.4, 102.4, 51.2, 1]], np.float32)
    height, moved = square_view(depth, rows)
    assert height.shape == (VIEW_PX, VIEW_PX)
    centre = (VIEW_PX - 1) / 2
    assert moved[0] == pytest.approx([centre, centre, 0.4, 30, 15, 1], abs=1e-3)


def test_the_table_is_found_under_objects_on_a_tilted_plane():
    v, u = np.mgrid[0:300, 0:300]
    plane = 0.6 + 1e-4 * (u - 150) - 5e-5 * (v - 150)
    depth = (plane + np.random.default_rng(0).normal(0, 5e-4, plane.shape)).astype(np.float32)
    depth[80:220, 100:220] -= 0.03  # an object over a fifth of the image
    depth[::7, ::5] = np.nan
    assert np.abs(support_plane(depth) - plane).max() < 1e-3


def test_network_input_is_the_height_above_the_table():
    depth = table()
    depth[100:150, 100:150] -= 0.02
    depth[200:220, 200:220] -= 0.5
    height = normalise_depth(depth)
    assert height[110:140, 110:140].mean() == pytest.approx(0.02 / HEIGHT_UNIT, abs=0.01)
    assert height[:90].mean() == pytest.approx(0, abs=0.01)
    assert height.max() == HEIGHT_CLIP[1]
    # The same with and without the empty scene, as in training and on the robot.
    with_empty = normalise_depth(depth, support_plane(table(seed=1)))
    assert np.abs(with_empty - height).max() < 0.02


@pytest.mark.parametrize("hole", [np.nan, -1.0, 0.0])
def test_holes_take_the_value_around_them(hole):
    depth = table()
    depth[100:180, 100:180] -= 0.02
    whole = normalise_depth(depth)
    depth[130:145, 130:150] = hole
    depth[20:24, 20:90] = hole
    height = normalise_depth(depth)
    assert np.isfinite(height).all()
    assert np.abs(height - whole).max() < 0.15


def test_an_image_full_of_holes_is_filled_or_refused():
    values = np.zeros((64, 64), np.float32)
    valid = np.zeros((64, 64), bool)
    values[0, 0], valid[0, 0] = 2.0, True
    np.testing.assert_allclose(fill_holes(values, valid), 2.0)
    with pytest.raises(ValueError, match="no valid pixels"):
        normalise_depth(np.full((64, 64), np.nan, np.float32))


def test_a_training_item_is_a_function_of_seed_and_index(tmp_path):
    from iwgnet_grasp.data.augmentation import Augmentation

    write_sample(tmp_path)
    views = load_views(find_samples(tmp_path))
    item, labels = GraspDataset(views, 224, Augmentation(), seed=(1, 2))[0]
    assert item.shape == (1, 224, 224) and labels.shape == (5, 224, 224)
    again = GraspDataset(views, 224, Augmentation(), seed=(1, 2))[0][0]
    other = GraspDataset(views, 224, Augmentation(), seed=(1, 3))[0][0]
    assert (item == again).all() and not (item == other).all()
