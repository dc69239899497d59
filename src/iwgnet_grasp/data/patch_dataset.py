"""Views of patches of parts with all that is seen of the part, from sets of 'iwgnet dataset'."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.mask_dataset import MaskViews
from iwgnet_grasp.networks.same_part import CELL_PX, VIEW_CELLS, around, patch_view, without_specks

MIN_PATCH_PX = 120
_EDGE_PX = 5  # most that a patch's edge is off


def random_patch(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A connected patch of a mask (H, W) bool that is not empty, as occluders or a wrong mask leave
    it: one of its pieces, cut at random, with edges that are a little off; where none of
    MIN_PATCH_PX is left, the largest piece as it is."""
    cut = mask
    if rng.random() < 0.7:  # by a line, some of the time by two
        rows, columns = np.nonzero(mask)
        for _ in range(rng.integers(1, 3)):
            at = rng.integers(len(rows))
            angle = rng.uniform(0, 2 * np.pi)
            v, u = np.indices(mask.shape, sparse=True)
            side = (u - columns[at]) * np.cos(angle) + (v - rows[at]) * np.sin(angle)
            cut = cut & (side > 0)
    size = int(rng.integers(1, _EDGE_PX + 1))
    change = cv2.erode if rng.random() < 0.7 else cv2.dilate
    pieces, areas = _pieces(change(cut.astype(np.uint8), np.ones((size, size), np.uint8)))
    large = np.flatnonzero(areas >= MIN_PATCH_PX)
    if len(large):
        return pieces == rng.choice(large)
    pieces, areas = _pieces(mask.astype(np.uint8))
    return pieces == areas.argmax()


def _pieces(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) number of each pixel's connected piece, and the pieces' areas; 0: none."""
    _, pieces, statistics, _ = cv2.connectedComponentsWithStats(mask)
    areas = statistics[:, cv2.CC_STAT_AREA]
    areas[0] = 0
    return pieces, areas


class PatchDataset(Dataset):
    """Views [CHANNELS, S, S] and masks [S, S] of S = VIEW_CELLS, float32: functions of (seed,
    index) alone."""

    def __init__(
        self,
        views: MaskViews,
        augmentation: Augmentation | None = None,
        seed: tuple[int, ...] = (0,),
    ) -> None:
        self.views, self.augmentation, self.seed = views, augmentation, seed

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng((*self.seed, index))
        mask = self.views.masks[index]
        # Neighbours are mirrored at the table in these views (perception.merged_depth.merge).
        heights = without_specks(np.abs(self.views.heights[index].astype(np.float32)))
        patch = random_patch(mask, rng) if mask.any() else mask
        affine = around(patch if patch.any() else np.ones_like(patch))
        if self.augmentation is not None:
            turn = self.augmentation.similarity(mask.shape, mask.shape[0], rng)[:, :2] / CELL_PX
            middle = (VIEW_CELLS - 1) / 2
            centre = np.linalg.solve(affine[:, :2], middle - affine[:, 2])
            affine = np.column_stack([turn, middle - turn @ centre])
        view = patch_view(heights, self.views.greys[index], patch, affine)
        if self.augmentation is not None:
            self.augmentation.disturb(view[0], rng)
        size = VIEW_CELLS, VIEW_CELLS
        whole = cv2.warpAffine(mask.astype(np.float32), affine, size, flags=cv2.INTER_LINEAR)
        return torch.from_numpy(view), torch.from_numpy((whole > 0.5).astype(np.float32))
