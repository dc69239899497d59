"""Networks as ONNX files, the form that the other libraries read. Converting one takes a second of
tracing, so it is done once for each state of weights, code and library, and kept in ~/.cache."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

OPSET = 17  # the newest that torch's TorchScript exporter writes without a conversion


class OneOutput(torch.nn.Module):
    """A network that gives one tensor, with the tuple of outputs that InferenceModel wants."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor]:
        return (self.network(x),)


@dataclass(frozen=True)
class InferenceModel:
    """A network with one input and what every library has to know of it."""

    module: torch.nn.Module  # in eval mode, on the CPU; gives a tuple or list of float tensors
    probe: np.ndarray  # [1, ...]: a typical input, whose shape and type are those of every input
    input_name: str
    output_names: tuple[str, ...]

    def exact(self, images: np.ndarray) -> list[np.ndarray]:
        """The outputs by torch in float32 on one core: what every backend is compared with."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # several wait for each other, for seconds on a busy machine
        try:
            with torch.inference_mode():
                return [output.numpy() for output in self.module(torch.from_numpy(images))]
        finally:
            torch.set_num_threads(threads)

    @cached_property
    def digest(self) -> str:
        """Of all that the converted network depends on."""
        shape, kind = self.probe.shape, self.probe.dtype
        digest = hashlib.sha256(f"{torch.__version__} {OPSET} {shape} {kind}".encode())
        digest.update(f"{self.input_name} {self.output_names} {self.module!r}".encode())
        for source in sorted(Path(__file__).parent.glob("*.py")):
            digest.update(source.read_bytes())
        for name, tensor in sorted(self.module.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()[:32]

    def onnx(self) -> bytes:
        """The ONNX file for one image of the probe's shape, weights included."""
        return cached(f"{self.digest}.onnx", self._convert)

    def _convert(self) -> bytes:
        file = io.BytesIO()
        with warnings.catch_warnings():
            # The size is fixed here, so that tracing may take what depends on it for a constant.
            warnings.simplefilter("ignore", torch.jit.TracerWarning)
            # The exporter that needs no package beside torch.
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.onnx.export(
                self.module,
                (torch.from_numpy(self.probe),),
                file,
                input_names=[self.input_name],
                output_names=list(self.output_names),
                opset_version=OPSET,
                dynamo=False,
            )
        return file.getvalue()


def cached(name: str, make: Callable[[], bytes]) -> bytes:
    """A file of the cache, made where it is missing; a cache that cannot be written costs time."""
    path = cache_dir() / name
    try:
        return path.read_bytes()
    except OSError:
        content = make()
    # Processes that start together make the same file: each renames its own.
    temporary = path.with_name(f".{name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return content


def cache_dir() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "iwgnet_grasp" / "networks"
