"""The object detector as it is run: weights and card from disk, an image's bytes in, logits out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from iwgnet_grasp.data.letterbox import WHOLE, checked_region
from iwgnet_grasp.networks.onnx_model import InferenceModel
from iwgnet_grasp.networks.probes import probe_image
from iwgnet_grasp.networks.weights import WeightsError, load_state, read_card, weights_path
from iwgnet_grasp.networks.yolov5s import STRIDES, YOLOv5s


def load_detector(name_or_path: str | Path) -> tuple[YOLOv5s, dict[str, Any]]:
    """The detector in eval mode and its card, whose labels, input (rows, columns) and region
    (of the image, as parts of its size) are usable. Raises WeightsError."""
    path = weights_path(name_or_path)
    if not path.is_file():
        raise WeightsError(
            f"{path}: no such weight file; train the detector with 'iwgnet train detector'"
        )
    card = read_card(path)
    try:
        card["labels"] = tuple(str(label) for label in card["labels"])
        card["input"] = rows, columns = tuple(int(v) for v in card["input"])
        card["region"] = checked_region(card.get("region", WHOLE))
        if not card["labels"] or min(rows, columns) <= 0 or rows % 32 or columns % 32:
            raise ValueError("labels or input size are not a detector's")
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(
            f"{path.with_suffix('.json')}: not the card of a detector ({error})"
        ) from None
    model = YOLOv5s(len(card["labels"]))
    load_state(model, path, str(card["network"]))
    return model.eval(), card


class FromBytes(torch.nn.Module):
    """The network behind its input scaling, so that it takes the image's bytes."""

    def __init__(self, model: YOLOv5s) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixels: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.model(pixels.float() / 255))


def detector_model(model: YOLOv5s, size: tuple[int, int]) -> InferenceModel:
    """The detector for images [N, 3, rows, columns] uint8 RGB: `image` -> the logits of
    YOLOv5s.forward at `stride_8`, `stride_16` and `stride_32`."""
    outputs = tuple(f"stride_{stride}" for stride in STRIDES)
    probe = np.ascontiguousarray(probe_image(size).transpose(2, 0, 1))[None]
    return InferenceModel(FromBytes(model.cpu().fused()).eval(), probe, "image", outputs)
