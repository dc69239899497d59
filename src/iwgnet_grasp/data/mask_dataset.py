"""Windows with the mask of the object that they were cut around, from sets of 'iwgnet dataset'."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.depth import normalise_depth
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.images import read_depth
from iwgnet_grasp.data.jacquard import find_stems
from iwgnet_grasp.networks.object_mask import INPUT_PX, normalise_grey

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MaskViews:
    """(n, S, S) each: heights float16 (normalise_depth), greys uint8, masks bool."""

    heights: np.ndarray
    greys: np.ndarray
    masks: np.ndarray

    def __len__(self) -> int:
        return len(self.heights)


def find_masks(folder: Path) -> list[Path]:
    """jacquard.find_stems() of all objects of a set, also of those that nothing can grasp."""
    return find_stems(folder, "_mask.png")


def load_mask_views(
    folders: Iterable[Path], progress: Callable[[], None] = lambda: None
) -> MaskViews:
    """All objects of the sets; broken files are named and left out. DataError when none is left:
    a set made with --no-detector has no colour images."""
    heights, greys, masks = [], [], []
    for folder in folders:
        for stem in find_masks(folder):
            try:
                depth = read_depth(Path(f"{stem}_stereo_depth.tiff"))
                grey = _grey(Path(f"{stem}_RGB.png"), depth.shape)
                mask = _grey(Path(f"{stem}_mask.png"), depth.shape) > 0
                height = normalise_depth(depth).astype(np.float16)
            except (DataError, ValueError) as error:
                log.warning("%s", error)
            else:
                heights.append(height)
                greys.append(grey)
                masks.append(mask)
            progress()
    if not heights:
        names = ", ".join(str(folder) for folder in folders)
        raise DataError(f"{names}: no object with depth, RGB and mask; make a set with its images")
    return MaskViews(np.stack(heights), np.stack(greys), np.stack(masks))


def _grey(path: Path, shape: tuple[int, int]) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None or image.shape != shape:
        raise DataError(f"{path}: is missing or not an image of {shape[1]}x{shape[0]} px")
    return image


class MaskDataset(Dataset):
    """Windows of `size` px: input [2, S, S] and mask [S, S], float32.

    With an augmentation a window is a function of (seed, index) alone, else the view's centre.
    """

    def __init__(
        self,
        views: MaskViews,
        augmentation: Augmentation | None = None,
        seed: tuple[int, ...] = (0,),
        size: int = INPUT_PX,
    ) -> None:
        self.views, self.size = views, size
        self.augmentation, self.seed = augmentation, seed

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        height = self.views.heights[index].astype(np.float32)
        images = [height, self.views.greys[index], self.views.masks[index].astype(np.float32)]
        if self.augmentation is None:
            top, left = ((n - self.size) // 2 for n in height.shape)
            cut = slice(top, top + self.size), slice(left, left + self.size)
            height, grey, mask = (image[cut] for image in images)
        else:
            rng = np.random.default_rng((*self.seed, index))
            affine = self.augmentation.similarity(height.shape, self.size, rng)
            height, grey, mask = (
                cv2.warpAffine(image, affine, (self.size, self.size), flags=cv2.INTER_LINEAR)
                for image in images
            )
            self.augmentation.disturb(height, rng)
        window = np.stack([height, normalise_grey(grey)])
        return torch.from_numpy(window), torch.from_numpy((mask > 0.5).astype(np.float32))
