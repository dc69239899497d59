"""The trained object detector on colour images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from iwgnet_grasp.data.letterbox import Region, letterbox
from iwgnet_grasp.networks.backends import BackendError, make_runner
from iwgnet_grasp.networks.detector_model import detector_model, load_detector
from iwgnet_grasp.networks.weights import WeightsError
from iwgnet_grasp.networks.yolov5s import decode, non_maximum_suppression
from iwgnet_grasp.perception.pipeline import checked_color
from iwgnet_grasp.perception.types import Box, Detection, PerceptionError


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
        region: Region | None = None,
    ) -> None:
        """backend: auto or a key of networks.backends.BACKENDS. region: the part of the image to
        look at, by default the one the weights were trained for. Raises PerceptionError for weights
        or a backend that cannot be used."""
        try:
            model, card = load_detector(weights)
            self.labels, self.input_size = card["labels"], card["input"]
            self.region = region or card["region"]
            self.backend, self._run = make_runner(detector_model(model, self.input_size), backend)
        except (WeightsError, BackendError) as error:
            raise PerceptionError(str(error)) from error
        self.anchors = model.anchors
        self.score_threshold = score_threshold
        self.iou_threshold = iou_threshold
        self.max_objects = max_objects
        self._run(np.zeros((1, 3, *self.input_size), np.uint8))  # warm up

    def detect(self, color: np.ndarray) -> list[Detection]:
        """Objects in an (H, W, 3) uint8 RGB image of any size, by descending score.

        Boxes are whole pixels of `color`, clipped to it. Raises PerceptionError for anything that
        is not such an image.
        """
        color = checked_color(color)
        fitted, fit = letterbox(color, self.input_size, self.region)
        logits = self._run(np.ascontiguousarray(fitted.transpose(2, 0, 1))[None])
        with torch.inference_mode():
            maps = [torch.from_numpy(m) for m in logits]
            ((boxes, scores),) = decode(maps, self.anchors, self.score_threshold)
            corners, score, label = non_maximum_suppression(
                boxes, scores, self.score_threshold, self.iou_threshold, self.max_objects
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
