"""Training and validation crops from any of the layouts, held in memory."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from iwgnet_grasp.data.augmentation import Augmentation, centre_crop
from iwgnet_grasp.data.cornell import find_cornell
from iwgnet_grasp.data.depth import normalise_depth
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import X, Y, transform
from iwgnet_grasp.data.jacquard import find_jacquard
from iwgnet_grasp.data.labels import label_maps
from iwgnet_grasp.data.sample import GraspSample

log = logging.getLogger(__name__)

VIEW_PX = 300
NAMED_BROKEN = 10  # files that are named; more of them are counted
LAYOUTS = ("auto", "jacquard", "cornell")


@dataclass(frozen=True)
class Views:
    """Square views in memory: heights float16 [n, VIEW_PX, VIEW_PX] and their rectangles."""

    heights: np.ndarray
    rectangles: list[np.ndarray]
    names: list[str]

    def __len__(self) -> int:
        return len(self.names)


def find_samples(root: str | Path, layout: str = "auto") -> list[GraspSample]:
    """Samples below a folder. DataError when there are none."""
    root = Path(root)
    if layout not in LAYOUTS:
        raise DataError(f"no data layout '{layout}'; known: {', '.join(LAYOUTS)}")
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; make a set with 'iwgnet dataset'")
    samples: list[GraspSample] = []
    if layout in ("auto", "jacquard"):
        samples = list(find_jacquard(root))
    if not samples and layout in ("auto", "cornell"):
        samples = list(find_cornell(root))
    if not samples:
        raise DataError(f"{root}: holds no *_grasps.txt (Jacquard) nor pcd*cpos.txt (Cornell)")
    return samples


def load_views(
    samples: Iterable[GraspSample], progress: Callable[[int], None] | None = None
) -> Views:
    """Reads samples into memory. A broken one is named in one warning and left out, after
    NAMED_BROKEN of them silently; DataError when none is left."""
    heights, rectangles, names = [], [], []
    broken = 0
    for count, sample in enumerate(samples, start=1):
        try:
            height, rows = square_view(sample.depth(), sample.rectangles())
        except (DataError, ValueError) as error:
            broken += 1
            message = str(error)
            if broken <= NAMED_BROKEN:
                log.warning(
                    "%s", message if isinstance(error, DataError) else f"{sample.name}: {message}"
                )
        else:
            heights.append(height.astype(np.float16))
            rectangles.append(rows)
            names.append(sample.name)
        if progress:
            progress(count)
    if not names:
        raise DataError(f"none of {broken} samples could be read; the warnings say why")
    if broken:
        log.warning("%d of %d samples were left out", broken, broken + len(names))
    return Views(np.stack(heights), rectangles, names)


def square_view(depth: np.ndarray, rectangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights [VIEW_PX, VIEW_PX] and rectangles of an image.

    A square image is scaled as a whole (Jacquard), another one is cut around its grasps without
    scaling (Cornell).
    """
    rows, columns = depth.shape
    height = normalise_depth(depth)
    if rows == columns:
        zoom = VIEW_PX / rows
        affine = np.array([[zoom, 0, (zoom - 1) / 2], [0, zoom, (zoom - 1) / 2]])
        if rows != VIEW_PX:
            height = cv2.resize(height, (VIEW_PX, VIEW_PX), interpolation=cv2.INTER_AREA)
    else:
        x, y = rectangles[:, [X, Y]].mean(axis=0)
        left = int(np.clip(x - VIEW_PX // 2, 0, max(columns - VIEW_PX, 0)))
        top = int(np.clip(y - VIEW_PX // 2, 0, max(rows - VIEW_PX, 0)))
        affine = np.array([[1, 0, -left], [0, 1, -top]], np.float64)
        view = np.zeros((VIEW_PX, VIEW_PX), np.float32)
        part = height[top : top + VIEW_PX, left : left + VIEW_PX]
        view[: part.shape[0], : part.shape[1]] = part
        height = view
    return height, transform(rectangles, affine)


class GraspDataset(Dataset):
    """Crops of `input_px` with their label maps.

    An item: heights [1, S, S] and labels [5, S, S] (q, cos, sin, width, mask), float32. With an
    augmentation the crop is a function of (seed, index) alone; without one it is the view's centre.
    `order`: (n,) the view of each item; by default item i is view i.
    """

    def __init__(
        self,
        views: Views,
        input_px: int,
        augmentation: Augmentation | None = None,
        seed: tuple[int, ...] = (0,),
        order: np.ndarray | None = None,
    ) -> None:
        self.views = views
        self.input_px = input_px
        self.augmentation = augmentation
        self.seed = seed
        self.order = np.arange(len(views)) if order is None else order

    def __len__(self) -> int:
        return len(self.order)

    def crop(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Heights [S, S] float32 and the rectangles [n, 6] in that crop."""
        view = self.order[index]
        height = self.views.heights[view].astype(np.float32)
        rectangles = self.views.rectangles[view]
        if self.augmentation is None:
            return centre_crop(height, rectangles, self.input_px)
        rng = np.random.default_rng((*self.seed, index))
        return self.augmentation(height, rectangles, self.input_px, rng)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        height, rectangles = self.crop(index)
        labels = label_maps(rectangles, self.input_px, self.input_px)
        return torch.from_numpy(height)[None], torch.from_numpy(np.stack(labels))
