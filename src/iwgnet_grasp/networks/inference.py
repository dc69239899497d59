"""Grasp estimation on a batch of depth windows, by any backend."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from iwgnet_grasp.data.depth import normalise_depth, valid_depth
from iwgnet_grasp.data.grasp_rectangle import Grasp
from iwgnet_grasp.networks.backends import make_runner
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.grasp_network import GraspMaps, GraspNetwork
from iwgnet_grasp.networks.onnx_model import InferenceModel
from iwgnet_grasp.networks.probes import probe_heights
from iwgnet_grasp.networks.weights import load_weights

# Heights [N, H, W] float32 -> q, cos, sin, width, float32 [N, 4, H, W].
Predictor = Callable[[np.ndarray], np.ndarray]


class GraspEstimator:
    """The grasp network on windows cut around detected objects."""

    def __init__(self, weights: str | Path, backend: str = "auto", max_grasps: int = 20) -> None:
        """weights: a name in models/ or a path; backend: auto or a key of backends.BACKENDS.
        WeightsError or BackendError (one line) for anything unusable."""
        network, self.card = load_weights(weights)
        self.input_px = int(self.card["input_px"])
        self.max_grasps = max_grasps
        self.backend, self._predict = make_predictor(network, self.input_px, backend)

    def predict(self, depth: np.ndarray, table: np.ndarray | None = None) -> list[list[Grasp]]:
        """Grasps of each window, best first, in the window's pixels.

        depth: float [N, input_px, input_px], m, invalid where not finite or <= 0; table: likewise,
        the depth of the table's plane (data.depth.normalise_depth). A window without valid depth
        has no grasps.
        """
        depth = np.asarray(depth, np.float32)
        size = self.input_px
        if depth.ndim != 3 or depth.shape[1:] != (size, size):
            raise ValueError(f"depth windows must be [N, {size}, {size}], got {list(depth.shape)}")
        if table is not None and np.shape(table) != depth.shape:
            raise ValueError(f"table windows {list(np.shape(table))} differ from the depth's")
        if len(depth) == 0:
            return []
        heights = np.zeros_like(depth)
        usable = np.ones(len(depth), bool)
        for i, image in enumerate(depth):
            try:
                heights[i] = normalise_depth(image, None if table is None else table[i])
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
    """The backend taken and the network on it, for windows of input_px. Raises BackendError."""
    name, run = make_runner(grasp_model(network, input_px), backend)

    def predict(heights: np.ndarray) -> np.ndarray:
        return np.stack(run(heights[:, None]), axis=1)

    return name, predict


def grasp_model(network: GraspNetwork, input_px: int) -> InferenceModel:
    """A grasp network for square inputs: `height` -> `q`, `cos`, `sin`, `width`."""
    probe = probe_heights(input_px)[None, None]
    return InferenceModel(network.cpu().eval(), probe, "height", GraspMaps._fields)
