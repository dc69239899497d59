"""Which pixels are an object's: the network, its training on small files, and a real pile."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile
import torch

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.mask_dataset import MaskDataset, load_mask_views
from iwgnet_grasp.networks.object_mask import (
    INPUT_PX,
    MaskEstimator,
    ObjectMask,
    mask_loss,
    normalise_grey,
)
from iwgnet_grasp.networks.weights import WeightsError
from iwgnet_grasp.training.mask_training import MaskTrainingSettings, iou, train_mask_network

VIEW = 300
TABLE = 0.6  # m


def write_set(folder, count, rgb=True):
    """Bars before a table, each with a taller neighbour at its end, as 'iwgnet dataset' writes."""
    rng = np.random.default_rng(5)
    for i in range(count):
        scene = folder / f"{i:06d}"
        scene.mkdir(parents=True)
        depth = np.full((VIEW, VIEW), TABLE, np.float32)
        mask = np.zeros((VIEW, VIEW), np.uint8)
        y, length = int(rng.integers(120, 160)), int(rng.integers(50, 90))
        mask[y : y + 22, 150 - length : 150 + length] = 255
        depth[mask > 0] = TABLE - 0.02
        depth[y - 30 : y + 50, 150 + length : 175 + length] = TABLE - 0.05
        depth += rng.normal(0, 0.0005, depth.shape).astype(np.float32)
        stem = scene / f"0_{i:06d}"
        tifffile.imwrite(f"{stem}_stereo_depth.tiff", depth)
        cv2.imwrite(f"{stem}_mask.png", mask)
        if rgb:
            cv2.imwrite(f"{stem}_RGB.png", np.dstack([60 + mask // 3] * 3))
        (scene / f"0_{i:06d}_grasps.txt").write_text("150;130;90;22;22\r\n")
    return folder


def test_the_network_gives_a_logit_for_each_pixel():
    logits = ObjectMask().eval()(torch.zeros(2, 2, INPUT_PX, INPUT_PX))
    assert logits.shape == (2, INPUT_PX, INPUT_PX)


def test_the_loss_is_least_for_the_true_mask():
    mask = torch.zeros(1, 8, 8)
    mask[:, 2:5, 2:5] = 1
    right, nothing = 20 * (2 * mask - 1), torch.full_like(mask, -20)
    assert mask_loss(right, mask) == pytest.approx(0, abs=1e-4)
    assert mask_loss(nothing, mask) > mask_loss(torch.zeros_like(mask), mask) > 0.1


def test_iou_of_masks():
    a, b = torch.zeros(2, 4, 4, dtype=torch.bool), torch.zeros(2, 4, 4, dtype=torch.bool)
    a[0, :2], b[0, 1:3] = True, True  # 4 of 12 px
    assert iou(a, b) == pytest.approx((1 / 3 + 1) / 2)  # the second is empty in both


def test_brightness_and_contrast_make_no_difference():
    grey = np.random.default_rng(0).integers(0, 100, (20, 20), dtype=np.uint8)
    np.testing.assert_allclose(normalise_grey(grey), normalise_grey(2 * grey + 30), atol=1e-5)
    assert np.abs(normalise_grey(np.full((20, 20), 9, np.uint8))).max() == 0


def test_an_augmented_window_keeps_image_and_mask_together(tmp_path):
    from iwgnet_grasp.data.augmentation import Augmentation

    views = load_mask_views([write_set(tmp_path, 3)])
    dataset = MaskDataset(views, Augmentation(noise=0, tilt=0, holes=0), (1, 2))
    for i in range(3):
        (height, grey), mask = dataset[i]
        inside = mask > 0
        assert 2000 < inside.sum() < 6000
        assert height[inside].mean() == pytest.approx(1.0, abs=0.1)  # 20 mm
        assert grey[inside].mean() > grey[~inside].mean() + 1
        again = dataset[i]
        assert torch.equal(again[0][0], height) and torch.equal(again[1], mask)


def test_upright_boxes_stay_upright_where_only_quarter_turns_are_made(tmp_path):
    from iwgnet_grasp.data.augmentation import Augmentation

    views = load_mask_views([write_set(tmp_path, 1)])
    change = Augmentation(noise=0, tilt=0, holes=0, any_turn=False)
    shapes = set()
    for seed in range(12):
        _, mask = MaskDataset(views, change, (seed,))[0]
        x, y, width, height = cv2.boundingRect(mask.numpy().astype(np.uint8))
        assert mask[y : y + height, x : x + width].mean() > 0.97  # the bar fills its box
        shapes.add(width > height)
    assert shapes == {True, False}


def test_training_learns_bars_goes_on_after_a_stop_and_says_how_it_was_made(tmp_path):
    train, val = write_set(tmp_path / "train", 24), write_set(tmp_path / "val", 4)
    settings = MaskTrainingSettings(epochs=8, batch=4)
    where = {"data": [train], "validation_data": val, "log_dir": tmp_path / "logs"}
    weights = train_mask_network(settings, out=tmp_path / "whole", **where)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["network"] == "object-mask" and card["training"]["epochs"] == 8
    assert card["data"]["samples"] == 24 and card["validation"]["iou"] > 0.5
    resumed = train_mask_network(settings, out=tmp_path / "again", resume=True, **where)
    assert resumed.read_bytes() == weights.read_bytes()  # it had ended: nothing is left to do
    with pytest.raises(DataError, match="epochs 8, not 9"):
        train_mask_network(replace(settings, epochs=9), out=tmp_path, resume=True, **where)
    with pytest.raises(DataError, match="no such folder"):
        train_mask_network(settings, [tmp_path / "no"], val, tmp_path, tmp_path)


def test_files_that_cannot_be_used_are_named(tmp_path, caplog):
    with pytest.raises(DataError, match="RGB"):
        load_mask_views([write_set(tmp_path / "grasps only", 2, rgb=False)])
    assert "0_000000_RGB.png" in caplog.text
    with pytest.raises(WeightsError, match="iwgnet train mask"):
        MaskEstimator(tmp_path / "no.safetensors")
    with pytest.raises(WeightsError, match="input_px"):
        MaskEstimator("yolov5s")


def test_the_pixels_of_piled_parts_are_found():
    core = pytest.importorskip("iwgnet_grasp._core")
    from iwgnet_grasp.perception import load_perception
    from iwgnet_grasp.trials.in_process import PACKAGE

    cell = core.SimulatedCell(str(PACKAGE))
    cell.load_scene("", 0)
    empty = cell.aligned_depth(cell.depth())
    parts = cell.load_scene("seven_stacked", 3)
    look = load_perception().look(cell.color(), cell.aligned_depth(cell.depth()), empty)
    truth = cell.part_mask()
    shares = []
    for o in look.objects:
        mine = look.owners == o.object_id
        best = max(range(parts), key=lambda part: np.count_nonzero(mine & (truth == part)))
        both = np.count_nonzero(mine & (truth == best))
        shares.append(both / np.count_nonzero(mine | (truth == best)))
    assert np.median(shares) > 0.85
