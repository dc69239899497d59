"""Data to evaluate on, with what its folder tells about each object."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_dataset import Views, find_samples, load_views
from iwgnet_grasp.data.sample import GraspSample

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HeldOutSet:
    """families and arrangements go with the views; "" where the set does not say."""

    name: str
    folder: Path
    views: Views
    families: tuple[str, ...]
    arrangements: tuple[str, ...]  # scattered or stacked
    generator: dict[str, Any] | None  # dataset.json of a set made by 'iwgnet dataset'


def load_held_out(folder: Path, limit: int = 0) -> HeldOutSet:
    """A set in any of the layouts, its first `limit` samples (0: all).

    Broken samples are named in one warning each and left out. DataError when none is left.
    """
    samples = find_samples(folder)
    views = load_views(samples[:limit] if limit else samples)
    generator = _read(folder / "dataset.json")
    families = generator.get("families", []) if generator else []
    known = {s.name: _facts(s, families) for s in samples}
    facts = [known[name] for name in views.names]
    return HeldOutSet(
        folder.name,
        folder,
        views,
        tuple(family for family, _ in facts),
        tuple(arrangement for _, arrangement in facts),
        generator,
    )


def _facts(sample: GraspSample, families: list[str]) -> tuple[str, str]:
    """(family, arrangement) by the scene's detector.json."""
    family = families[0] if len(families) == 1 else ""
    scene = _read(sample.stem.parent / "detector.json")
    if not scene:
        return family, ""
    try:
        if not family:
            part = int(sample.name.partition("_")[0])
            shown = [a for a in scene["annotations"] if a.get("part") == part]
            family = families[shown[0]["category_id"] - 1] if shown else ""
        return family, str(scene.get("arrangement", ""))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        log.warning("%s: not as 'iwgnet dataset' writes it; family unknown", sample.stem.parent)
        return family, ""


def _read(path: Path) -> dict[str, Any] | None:
    """JSON object of a file, None where there is no file."""
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise ValueError
    except (OSError, ValueError):
        raise DataError(f"{path}: not a JSON object") from None
    return content
