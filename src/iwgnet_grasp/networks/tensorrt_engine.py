"""TensorRT engines by TensorRT 10's Python API, on memory that torch holds on the GPU."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import tensorrt as trt
import torch

from iwgnet_grasp.networks.backends import BackendError

LOGGER = trt.Logger(trt.Logger.ERROR)
WORKSPACE_BYTES = 1 << 30  # that the builder may try kernels with
PRECISION_FLAGS = {
    "fp32": (),
    "bf16": (trt.BuilderFlag.BF16,),
    "fp16": (trt.BuilderFlag.FP16,),
    "int8": (trt.BuilderFlag.INT8, trt.BuilderFlag.FP16),  # what int8 does not suit stays in fp16
}


class Calibrator(trt.IInt8EntropyCalibrator2):
    """Gives the builder samples [1, ...], from which it takes the range of each layer."""

    def __init__(self, samples: Sequence[np.ndarray]) -> None:
        super().__init__()
        self._samples = iter(samples)
        self._on_gpu: torch.Tensor | None = None

    def get_batch_size(self) -> int:
        return 1

    def get_batch(self, names: list[str]) -> list[int] | None:
        sample = next(self._samples, None)
        if sample is None:
            return None
        self._on_gpu = torch.from_numpy(sample).cuda()
        return [self._on_gpu.data_ptr()]

    def read_calibration_cache(self) -> None:
        return None

    def write_calibration_cache(self, cache: object) -> None:
        pass


def build_engine(onnx: bytes, precision: str, samples: Sequence[np.ndarray] = ()) -> bytes:
    """A serialized engine for this GPU; its inputs and outputs keep the ONNX file's types.

    precision: the least that the kernels may compute in, a key of PRECISION_FLAGS; int8 is
    calibrated with `samples`, inputs [1, ...]. Raises BackendError.
    """
    builder = trt.Builder(LOGGER)
    network = builder.create_network(0)
    parser = trt.OnnxParser(network, LOGGER)
    if not parser.parse(onnx):
        reasons = "; ".join(parser.get_error(i).desc() for i in range(parser.num_errors))
        raise BackendError(f"backend tensorrt: cannot read the network ({reasons})")
    config = builder.create_builder_config()
    config.set_memory_pool_limit(trt.MemoryPoolType.WORKSPACE, WORKSPACE_BYTES)
    for flag in PRECISION_FLAGS[precision]:
        config.set_flag(flag)
    if precision == "int8":
        config.int8_calibrator = Calibrator(samples)
    engine = builder.build_serialized_network(network, config)
    if engine is None:
        raise BackendError(f"backend tensorrt: no {precision} engine can be built on this GPU")
    return bytes(engine)


class TensorRTRunner:
    """An engine on one image [1, ...] at a time."""

    def __init__(self, engine: bytes, output_names: Sequence[str]) -> None:
        runtime = trt.Runtime(LOGGER)
        self._engine = runtime.deserialize_cuda_engine(engine)
        if self._engine is None:
            raise BackendError("backend tensorrt: the engine was built for another GPU or version")
        self._context = self._engine.create_execution_context()
        tensors = [self._engine.get_tensor_name(i) for i in range(self._engine.num_io_tensors)]
        (self._input,) = (
            name for name in tensors if self._engine.get_tensor_mode(name) == trt.TensorIOMode.INPUT
        )
        self._outputs = [
            torch.empty(tuple(self._engine.get_tensor_shape(name)), device="cuda")
            for name in output_names
        ]
        for name, output in zip(output_names, self._outputs, strict=True):
            self._context.set_tensor_address(name, output.data_ptr())

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        on_gpu = torch.from_numpy(image).cuda()
        self._context.set_tensor_address(self._input, on_gpu.data_ptr())
        self._context.execute_async_v3(torch.cuda.current_stream().cuda_stream)
        return [output.cpu().numpy() for output in self._outputs]
