"""Weights as files for other programs: ONNX, OpenVINO and TensorRT, each checked against torch."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iwgnet_grasp.data.detection import load_detection_set
from iwgnet_grasp.data.grasp_dataset import VIEW_PX, GraspDataset, find_samples, load_views
from iwgnet_grasp.networks.backends import (
    AGREEMENT,
    BackendError,
    Runner,
    difference,
    image_by_image,
    missing,
    onnxruntime_runner,
    openvino_runner,
)
from iwgnet_grasp.networks.detector_model import detector_model, load_detector
from iwgnet_grasp.networks.inference import grasp_model
from iwgnet_grasp.networks.onnx_model import InferenceModel
from iwgnet_grasp.networks.weights import load_weights, read_card, weights_path

# The library that writes or checks each format, and what it can be written in, the default first.
LIBRARIES = {"onnx": "onnxruntime", "openvino": "openvino", "tensorrt": "tensorrt"}
# An ONNX file holds float32: whoever reads
# it converts. OpenVINO stores the weights in float16 or float32 and computes in what the CPU has.
PRECISIONS = {
    "onnx": ("fp32",),
    "openvino": ("fp32", "fp16"),
    "tensorrt": ("fp16", "fp32", "bf16", "int8"),
}
# Largest |found - torch| anywhere in the outputs of a file in float32: thirty times what another
# order of summation makes of logits of size 10.
EXACT = 1e-3
CALIBRATION_SAMPLES = 200


class ExportError(ValueError):
    """An export that cannot be made, or that differs from torch; nothing was written."""


@dataclass(frozen=True)
class Exported:
    """A file that was written, and how its outputs differ from torch in float32."""

    file: str
    format: str
    precision: str
    inputs_compared: int
    largest_difference: float  # anywhere, in the outputs' own unit
    mean_difference: float  # backends.difference


def export(
    weights: str | Path,
    formats: Sequence[str],
    out: Path,
    size: int | None = None,
    precision: str | None = None,
    data: Path | None = None,
) -> tuple[list[Exported], list[str]]:
    """Writes OUT/NAME_ROWSxCOLUMNS.{onnx, xml and bin, engine} and .json, which tells the input,
    the outputs and the differences. Returns what was written and, for several formats, why others
    were left out.

    size: edge of a grasp network's input, by default its card's. precision: of the formats that
    have it, else their own default. data: a folder of 'iwgnet dataset' whose samples calibrate
    int8 and are compared as well. Raises ExportError, BackendError, WeightsError or DataError.
    """
    _check(formats, precision, data)
    absent = {name: missing(LIBRARIES[name]) for name in formats if missing(LIBRARIES[name])}
    left_out = [f"{name}: {reason}" for name, reason in absent.items()]
    if len(absent) == len(formats):
        raise BackendError("; ".join(left_out))
    model, card = _model(weights, size)
    samples = [model.probe, *(_samples(card, model, data) if data else ())]
    rows, columns = model.probe.shape[2:]
    stem = f"{weights_path(weights).stem}_{rows}x{columns}"
    out.mkdir(parents=True, exist_ok=True)
    written = []
    with tempfile.TemporaryDirectory(dir=out, prefix=f".{stem}.") as folder:
        for name in formats:
            if name not in absent:
                can = PRECISIONS[name]
                chosen = precision if precision in can else can[0]
                path, runner = _WRITERS[name](model, Path(folder) / stem, chosen, samples)
                written.append(_compared(model, samples, path.name, name, chosen, runner))
        about = {
            "input": {model.input_name: [model.probe.dtype.name, *model.probe.shape]},
            "outputs": list(model.output_names),
            "files": [asdict(entry) for entry in written],
            "card": card,
        }
        (Path(folder) / f"{stem}.json").write_text(json.dumps(about, indent=2) + "\n")
        for path in Path(folder).iterdir():
            path.replace(out / path.name)
    return written, left_out


def _check(formats: Sequence[str], precision: str | None, data: Path | None) -> None:
    for name in formats:
        if name not in PRECISIONS:
            raise ExportError(f"no format '{name}'; known: {', '.join(PRECISIONS)}")
    known = dict.fromkeys(p for name in formats for p in PRECISIONS[name])
    if precision and precision not in known:
        raise ExportError(f"no precision '{precision}' for this format; known: {', '.join(known)}")
    if precision == "int8" and data is None:
        raise ExportError("int8 is calibrated on samples; name their folder with --data")


def _model(weights: str | Path, size: int | None) -> tuple[InferenceModel, dict[str, Any]]:
    path = weights_path(weights)
    if path.is_file() and read_card(path)["network"] == "yolov5s":
        if size:
            raise ExportError("the size of a detector's input is its card's; leave --size out")
        detector, card = load_detector(path)
        return detector_model(detector, card["input"]), card
    network, card = load_weights(path)
    return grasp_model(network, size or card["input_px"]), card


def _samples(card: dict[str, Any], model: InferenceModel, data: Path) -> list[np.ndarray]:
    """Up to CALIBRATION_SAMPLES inputs [1, ...] of a data set."""
    if card["network"] == "yolov5s":
        scenes = load_detection_set(
            data, card["input"], limit=CALIBRATION_SAMPLES, region=card["region"]
        ).scenes
        return [np.ascontiguousarray(s.image.transpose(2, 0, 1))[None] for s in scenes]
    size = model.probe.shape[-1]
    if size > VIEW_PX:
        raise ExportError(f"samples have {VIEW_PX} px; leave --data out or take --size {VIEW_PX}")
    dataset = GraspDataset(load_views(find_samples(data)[:CALIBRATION_SAMPLES]), size)
    return [dataset.crop(i)[0][None, None] for i in range(len(dataset))]


def _write_onnx(model, path, precision, samples) -> tuple[Path, Runner]:
    path = path.with_name(f"{path.name}.onnx")
    path.write_bytes(model.onnx())
    return path, onnxruntime_runner(model)


def _write_openvino(model, path, precision, samples) -> tuple[Path, Runner]:
    import openvino

    path = path.with_name(f"{path.name}.xml")
    graph = openvino.Core().read_model(model.onnx(), b"")
    openvino.save_model(graph, path, compress_to_fp16=precision == "fp16")
    # Computed in float32, so that the difference is the file's.
    return path, openvino_runner(model, path, {"INFERENCE_PRECISION_HINT": "f32"})


def _write_tensorrt(model, path, precision, samples) -> tuple[Path, Runner]:
    from iwgnet_grasp.networks.tensorrt_engine import TensorRTRunner, build_engine

    path = path.with_name(f"{path.name}.engine")
    # Without --data the probe is all there is, and it calibrates nothing: int8 is refused then.
    engine = build_engine(model.onnx(), precision, samples[1:])
    path.write_bytes(engine)
    return path, image_by_image(TensorRTRunner(engine, model.output_names))


_WRITERS = {"onnx": _write_onnx, "openvino": _write_openvino, "tensorrt": _write_tensorrt}


def _compared(
    model: InferenceModel,
    samples: Sequence[np.ndarray],
    file: str,
    kind: str,
    precision: str,
    runner: Runner,
) -> Exported:
    """Of the first samples. ExportError when the outputs differ by more than EXACT anywhere in
    float32, by more than AGREEMENT on average in less."""
    samples = samples[:8]
    largest, mean = [], []
    for sample in samples:
        exact, found = model.exact(sample), runner(sample)
        largest += [np.abs(b - a).max() for a, b in zip(exact, found, strict=True)]
        mean.append(difference(exact, found))
    largest, mean = float(np.max(largest)), float(np.max(mean))
    value, limit = (largest, EXACT) if precision == "fp32" else (mean, AGREEMENT)
    if not value <= limit:  # NaN, too
        raise ExportError(
            f"{file}: differs from torch by {value:.2g}, more than {limit:g}; nothing was written"
        )
    return Exported(file, kind, precision, len(samples), largest, mean)
