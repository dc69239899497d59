"""The trained object detector on colour images."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from iwgnet_grasp.data.letterbox import Letterbox, Region, letterbox
from iwgnet_grasp.networks.backends import BackendError, make_runner
from iwgnet_grasp.networks.detector_model import detector_model, load_detector
from iwgnet_grasp.networks.weights import WeightsError
from iwgnet_grasp.networks.yolov5s import STRIDES, decode, non_maximum_suppression
from iwgnet_grasp.perception.pipeline import checked_color
from iwgnet_grasp.perception.types import Box, Detection, PerceptionError

# Shares of the input's sides, ascending: the smallest window that holds what stands on the table is
# looked at. Half of a trial's looks need a quarter of the input, most others half of it.
WINDOWS = (0.5, 0.75, 1.0)
MARGIN = 32  # input px around what stands there, a quarter of a rod's length


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
            runners = {
                size: make_runner(detector_model(model, size), backend)
                for size in _window_sizes(self.input_size)
            }
        except (WeightsError, BackendError) as error:
            raise PerceptionError(str(error)) from error
        self.anchors = model.anchors
        self.score_threshold = score_threshold
        self.iou_threshold = iou_threshold
        self.max_objects = max_objects
        self.backend = runners[self.input_size][0]
        self._runners = {size: run for size, (_, run) in runners.items()}
        for size, run in self._runners.items():
            run(np.zeros((1, 3, *size), np.uint8))  # warm up

    def detect(self, color: np.ndarray, where: Box | None = None) -> list[Detection]:
        """Objects in an (H, W, 3) uint8 RGB image of any size, by descending score.

        where: a box of the image outside of which nothing stands; what lies outside of it may then
        not be looked at. Boxes are whole pixels of `color`, clipped to it. Raises PerceptionError
        for anything that is not such an image.
        """
        color = checked_color(color)
        fitted, fit = letterbox(color, self.input_size, self.region)
        if where is not None:
            fitted, fit = self._window(fitted, fit, where)
        run = self._runners[fitted.shape[:2]]
        logits = run(np.ascontiguousarray(fitted.transpose(2, 0, 1))[None])
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

    def _window(
        self, fitted: np.ndarray, fit: Letterbox, where: Box
    ) -> tuple[np.ndarray, Letterbox]:
        """The smallest window that holds a box of the image and MARGIN around it."""
        corners = [where.x, where.y, where.x + where.width, where.y + where.height]
        x1, y1, x2, y2 = fit.to_input(np.array([corners], float))[0]
        whole = np.array(self.input_size)
        first = np.clip([y1 - MARGIN, x1 - MARGIN], 0, whole)
        last = np.clip([y2 + MARGIN, x2 + MARGIN], 0, whole)
        size = next(size for size in self._runners if (last - first <= size).all())
        top, left = np.clip(np.rint((first + last - size) / 2).astype(int), 0, whole - size)
        window = fitted[top : top + size[0], left : left + size[1]]
        return window, replace(fit, left=fit.left - left, top=fit.top - top)


def _window_sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """WINDOWS of (rows, columns), in multiples of the coarsest stride."""
    step = STRIDES[-1]
    return [tuple(math.ceil(side * share / step) * step for side in size) for share in WINDOWS]
