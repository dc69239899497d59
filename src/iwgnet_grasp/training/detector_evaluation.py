"""The trained detector on the whole images of a held-out set, by COCO's mean average precision."""

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.perception.detector import Detector
from iwgnet_grasp.training.detector_metrics import ImageBoxes, average_precision

# As COCO does it: detections down to nearly no score make up the precision-recall curve.
SCORE_THRESHOLD = 0.01
MAX_OBJECTS = 100


def evaluate_detector(
    weights: Path,
    folder: Path,
    backend: str = "auto",
    progress: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Metrics of average_precision(), of all scenes and by arrangement, and the latency.

    Boxes count whatever their class: a set may hold families that the detector has no name for.
    Images are read and fitted as on the robot. "left_out" holds the paths of images that cannot be
    read. Raises PerceptionError for weights, DataError for a set without annotations.
    """
    scenes = _scenes(folder / "detector" / "annotations.json")
    detector = Detector(
        weights, score_threshold=SCORE_THRESHOLD, max_objects=MAX_OBJECTS, backend=backend
    )
    truth, found, arrangements, seconds, left_out = [], [], [], [], []
    for file, arrangement, boxes in scenes:
        if progress:
            progress()
        path = folder / "detector" / "images" / file
        image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
        if image is None:
            left_out.append(path)
            continue
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        start = time.perf_counter()
        detections = detector.detect(image)
        seconds.append(time.perf_counter() - start)
        corners = [
            (d.box.x, d.box.y, d.box.x + d.box.width, d.box.y + d.box.height) for d in detections
        ]
        truth.append(ImageBoxes(boxes, np.zeros(len(boxes), int)))
        found.append(
            ImageBoxes(
                np.array(corners, float).reshape(-1, 4),
                np.zeros(len(corners), int),
                np.array([d.score for d in detections]),
            )
        )
        arrangements.append(arrangement)
    if not truth:
        raise DataError(f"{folder}/detector/images: no image can be read")
    metrics: dict[str, Any] = {
        "weights": weights.stem,
        "backend": detector.backend,
        "milliseconds": round(1e3 * statistics.median(seconds), 2),
        "scenes": len(truth),
        **average_precision(truth, found, 1),
        "arrangements": {},
        "left_out": left_out,
    }
    for kind in sorted(set(arrangements) - {""}):
        chosen = [i for i, name in enumerate(arrangements) if name == kind]
        metrics["arrangements"][kind] = {"scenes": len(chosen)} | average_precision(
            [truth[i] for i in chosen], [found[i] for i in chosen], 1
        )
    return metrics


def _scenes(path: Path) -> list[tuple[str, str, np.ndarray]]:
    """(file, arrangement, corner boxes (N, 4) px) of each image."""
    try:
        text = json.loads(path.read_text())
        boxes: dict[int, list] = {image["id"]: [] for image in text["images"]}
        for annotation in text["annotations"]:
            x, y, w, h = (float(v) for v in annotation["bbox"])
            boxes[annotation["image_id"]].append((x, y, x + w, y + h))
        return [
            (
                Path(image["file_name"]).name,
                str(image.get("arrangement", "")),
                np.array(boxes[image["id"]], float).reshape(-1, 4),
            )
            for image in text["images"]
        ]
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; the detector is not evaluated on it") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        line = " ".join(str(error).split())
        raise DataError(f"{path}: not COCO annotations ({line})") from None
