"""The card of a weight file: what it is, and all that is needed to train it again."""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import yaml

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.depth import HEIGHT_CLIP, HEIGHT_UNIT
from iwgnet_grasp.data.grasp_dataset import VIEW_PX
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX
from iwgnet_grasp.networks.weights import quality_power

log = logging.getLogger(__name__)

GENERATOR_SETTINGS = Path(__file__).resolve().parents[3] / "config" / "dataset.yaml"


def describe_set(folder: Path) -> dict[str, Any]:
    """Name of a data folder and, where the project made it, what makes it again: `iwgnet dataset`
    with these seed, scenes and families, and with config/dataset.yaml as it is but for the
    `settings` named here (by KEY.KEY). settings_sha256 tells whether that file has changed since.
    """
    described: dict[str, Any] = {"folder": folder.name}
    path = folder / "dataset.json"
    if not path.is_file():
        return described
    try:
        made = dict(json.loads(path.read_text()))
    except (TypeError, ValueError):
        log.warning("%s: not JSON, left out of the card", path)
        return described
    return described | short_generator(made)


def short_generator(made: dict[str, Any]) -> dict[str, Any]:
    """The content of dataset.json without what config/dataset.yaml says already."""
    short = {k: made[k] for k in ("seed", "scenes", "piles", "families", "library") if k in made}
    if "settings" in made:
        settings = _flat(made["settings"])
        known = _flat(yaml.safe_load(GENERATOR_SETTINGS.read_text()))
        text = json.dumps(made["settings"], sort_keys=True)
        short["settings"] = {k: v for k, v in settings.items() if known.get(k) != v}
        short["settings_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    check = made.get("lift_check")
    if check:
        short["lift_check"] = {k: check[k] for k in ("labels", "lifted")}
    return short


def make_card(
    settings: Any,
    parameters: int,
    data: Sequence[Path],
    training_count: int,
    validation_data: Path | None,
    validation_count: int,
) -> dict[str, Any]:
    """Card of a network that is about to be trained with GraspTrainingSettings."""
    return {
        "network": settings.network,
        "parameters": parameters,
        "input_px": settings.input_px,
        "input": {
            "quantity": "height above the table plane, holes filled",
            "unit_m": HEIGHT_UNIT,
            "clip": list(HEIGHT_CLIP),
            "view_px": VIEW_PX,
        },
        "width_reference_px": WIDTH_REFERENCE_PX,
        "data": {
            "training": [describe_set(folder) for folder in data],
            "samples": training_count,
            "validation": describe_set(validation_data) if validation_data else "a share of them",
            "validation_samples": validation_count,
        },
        "training": asdict(settings),
        "augmentation": asdict(Augmentation()),
        "torch": torch.__version__,
    }


def earlier_stage(first: dict[str, Any], card: dict[str, Any]) -> dict[str, Any]:
    """What the card of the weights that a training starts from adds to its own card: result,
    and of data and training what differs."""
    stage = {k: first[k] for k in ("epoch", "steps", "validation") if k in first}
    for key in ("data", "training", "augmentation"):
        ours, theirs = card[key], first.get(key, {})
        differing = {k: v for k, v in theirs.items() if ours.get(k) != v}
        if differing:
            stage[key] = differing
    if quality_power(first) != quality_power(card):
        stage.setdefault("training", {})["quality_power"] = quality_power(first)
    if first.get("before"):
        stage["before"] = first["before"]
    return stage


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
