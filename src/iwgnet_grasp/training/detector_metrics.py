"""Average precision of detections by COCO's own evaluation (pycocotools)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval


@dataclass(frozen=True)
class ImageBoxes:
    """Boxes of one image: corners (N, 4) px, labels (N,), scores (N,) or None for the truth."""

    boxes: np.ndarray
    labels: np.ndarray
    scores: np.ndarray | None = None


def average_precision(
    truth: Sequence[ImageBoxes], found: Sequence[ImageBoxes], classes: int
) -> dict[str, float]:
    """map50 (IoU 0.5), map50_95 (mean over IoU 0.50:0.05:0.95) and recall, all in [0, 1].

    The two sequences go image by image. Without any true box all three are NaN.
    """
    annotations, results = [], []
    for image, (real, guess) in enumerate(zip(truth, found, strict=True)):
        for box, label in zip(real.boxes, real.labels, strict=True):
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": image,
                    "category_id": int(label),
                    "bbox": _xywh(box),
                    "area": float((box[2] - box[0]) * (box[3] - box[1])),
                    "iscrowd": 0,
                }
            )
        for box, label, score in zip(guess.boxes, guess.labels, guess.scores, strict=True):
            results.append(
                {
                    "image_id": image,
                    "category_id": int(label),
                    "bbox": _xywh(box),
                    "score": float(score),
                }
            )
    if not annotations:
        return dict.fromkeys(("map50", "map50_95", "recall"), float("nan"))
    if not results:
        return dict.fromkeys(("map50", "map50_95", "recall"), 0.0)
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        coco = COCO()
        coco.dataset = {
            "info": {},
            "images": [{"id": i} for i in range(len(truth))],
            "annotations": annotations,
            "categories": [{"id": i, "name": str(i)} for i in range(classes)],
        }
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return {
        "map50": float(evaluation.stats[1]),
        "map50_95": float(evaluation.stats[0]),
        "recall": float(evaluation.stats[8]),
    }


def _xywh(box: np.ndarray) -> list[float]:
    x1, y1, x2, y2 = (float(v) for v in box)
    return [x1, y1, x2 - x1, y2 - y1]
