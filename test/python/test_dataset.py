"""Generated data: layout, labels that fit the images, the same bits on any number of workers."""

import filecmp
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from typer.testing import CliRunner

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.generate import (
    CROP_PX,
    as_detected,
    bounding_box,
    generate_dataset,
    sole_writer,
)
from iwgnet_grasp.data.grasp_rectangle import JAW, OPENING, QUALITY, X, Y
from iwgnet_grasp.data.images import read_depth
from iwgnet_grasp.data.jacquard import find_jacquard

SCENES, SEED = 3, 5


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("set")
    scenes, crops = generate_dataset(SCENES, SEED, out, ["connecting_rod"], 1, quiet=True)
    assert scenes == SCENES and crops > 0
    return out


def files(root: Path) -> list[str]:
    return sorted(
        str(p.relative_to(root)) for p in root.rglob("*") if p.is_file() and p.name != ".lock"
    )


def test_every_crop_has_all_its_files_in_the_agreed_size(dataset):
    samples = find_jacquard(dataset)
    assert samples
    for sample in samples:
        color = cv2.imread(f"{sample.stem}_RGB.png")
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE)
        assert color.shape == (CROP_PX, CROP_PX, 3)
        assert mask.shape == (CROP_PX, CROP_PX) and mask.any()
        for kind in ("perfect", "stereo"):
            depth = read_depth(Path(f"{sample.stem}_{kind}_depth.tiff"))
            assert depth.shape == (CROP_PX, CROP_PX)
            known = depth[depth != -1]
            assert known.min() > 0.4 and known.max() < 0.8


def test_grasps_lie_on_their_object_and_fit_the_gripper(dataset):
    for sample in find_jacquard(dataset):
        rows = sample.rectangles()
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE) > 0
        near = cv2.dilate(mask.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
        assert ((rows[:, QUALITY] > 0) & (rows[:, QUALITY] <= 1)).all()
        # 85 mm at about 0.55 m and fx 640 px.
        assert (rows[:, OPENING] < 110).all() and (rows[:, JAW] > 10).all()
        columns, lines = np.round(rows[:, [X, Y]]).astype(int).T
        assert near[lines, columns].all()


def test_the_object_rises_over_the_table_in_both_depths(dataset):
    for sample in find_jacquard(dataset):
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE) > 0
        for kind in ("perfect", "stereo"):
            depth = read_depth(Path(f"{sample.stem}_{kind}_depth.tiff"))
            table = np.median(depth[~mask & (depth > 0)])
            assert np.median(depth[mask & (depth > 0)]) < table - 0.005


def test_boxes_are_those_of_their_masks(dataset):
    text = json.loads((dataset / "detector" / "annotations.json").read_text())
    assert text["categories"] == [{"id": 1, "name": "connecting_rod"}]
    assert len(text["images"]) == SCENES
    assert len({a["id"] for a in text["annotations"]}) == len(text["annotations"]) > 0
    for image in text["images"]:
        picture = cv2.imread(str(dataset / "detector" / "images" / image["file_name"]))
        assert picture.shape == (image["height"], image["width"], 3)
    for entry in text["annotations"]:
        mask = coco_mask.decode(entry["segmentation"])
        assert mask.sum() == entry["area"]
        assert list(bounding_box(mask > 0)) == entry["bbox"]


def test_going_on_gives_the_same_set_as_one_run_on_two_workers(dataset, tmp_path):
    generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
    generate_dataset(SCENES, SEED, tmp_path, ["connecting_rod"], 2, quiet=True)
    assert files(tmp_path) == files(dataset)
    _, differ, errors = filecmp.cmpfiles(dataset, tmp_path, files(dataset), shallow=False)
    assert differ == [] and errors == []


def test_a_folder_with_another_set_is_refused(dataset):
    with pytest.raises(DataError, match="another"):
        generate_dataset(SCENES, SEED + 1, dataset, ["connecting_rod"], 1, quiet=True)


def test_an_unknown_family_is_named_with_the_known_ones(tmp_path):
    with pytest.raises(DataError, match=r"unicorn.*connecting_rod"):
        generate_dataset(1, 0, tmp_path / "set", ["unicorn"], 1, quiet=True)
    assert not (tmp_path / "set").exists()


def test_the_command_says_what_is_wrong_in_one_line(tmp_path):
    import typer

    from iwgnet_grasp.data.generate import generate

    app = typer.Typer()
    app.command()(generate)
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--families", "unicorn"])
    assert result.exit_code == 2
    assert "unicorn" in result.output and "Traceback" not in result.output


def test_detected_boxes_stay_near_the_true_one_and_in_the_image():
    rng = np.random.default_rng(0)
    crop = {"box_shift_px": 4.0, "box_scale": 0.08}
    for _ in range(200):
        box = as_detected(np.array([2, 700, 150, 99]), (800, 1280, 3), crop, rng)
        assert box.x >= 0 and box.y >= 0
        assert box.x + box.width <= 1280 and box.y + box.height <= 800
        assert abs(box.x - 2) <= 11 and abs(box.width - 150) <= 24


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    with (
        sole_writer(tmp_path),
        pytest.raises(DataError, match="another run"),
    ):
        generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
