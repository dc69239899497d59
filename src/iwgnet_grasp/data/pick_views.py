"""Views of carried-out grasps with what became of them, from sets of 'iwgnet picks'."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.pick_outcomes import HEIGHT_STEP, UNMEASURED, PickedPile, read_pile
from iwgnet_grasp.perception.grasp_view import (
    CHANNELS,
    VIEW_CELLS,
    grasp_view,
    without_gaps,
)
from iwgnet_grasp.perception.types import GraspRectangle

log = logging.getLogger(__name__)

STILL = 0.01  # m that no other part moves: less than what another look would notice
_NOISE = 0.02  # height units (1 mm), largest standard deviation of white noise
_GAIN = 0.1  # +- of heights: another distance or size


@dataclass(frozen=True)
class PickViews:
    """views: (n, CHANNELS, S, S) float16 (grasp_view); outcomes: (n, 2) bool, as
    networks.pick_outcome.OUTPUTS; pose_quality: (n,), what was known without a network."""

    views: np.ndarray
    outcomes: np.ndarray
    pose_quality: np.ndarray

    def __len__(self) -> int:
        return len(self.views)


def pile_files(folder: Path) -> list[Path]:
    """The piles of a folder. DataError when there is none."""
    files = sorted(folder.glob("[0-9]*.npz"))
    if not files:
        raise DataError(f"{folder}: holds no picks; make some with 'iwgnet picks'")
    return files


def load_pick_views(
    files: Iterable[Path], progress: Callable[[], None] = lambda: None
) -> PickViews:
    """All picks of some piles; broken files are named and left out. DataError when none is left."""
    views, outcomes, qualities = [], [], []
    for path in files:
        try:
            pile = read_pile(path)
        except DataError as error:
            log.warning("%s", error)
        else:
            views.append(_views(pile))
            outcomes.append(np.column_stack([pile.good, pile.others_m < STILL]))
            qualities.append(pile.pose_quality)
        progress()
    if not views:
        raise DataError("no pile of picks can be read; make some with 'iwgnet picks'")
    return PickViews(*(np.concatenate(parts) for parts in (views, outcomes, qualities)))


def _views(pile: PickedPile) -> np.ndarray:
    heights = [
        without_gaps(np.where(h == UNMEASURED, np.nan, h * HEIGHT_STEP).astype(np.float32))
        for h in pile.heights
    ]
    views = np.empty((len(pile.look), CHANNELS, VIEW_CELLS, VIEW_CELLS), np.float16)
    picks = zip(pile.look, pile.object_id, pile.grasps, strict=True)
    for i, (look, object_id, grasp) in enumerate(picks):
        views[i] = grasp_view(
            heights[look],
            pile.greys[look],
            pile.owners[look].astype(np.int16),
            int(object_id),
            GraspRectangle(*(float(v) for v in grasp)),
        )
    return views


class PickViewDataset(Dataset):
    """Input [CHANNELS, S, S] and outcomes [2], float32. With a seed a view is mirrored at random,
    along and across the jaws, and its heights disturbed: a function of (seed, index) alone."""

    def __init__(self, picks: PickViews, seed: tuple[int, ...] | None = None) -> None:
        self.picks, self.seed = picks, seed

    def __len__(self) -> int:
        return len(self.picks)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        view = self.picks.views[index].astype(np.float32)
        if self.seed is not None:
            rng = np.random.default_rng((*self.seed, index))
            view = view[:, :: rng.choice((-1, 1)), :: rng.choice((-1, 1))].copy()
            view[0] *= np.float32(rng.uniform(1 - _GAIN, 1 + _GAIN))
            noise = rng.standard_normal(view[0].shape, dtype=np.float32)
            view[0] += noise * np.float32(rng.uniform(0, _NOISE))
        outcome = self.picks.outcomes[index].astype(np.float32)
        return torch.from_numpy(view), torch.from_numpy(outcome)
