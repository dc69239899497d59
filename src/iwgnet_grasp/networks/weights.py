"""Weights on disk: NAME.safetensors and its card NAME.json. No pickle is ever read."""

import json
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import nn

from iwgnet_grasp.files import write_whole
from iwgnet_grasp.networks import create_network
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX, GraspNetwork

MODELS = Path(__file__).resolve().parents[3] / "models"


class WeightsError(ValueError):
    """A weight file or card that cannot be used; the message says which and why."""


def weights_path(name_or_path: str | Path) -> Path:
    """models/NAME.safetensors of a bare name, otherwise the path itself."""
    path = Path(name_or_path)
    if path.suffix == ".safetensors" or len(path.parts) > 1:
        return path
    return MODELS / f"{path.name}.safetensors"


def save_weights(network: nn.Module, path: str | Path, card: dict[str, Any]) -> Path:
    """Writes PATH.safetensors and PATH.json, each whole or not at all."""
    path = weights_path(path).with_suffix(".safetensors")
    state = {name: tensor.contiguous().cpu() for name, tensor in network.state_dict().items()}
    # The name travels in the file, too: a card can be mixed up with another's weights.
    write_whole(path, save(state, metadata={"network": str(card["network"])}))
    write_whole(path.with_suffix(".json"), (json.dumps(card, indent=2) + "\n").encode())
    return path


def read_card(name_or_path: str | Path) -> dict[str, Any]:
    """The JSON card beside a weight file. WeightsError when missing or malformed."""
    path = weights_path(name_or_path).with_suffix(".json")
    try:
        card = json.loads(path.read_text())
        if not isinstance(card, dict) or "network" not in card:
            raise ValueError("no entry 'network'")
    except FileNotFoundError:
        raise WeightsError(f"{path}: the card of these weights is missing; train again") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise WeightsError(f"{path}: not a weight card ({_line(error)})") from None
    return card


def load_state(network: nn.Module, path: Path, name: str) -> None:
    """Fills `network`, called `name`, from a safetensors file. WeightsError says what is wrong."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such weight file; train it with 'iwgnet train'")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            stored = (file.metadata() or {}).get("network", name)
        state = load_file(path)
    except (safetensors.SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a whole safetensors file ({_line(error)})") from None
    if stored != name:
        raise WeightsError(f"{path}: holds weights of '{stored}', not of '{name}'")
    expected = network.state_dict()
    differing = [
        key
        for key in sorted(expected.keys() | state.keys())
        if key not in state or key not in expected or state[key].shape != expected[key].shape
    ]
    if differing:
        raise WeightsError(
            f"{path}: is not a '{name}' of this version: {len(differing)} tensors are missing, "
            f"unknown or of another shape, the first is '{differing[0]}'"
        )
    if any(not torch.isfinite(t).all() for t in state.values() if t.is_floating_point()):
        raise WeightsError(f"{path}: contains NaN or infinite weights; train again")
    network.load_state_dict(state)


def load_weights(name_or_path: str | Path) -> tuple[GraspNetwork, dict[str, Any]]:
    """A grasp network in eval mode and its card."""
    path = weights_path(name_or_path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weight file; train it with 'iwgnet train'")
    card = read_card(path)
    try:
        network = create_network(str(card["network"]))
    except ValueError as error:
        raise WeightsError(f"{path.with_suffix('.json')}: {error}") from None
    if not isinstance(card.get("input_px"), int) or card["input_px"] <= 0:
        raise WeightsError(f"{path.with_suffix('.json')}: entry 'input_px' is missing or no size")
    reference = card.get("width_reference_px", WIDTH_REFERENCE_PX)
    if reference != WIDTH_REFERENCE_PX:
        raise WeightsError(
            f"{path.with_suffix('.json')}: widths are in units of {reference} px, this version "
            f"reads {WIDTH_REFERENCE_PX:g} px; train again"
        )
    load_state(network, path, str(card["network"]))
    network.quality_power = quality_power(card)
    return network.eval(), card


def quality_power(card: dict[str, Any]) -> float:
    """The setting of a grasp network's training; 1 in cards from before there was one."""
    return float(card.get("training", {}).get("quality_power", 1.0))


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
