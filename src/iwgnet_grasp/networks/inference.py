"""Grasp estimation on a batch of depth windows, by the fastest backend that agrees with torch."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from iwgnet_grasp.data.depth import normalise_depth, valid_depth
from iwgnet_grasp.data.grasp_rectangle import Grasp
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.grasp_network import GraspNetwork
from iwgnet_grasp.networks.weights import load_weights

BACKENDS = ("auto", "openvino", "torch")
# Largest mean difference of the quality map to torch in float32 that still counts as agreement:
# bfloat16 keeps 8 bits.
AGREEMENT = 0.01

# Heights [N, H, W] float32 -> q, cos, sin, width, float32 [N, 4, H, W].
Predictor = Callable[[np.ndarray], np.ndarray]


class GraspEstimator:
    """The grasp network on windows cut around detected objects."""

    def __init__(self, weights: str | Path, backend: str = "auto", max_grasps: int = 20) -> None:
        """weights: a name in models/ or a path. WeightsError (one line) for anything unusable."""
        network, self.card = load_weights(weights)
        self.input_px = int(self.card["input_px"])
        self.max_grasps = max_grasps
        self.backend, self._predict = make_predictor(network, self.input_px, backend)

    def predict(self, depth: np.ndarray, empty: np.ndarray | None = None) -> list[list[Grasp]]:
        """Grasps of each window, best first, in the window's pixels.

        depth, empty: float [N, input_px, input_px], m, invalid where not finite or <= 0; empty is
        the same view without objects. A window without valid depth has no grasps.
        """
        depth = np.asarray(depth, np.float32)
        size = self.input_px
        if depth.ndim != 3 or depth.shape[1:] != (size, size):
            raise ValueError(f"depth windows must be [N, {size}, {size}], got {list(depth.shape)}")
        if empty is not None and np.shape(empty) != depth.shape:
            raise ValueError(f"empty-scene windows {list(np.shape(empty))} differ from the depth's")
        if len(depth) == 0:
            return []
        heights = np.zeros_like(depth)
        usable = np.ones(len(depth), bool)
        for i, image in enumerate(depth):
            try:
                heights[i] = normalise_depth(image, None if empty is None else empty[i])
                usable[i] = valid_depth(image).any()
            except ValueError:
                usable[i] = False
        maps = self._predict(heights)
        return [
            decode_grasps(*maps[i], max_grasps=self.max_grasps) if usable[i] else []
            for i in range(len(depth))
        ]


def make_predictor(
    network: GraspNetwork, input_px: int, backend: str = "auto"
) -> tuple[str, Predictor]:
    """(name, predictor) of a backend; "auto" times both on this machine.

    OpenVINO is taken only where it is installed and its quality map agrees with torch in float32.
    """
    if backend not in BACKENDS:
        raise ValueError(f"no backend '{backend}'; known: {', '.join(BACKENDS)}")
    network = network.eval()
    probe = np.random.default_rng(0).uniform(-0.1, 1, (1, input_px, input_px)).astype(np.float32)
    if backend != "torch":
        try:
            predictor = openvino_predictor(network, input_px)
        except ImportError:
            if backend == "openvino":
                raise ValueError("backend openvino: not installed (pip install openvino)") from None
        else:
            if backend == "openvino":
                return backend, predictor
            exact = torch_predictor(network, bfloat16=False)(probe)
            agrees = np.abs(predictor(probe)[:, 0] - exact[:, 0]).mean() < AGREEMENT
            rival = torch_predictor(network)
            if agrees and _seconds(predictor, probe) < _seconds(rival, probe):
                return "openvino", predictor
            return "torch", rival
    return "torch", torch_predictor(network)


def torch_predictor(network: GraspNetwork, bfloat16: bool | None = None) -> Predictor:
    """Torch on the GPU where there is one, else on the CPU in bfloat16 where it is fast."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if bfloat16 is None:
        bfloat16 = device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()
    network = network.to(device, memory_format=torch.channels_last)

    def predict(heights: np.ndarray) -> np.ndarray:
        x = torch.from_numpy(heights)[:, None].to(device, memory_format=torch.channels_last)
        with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
            maps = network(x)
        return torch.stack(list(maps), dim=1).float().cpu().numpy()

    return predict


def openvino_predictor(network: GraspNetwork, input_px: int) -> Predictor:
    """OpenVINO, compiled for any batch of input_px windows; bfloat16 where the CPU has it."""
    from iwgnet_grasp.networks.openvino_model import compile_module

    class Stacked(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return torch.stack(list(self.network(x)), dim=1)

    example = torch.zeros(1, 1, input_px, input_px)
    compiled = compile_module(Stacked().cpu().eval(), example, [-1, 1, input_px, input_px])

    def predict(heights: np.ndarray) -> np.ndarray:
        return np.asarray(compiled(heights[:, None])[0], np.float32)

    return predict


def _seconds(predictor: Predictor, probe: np.ndarray, repeats: int = 5) -> float:
    """Best of a few calls, after one to warm up."""
    predictor(probe)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        predictor(probe)
        times.append(time.perf_counter() - start)
    return min(times)
