"""The libraries that can run a network, and which of them is taken.

Compiled libraries run image by image: a window's grasps then do not depend, in their last bit, on
how many others a look has, and OpenVINO is half as fast again as with a batch of any size.
"""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from iwgnet_grasp.networks.onnx_model import InferenceModel, cached

log = logging.getLogger(__name__)

# Images [N, ...] of the probe's shape and type -> each output, float32 [N, ...]. One caller at a
# time.
Runner = Callable[[np.ndarray], list[np.ndarray]]

# Largest `difference` to torch in float32 that counts as agreement: bfloat16 keeps 8 bits.
AGREEMENT = 0.01


class BackendError(ValueError):
    """A backend that cannot be used; the message says which, why and what to do."""


def make_runner(model: InferenceModel, backend: str = "auto") -> tuple[str, Runner]:
    """The backend taken and its runner; `auto` is `fastest_that_agrees`. Raises BackendError."""
    if backend == "auto":
        return fastest_that_agrees(model)
    if backend not in BACKENDS:
        raise BackendError(f"no backend '{backend}'; known: auto, {', '.join(BACKENDS)}")
    reason = missing(backend)
    if reason:
        raise BackendError(f"backend {backend}: {reason}")
    return backend, BACKENDS[backend](model)


def fastest_that_agrees(model: InferenceModel) -> tuple[str, Runner]:
    """The first of FASTEST_FIRST that is usable here and agrees with torch in float32.

    The order is fixed. Timed at the start it would depend on what else the machine does, and the
    last bits of the maps are the backend's: the same trial must give the same result.
    Rows iwgnet_BACKEND of scripts/benchmark measure it.
    """
    exact = model.exact(model.probe)
    for name in FASTEST_FIRST["gpu" if torch.cuda.is_available() else "cpu"]:
        if missing(name):
            continue
        try:
            runner = BACKENDS[name](model)
            apart = difference(exact, runner(model.probe))
        except Exception as error:  # of whatever kind: each library has its own
            log.warning("backend %s is left out: %s", name, " ".join(str(error).split()))
            continue
        if apart <= AGREEMENT:
            return name, runner
        log.warning("backend %s is left out: it differs from torch by %.2g", name, apart)
    return "torch", torch_runner(model, bfloat16=False)


def difference(exact: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> float:
    """The largest mean |found - exact| of an output, as part of the output's own mean size where
    that is above 1 (logits), else absolute (quality, cos, sin and width maps)."""
    parts = [
        np.abs(b - a).mean() / max(1.0, np.abs(a).mean()) for a, b in zip(exact, found, strict=True)
    ]
    return float(np.max(parts))  # NaN where one is, which agrees with nothing


def missing(backend: str) -> str:
    """Why a backend cannot be used here; '' where it can."""
    if importlib.util.find_spec(backend) is None:
        where = " on a machine with an NVIDIA GPU" if backend == "tensorrt" else ""
        return f"the package is not installed (pip install {backend}{where})"
    if backend == "tensorrt" and not torch.cuda.is_available():
        return "torch sees no CUDA device"
    return ""


def torch_runner(model: InferenceModel, bfloat16: bool | None = None) -> Runner:
    """Torch on the GPU where there is one; in bfloat16 there and on CPUs that compute in it."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if bfloat16 is None:
        bfloat16 = device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
    module = copy.deepcopy(model.module).to(device, memory_format=torch.channels_last)

    def run(images: np.ndarray) -> list[np.ndarray]:
        x = torch.from_numpy(images).to(device, memory_format=torch.channels_last)
        with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
            outputs = module(x)
        return [output.float().cpu().numpy() for output in outputs]

    return run


def onnxruntime_runner(model: InferenceModel) -> Runner:
    """ONNX Runtime in float32, on the GPU where the package was built for it."""
    import onnxruntime

    available = onnxruntime.get_available_providers()
    providers = [p for p in ("CUDAExecutionProvider", "CPUExecutionProvider") if p in available]
    session = onnxruntime.InferenceSession(model.onnx(), providers=providers)
    return image_by_image(lambda image: session.run(None, {model.input_name: image}))


def openvino_runner(
    model: InferenceModel, path: Path | None = None, settings: dict[str, str] | None = None
) -> Runner:
    """OpenVINO on the CPU, which takes bfloat16 where the CPU computes in it.

    path: a file of OpenVINO's own to read in place of the model's ONNX; settings: of the plugin.
    """
    import openvino

    core = openvino.Core()
    graph = core.read_model(path) if path else core.read_model(model.onnx(), b"")
    # Latency: one look at a time.
    compiled = core.compile_model(graph, "CPU", {"PERFORMANCE_HINT": "LATENCY", **(settings or {})})
    request = compiled.create_infer_request()

    def one(image: np.ndarray) -> list[np.ndarray]:
        found = request.infer({0: image}, share_inputs=True, share_outputs=True)
        return [found[i] for i in range(len(model.output_names))]

    return image_by_image(one)


def tensorrt_runner(model: InferenceModel) -> Runner:
    """TensorRT in float16; the engine is built once, which takes minutes."""
    import tensorrt

    from iwgnet_grasp.networks.tensorrt_engine import TensorRTRunner, build_engine

    name = f"{model.digest} {tensorrt.__version__} {torch.cuda.get_device_name()}"
    key = hashlib.sha256(name.encode()).hexdigest()[:32]
    engine = cached(f"{key}.engine", lambda: build_engine(model.onnx(), "fp16"))
    return image_by_image(TensorRTRunner(engine, model.output_names))


def image_by_image(one: Callable[[np.ndarray], list[np.ndarray]]) -> Runner:
    """A runner of batches from one of single images [1, ...], which may reuse its outputs."""

    def run(images: np.ndarray) -> list[np.ndarray]:
        outputs: list[np.ndarray] = []
        for i in range(len(images)):
            found = one(np.ascontiguousarray(images[i : i + 1]))
            if i == 0:
                outputs = [np.empty((len(images), *f.shape[1:]), np.float32) for f in found]
            for output, image in zip(outputs, found, strict=True):
                output[i] = image[0]
        return outputs

    return run


BACKENDS: dict[str, Callable[[InferenceModel], Runner]] = {
    "torch": torch_runner,
    "onnxruntime": onnxruntime_runner,
    "openvino": openvino_runner,
    "tensorrt": tensorrt_runner,
}
FASTEST_FIRST = {
    "gpu": ("tensorrt", "torch"),
    "cpu": ("openvino", "onnxruntime", "torch"),
}
