"""The Cornell grasping data set with its depth as images.

    pcdNNNNr.png, pcdNNNNd.tiff (480x640 float32, m), pcdNNNNcpos.txt, pcdNNNNcneg.txt

cpos.txt: four lines "x y" a rectangle, the first two corners span the opening; corners may be NaN,
and such rectangles are skipped. z.txt, where it is there ("image object ..." a line), tells which
object an image shows; without it neighbouring image numbers are taken to show the same object.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import from_corners
from iwgnet_grasp.data.images import read_depth

_POSITIVE = "cpos.txt"
_IMAGES_OF_AN_OBJECT = 4  # about 885 images of 240 objects, one object after another


@dataclass(frozen=True)
class CornellSample:
    stem: Path  # FOLDER/pcdNNNN
    group: str

    @property
    def name(self) -> str:
        return self.stem.name

    def depth(self) -> np.ndarray:
        return read_depth(self.stem.with_name(self.stem.name + "d.tiff"))

    def rectangles(self) -> np.ndarray:
        return read_corners(self.stem.with_name(self.stem.name + _POSITIVE))


def find_cornell(root: Path) -> list[CornellSample]:
    """All samples below a folder that have a cpos.txt, in the order of their names."""
    objects = {}
    for table in sorted(root.rglob("z.txt")):
        for line in table.read_text(errors="replace").splitlines():
            words = line.split()
            if len(words) >= 2 and words[0].isdigit():
                objects[int(words[0])] = words[1]
    files = sorted(root.rglob(f"pcd*{_POSITIVE}"), key=lambda f: f.name)
    samples = []
    for i, file in enumerate(files):
        name = file.name.removesuffix(_POSITIVE)
        digits = name.removeprefix("pcd")
        number = int(digits) if digits.isdigit() else -1
        group = objects.get(number, f"images-{i // _IMAGES_OF_AN_OBJECT}")
        samples.append(CornellSample(file.with_name(name), group))
    return samples


def read_corners(path: Path) -> np.ndarray:
    """float32 [n, 6] with quality 1. DataError names the line that is wrong."""
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise DataError(f"{path}: cannot be read ({reason})") from None
    points = []
    for number, words in enumerate(lines, start=1):
        if not words:
            continue
        try:
            x, y = (float(word) for word in words)
        except ValueError:
            raise DataError(f"{path}:{number}: must be 'x y', is '{' '.join(words)}'") from None
        points.append((x, y))
    if len(points) % 4:
        raise DataError(f"{path}: holds {len(points)} corners, not a multiple of four")
    rectangles = np.array(points, np.float64).reshape(-1, 4, 2)
    rectangles = rectangles[np.isfinite(rectangles).all(axis=(1, 2))]
    if not len(rectangles):
        raise DataError(f"{path}: holds no grasp")
    return np.stack([from_corners(r) for r in rectangles])
