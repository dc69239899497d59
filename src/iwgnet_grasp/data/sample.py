"""One annotated image of a grasp data set, whatever its layout on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np


class GraspSample(Protocol):
    name: str
    group: str  # samples of one group show the same object: never on both sides of a split

    def depth(self) -> np.ndarray:
        """float32 [H, W], m; invalid where not finite or <= 0. DataError."""
        ...

    def rectangles(self) -> np.ndarray:
        """float32 [n, 6] (data.grasp_rectangle), n >= 1. DataError."""
        ...


@dataclass(frozen=True)
class View:
    """A sample cut or scaled to a square that the training crops lie in."""

    depth: np.ndarray
    rectangles: np.ndarray


def image_wise_split(
    samples: list[GraspSample], validation: float, seed: int
) -> tuple[list[GraspSample], list[GraspSample]]:
    """Random split of the images: objects of the training images may be seen again."""
    order = np.random.default_rng(seed).permutation(len(samples))
    count = _share(len(samples), validation)
    held_out = set(order[:count].tolist())
    return (
        [s for i, s in enumerate(samples) if i not in held_out],
        [s for i, s in enumerate(samples) if i in held_out],
    )


def object_wise_split(
    samples: list[GraspSample], validation: float, seed: int
) -> tuple[list[GraspSample], list[GraspSample]]:
    """Random split of the groups: no object of the validation images was trained on."""
    groups = sorted({s.group for s in samples})
    order = np.random.default_rng(seed).permutation(len(groups))
    held_out = {groups[i] for i in order[: _share(len(groups), validation)]}
    return (
        [s for s in samples if s.group not in held_out],
        [s for s in samples if s.group in held_out],
    )


def _share(count: int, fraction: float) -> int:
    """A share of the whole that leaves something on both sides where that can be."""
    return min(max(round(count * fraction), 1), max(count - 1, 0))


def relative_name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()
