"""The trained object detector on whole colour images."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from iwgnet_grasp.data.detection import letterbox
from iwgnet_grasp.networks.weights import WeightsError, load_state, read_card
from iwgnet_grasp.networks.yolov5s import YOLOv5s, decode, non_maximum_suppression
from iwgnet_grasp.perception.pipeline import checked_color
from iwgnet_grasp.perception.types import Box, Detection, PerceptionError

Forward = Callable[[torch.Tensor], list[torch.Tensor]]  # (B, 3, H, W) uint8 -> YOLOv5s.forward's


class Detector:
    """YOLOv5s with weights from models/. Not thread-safe: one caller at a time."""

    def __init__(
        self,
        weights: str | Path,
        *,
        score_threshold: float = 0.4,
        iou_threshold: float = 0.6,
        max_objects: int = 30,
        backend: str = "auto",
    ) -> None:
        """backend: 'openvino', 'torch' or 'auto', which is OpenVINO where it is installed and no
        CUDA device is. Raises PerceptionError for weights or a backend that cannot be used."""
        weights = Path(weights)
        if not weights.is_file():
            raise PerceptionError(
                f"{weights}: no such weight file; train the detector with 'iwgnet train detector'"
            )
        try:
            card = read_card(weights)
            self.labels = tuple(str(label) for label in card["labels"])
            rows, columns = (int(v) for v in card["input"])
            self.input_size = rows, columns
            if not self.labels or min(rows, columns) <= 0 or rows % 32 or columns % 32:
                raise ValueError("labels or input size are not a detector's")
            model = YOLOv5s(len(self.labels))
            load_state(model, weights, str(card["network"]))
        except WeightsError as error:
            raise PerceptionError(str(error)) from error
        except (KeyError, TypeError, ValueError) as error:
            raise PerceptionError(
                f"{weights.with_suffix('.json')}: not the card of a detector ({error})"
            ) from error
        self.anchors = model.anchors.clone()
        self.backend = resolve_backend(backend)
        self.score_threshold = score_threshold
        self.iou_threshold = iou_threshold
        self.max_objects = max_objects
        make = _openvino_forward if self.backend == "openvino" else _torch_forward
        self._forward = make(model.fused(), self.input_size)
        self._forward(torch.zeros(1, 3, *self.input_size, dtype=torch.uint8))  # warm up

    def detect(self, color: np.ndarray) -> list[Detection]:
        """Objects in an (H, W, 3) uint8 RGB image of any size, by descending score.

        Boxes are whole pixels of `color`, clipped to it. Raises PerceptionError for anything that
        is not such an image.
        """
        color = checked_color(color)
        fitted, fit = letterbox(color, self.input_size)
        pixels = torch.from_numpy(np.ascontiguousarray(fitted.transpose(2, 0, 1)))[None]
        with torch.inference_mode():
            boxes, scores = decode(self._forward(pixels), self.anchors)
            corners, score, label = non_maximum_suppression(
                boxes[0], scores[0], self.score_threshold, self.iou_threshold, self.max_objects
            )
        height, width = color.shape[:2]
        detections = []
        for (x1, y1, x2, y2), s, k in zip(
            fit.to_image(corners.numpy().astype(float)), score.tolist(), label.tolist(), strict=True
        ):
            left, top = max(round(x1), 0), max(round(y1), 0)
            right, bottom = min(round(x2), width), min(round(y2), height)
            if right > left and bottom > top:
                box = Box(left, top, right - left, bottom - top)
                detections.append(Detection(self.labels[k], s, box))
        return detections


def resolve_backend(backend: str) -> str:
    """'openvino' or 'torch' for a configured name. Raises PerceptionError."""
    installed = importlib.util.find_spec("openvino") is not None
    if backend == "auto":
        return "openvino" if installed and not torch.cuda.is_available() else "torch"
    if backend not in ("openvino", "torch"):
        raise PerceptionError(f"detector backend '{backend}' is none of auto, openvino, torch")
    if backend == "openvino" and not installed:
        raise PerceptionError("detector backend 'openvino' is not installed; use 'auto' or 'torch'")
    return backend


class _FromBytes(torch.nn.Module):
    """The network behind its input scaling, so that a backend takes the image's bytes."""

    def __init__(self, model: YOLOv5s) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.model(pixels.float() / 255))


def _torch_forward(model: YOLOv5s, _: tuple[int, int]) -> Forward:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = model.to(device, memory_format=torch.channels_last)

    def forward(pixels: torch.Tensor) -> list[torch.Tensor]:
        images = pixels.to(device).to(torch.float32, memory_format=torch.channels_last) / 255
        with torch.autocast(device, torch.bfloat16):
            return [m.cpu() for m in model(images)]

    return forward


def _openvino_forward(model: YOLOv5s, size: tuple[int, int]) -> Forward:
    from iwgnet_grasp.networks.openvino_model import compile_module

    example = torch.zeros(1, 3, *size, dtype=torch.uint8)
    compiled = compile_module(_FromBytes(model), example, [1, 3, *size])
    request = compiled.create_infer_request()

    def forward(pixels: torch.Tensor) -> list[torch.Tensor]:
        found = request.infer({0: pixels.numpy()}, share_inputs=True)
        return [torch.from_numpy(found[i]) for i in range(3)]

    return forward
