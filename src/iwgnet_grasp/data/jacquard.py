"""Jacquard's on-disk layout, which this project's own sets are written in, too.

    FOLDER/<i>_<id>_{RGB.png, perfect_depth.tiff, stereo_depth.tiff, mask.png, grasps.txt}

grasps.txt: "x;y;theta;opening;jaw" a line, px and degrees, lines may end in CRLF; theta is
clockwise as seen, the negative of Cornell's and of `data.grasp_rectangle`. Depth is float32 m with
-1 where there is none. This project adds <i>_<id>_quality.txt, one number in (0, 1] a line in the
same order; without it all grasps are equally good (1).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import (
    COLUMNS,
    JAW,
    OPENING,
    QUALITY,
    THETA,
    X,
    Y,
    wrap_theta,
)
from iwgnet_grasp.data.images import read_depth

_GRASPS = "_grasps.txt"
DEPTHS = ("stereo", "perfect")


@dataclass(frozen=True)
class JacquardSample:
    """One object of one scene. `depth_kind`: "stereo" (noisy) or "perfect"."""

    stem: Path  # FOLDER/<i>_<id>
    depth_kind: str = "stereo"

    @property
    def name(self) -> str:
        return self.stem.name

    @property
    def group(self) -> str:
        """<id>: the object in Jacquard, the scene in this project's sets."""
        return self.stem.name.partition("_")[2] or self.stem.name

    def depth(self) -> np.ndarray:
        return read_depth(_beside(self.stem, f"_{self.depth_kind}_depth.tiff"))

    def rectangles(self) -> np.ndarray:
        path = _beside(self.stem, _GRASPS)
        rows = read_grasps(path)
        quality = _beside(self.stem, "_quality.txt")
        if quality.is_file():
            rows[:, QUALITY] = _read_quality(quality, len(rows))
        return rows


def find_jacquard(root: Path, depth_kind: str = "stereo") -> list[JacquardSample]:
    """All samples below a folder that have a grasps.txt, in the order of their names."""
    return [JacquardSample(stem, depth_kind) for stem in find_stems(root, _GRASPS)]


def find_stems(root: Path, ending: str) -> list[Path]:
    """What the names of an object's files begin with, of all below a folder that have one with
    this ending, in the order of their names."""
    return [f.with_name(f.name.removesuffix(ending)) for f in sorted(root.rglob(f"*{ending}"))]


def read_grasps(path: Path) -> np.ndarray:
    """float32 [n, 6] with quality 1. DataError names the line that is wrong."""
    rows = []
    for number, line in enumerate(_lines(path), start=1):
        if not line.strip():
            continue
        try:
            x, y, degrees, opening, jaw = (float(value) for value in line.split(";"))
        except ValueError:
            raise DataError(
                f"{path}:{number}: must be 'x;y;theta;opening;jaw', is '{line.strip()[:60]}'"
            ) from None
        if not np.isfinite([x, y, degrees, opening, jaw]).all() or opening <= 0 or jaw <= 0:
            raise DataError(f"{path}:{number}: not a rectangle: '{line.strip()[:60]}'")
        row = np.empty(COLUMNS, np.float32)
        row[[X, Y, THETA, OPENING, JAW, QUALITY]] = x, y, -np.radians(degrees), opening, jaw, 1
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: holds no grasp")
    grasps = np.stack(rows)
    grasps[:, THETA] = wrap_theta(grasps[:, THETA])
    return grasps


def format_grasps(rectangles: np.ndarray) -> str:
    """The text of a grasps.txt."""
    return "".join(
        f"{r[X]:.3f};{r[Y]:.3f};{-np.degrees(r[THETA]):.3f};{r[OPENING]:.3f};{r[JAW]:.3f}\r\n"
        for r in rectangles
    )


def _read_quality(path: Path, count: int) -> np.ndarray:
    lines = [line for line in _lines(path) if line.strip()]
    try:
        values = np.array([float(line) for line in lines], np.float32)
    except ValueError:
        raise DataError(f"{path}: must hold one number a line") from None
    if len(values) != count:
        raise DataError(f"{path}: holds {len(values)} numbers for {count} grasps")
    if not ((values > 0) & (values <= 1)).all():
        raise DataError(f"{path}: qualities must be in (0, 1]")
    return values


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise DataError(f"{path}: cannot be read ({reason})") from None


def _beside(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)
