"""Networks for OpenVINO on the CPU. Converting one takes seconds of tracing, so it is done once for
each state of weights, code and library, and kept below ~/.cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import warnings
from pathlib import Path

import openvino
import torch


def compile_module(
    module: torch.nn.Module, example: torch.Tensor, shape: list[int]
) -> openvino.CompiledModel:
    """The module, in eval mode on the CPU, compiled for one input of `shape` (-1: any)."""
    cache = cache_dir()
    path = cache / f"{_digest(module, shape)}.xml"
    core = openvino.Core()
    if path.is_file() and path.with_suffix(".bin").is_file():
        model = core.read_model(path)
    else:
        with warnings.catch_warnings():
            # The size is fixed here, so that tracing may take what depends on it for a constant.
            warnings.simplefilter("ignore", torch.jit.TracerWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            model = openvino.convert_model(module, example_input=example, input=shape)
        _keep(model, path)
    # Latency: one look at a time; the plugin itself takes bfloat16 where the CPU has it.
    return core.compile_model(model, "CPU", {"PERFORMANCE_HINT": "LATENCY"})


def cache_dir() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "iwgnet_grasp" / "openvino"


def _digest(module: torch.nn.Module, shape: list[int]) -> str:
    """Of all that the converted model depends on."""
    digest = hashlib.sha256(f"{openvino.__version__} {torch.__version__} {shape}".encode())
    digest.update(repr(module).encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]


def _keep(model: openvino.Model, path: Path) -> None:
    """Saves a model in one step for who reads at the same time; a full disk costs only time."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=path.parent))
        try:
            openvino.save_model(model, folder / "model.xml", compress_to_fp16=False)
            os.replace(folder / "model.bin", path.with_suffix(".bin"))
            os.replace(folder / "model.xml", path)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except (OSError, RuntimeError):
        pass
