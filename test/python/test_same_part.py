"""Patches of one part: how they are drawn, what the network sees, and a real pile."""

import cv2
import numpy as np
import pytest
import torch

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.mask_dataset import MaskViews
from iwgnet_grasp.data.patch_dataset import MIN_PATCH_PX, PatchDataset, random_patch
from iwgnet_grasp.networks.object_mask import ObjectMask
from iwgnet_grasp.networks.same_part import (
    CELL_PX,
    CHANNELS,
    VIEW_CELLS,
    SamePartEstimator,
    around,
    patch_view,
)
from iwgnet_grasp.networks.weights import WeightsError


def bar(shape=(300, 300)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[140:165, 80:220] = True
    return mask


def test_the_network_gives_a_logit_for_each_cell():
    logits = ObjectMask(CHANNELS).eval()(torch.zeros(2, CHANNELS, VIEW_CELLS, VIEW_CELLS))
    assert logits.shape == (2, VIEW_CELLS, VIEW_CELLS)


def test_a_patch_is_connected_and_of_its_mask_but_for_its_edges():
    mask = bar()
    mask[:, 150:160] = False  # something lies across it
    near = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    sizes = []
    for seed in range(60):
        patch = random_patch(mask, np.random.default_rng(seed))
        assert not (patch & ~near).any()
        assert cv2.connectedComponents(patch.astype(np.uint8))[0] == 2
        sizes.append(np.count_nonzero(patch))
    assert min(sizes) >= MIN_PATCH_PX and max(sizes) > 4 * min(sizes)
    small = np.zeros_like(mask)
    small[5:10, 5:10] = True
    np.testing.assert_array_equal(random_patch(small, np.random.default_rng(0)), small)


def test_a_view_has_the_patch_in_its_middle():
    heights, grey, patch = np.zeros((300, 300), np.float32), np.zeros((300, 300), np.uint8), bar()
    heights[patch], grey[patch] = 1.5, 200
    patch[:, 150:] = False
    height, brightness, seen = patch_view(heights, grey, patch, around(patch))
    rows, columns = np.nonzero(seen > 0.5)
    middle = (VIEW_CELLS - 1) / 2
    assert (rows.mean(), columns.mean()) == pytest.approx((middle, middle), abs=0.5)
    assert len(rows) == pytest.approx(np.count_nonzero(patch) / CELL_PX**2, rel=0.1)
    assert height[seen > 0.9].min() == pytest.approx(1.5)
    assert brightness[seen > 0.9].min() > 1 and brightness.mean() == pytest.approx(0, abs=1e-4)


def test_samples_keep_image_and_mask_together_and_undo_the_mirror():
    mask = bar()
    heights = np.where(mask, 1.0, 0.0)
    heights[200:260, 100:200] = -2.0  # a neighbour, as merging shows it
    views = MaskViews(heights[None].astype(np.float16), np.uint8(100 * mask)[None], mask[None])
    change = Augmentation(noise=0, tilt=0, holes=0, shift_px=0)
    for seed in range(10):
        dataset = PatchDataset(views, change, (seed,))
        (height, _, patch), whole = dataset[0]
        assert height.min() >= 0 and height.max() == pytest.approx(2.0)
        assert height[whole > 0].median() == pytest.approx(1.0)
        inside = patch > 0.5
        assert (whole[inside] > 0).float().mean() > 0.8
        assert torch.equal(dataset[0][1], whole)


def test_weights_that_are_missing_are_named(tmp_path):
    with pytest.raises(WeightsError, match="iwgnet train mask --network same-part"):
        SamePartEstimator(tmp_path / "no.safetensors")
    with pytest.raises(WeightsError):
        SamePartEstimator("object-mask")


def test_patches_of_piled_parts_are_completed():
    core = pytest.importorskip("iwgnet_grasp._core")
    from iwgnet_grasp.perception.grasp_view import without_gaps
    from iwgnet_grasp.trials.in_process import PACKAGE

    cell = core.SimulatedCell(str(PACKAGE))
    cell.load_scene("", 0)
    empty = cell.aligned_depth(cell.depth())
    cell.load_scene("seven_stacked", 3)
    heights = without_gaps(empty - cell.aligned_depth(cell.depth()))
    grey = cv2.cvtColor(cell.color(), cv2.COLOR_RGB2GRAY)
    truth = cell.part_mask()
    estimator = SamePartEstimator("same-part")
    rng = np.random.default_rng(0)
    masks = [truth == part for part in np.unique(truth[truth >= 0])]
    patches = [random_patch(mask, rng) for mask in masks]
    shares = []
    for mask, found in zip(masks, estimator.predict(heights, grey, patches), strict=True):
        found = found > 0.5
        shares.append(np.count_nonzero(found & mask) / np.count_nonzero(found | mask))
    assert np.median(shares) > 0.75
