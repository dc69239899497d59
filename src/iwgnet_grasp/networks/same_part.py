"""Which pixels show the same part as a patch of it: what lies across a part leaves patches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from iwgnet_grasp.data.depth import HEIGHT_CLIP, HEIGHT_UNIT, fill_holes
from iwgnet_grasp.networks.backends import make_runner
from iwgnet_grasp.networks.object_mask import ObjectMask, normalise_grey
from iwgnet_grasp.networks.onnx_model import InferenceModel, OneOutput
from iwgnet_grasp.networks.probes import probe_heights, probe_image
from iwgnet_grasp.networks.weights import WeightsError, load_state, read_card, weights_path

NAME = "same-part"
CHANNELS = 3  # height, brightness, patch
VIEW_CELLS = 160  # side of a view
CELL_PX = 2.0  # of the image: 320 px, so that the longest rod is in view from either of its ends


def patch_view(
    heights: np.ndarray, grey: np.ndarray, patch: np.ndarray, affine: np.ndarray
) -> np.ndarray:
    """[CHANNELS, VIEW_CELLS, VIEW_CELLS] float32: what the network sees of a patch.

    heights: (H, W) float32 in HEIGHT_UNIT (without_specks); grey: (H, W) uint8; patch: (H, W) bool;
    affine: (2, 3), image px -> cells (`around` or an augmented one).
    """

    def seen(image: np.ndarray, border: int) -> np.ndarray:
        size = VIEW_CELLS, VIEW_CELLS
        return cv2.warpAffine(image, affine, size, flags=cv2.INTER_LINEAR, borderMode=border)

    view = [
        seen(heights, cv2.BORDER_CONSTANT),
        normalise_grey(seen(grey, cv2.BORDER_REPLICATE)),
        seen(patch.astype(np.float32), cv2.BORDER_CONSTANT),
    ]
    return np.stack(view)


def without_specks(heights: np.ndarray) -> np.ndarray:
    """(H, W) float32: heights without the pixels that were not measured and show the table."""
    return cv2.morphologyEx(heights, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))


def around(patch: np.ndarray) -> np.ndarray:
    """(2, 3): image px -> cells of the view whose middle is the centroid of a patch (H, W) bool."""
    moments = cv2.moments(patch.view(np.uint8), binaryImage=True)
    column, row = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    scale, middle = 1 / CELL_PX, (VIEW_CELLS - 1) / 2
    return np.array([[scale, 0, middle - scale * column], [0, scale, middle - scale * row]])


def load_same_part(name_or_path: str | Path) -> tuple[ObjectMask, dict[str, Any]]:
    """The network in eval mode and its card. Raises WeightsError."""
    path = weights_path(name_or_path)
    if not path.is_file():
        raise WeightsError(
            f"{path}: no such weight file; train it with 'iwgnet train mask --network same-part'"
        )
    card = read_card(path)
    network = ObjectMask(CHANNELS)
    load_state(network, path, NAME)
    return network.eval(), card


class SamePartEstimator:
    """The network on any of networks.backends. One caller at a time."""

    def __init__(self, weights: str | Path, backend: str = "auto") -> None:
        """Raises WeightsError or BackendError."""
        network, self.card = load_same_part(weights)
        grey = probe_image((VIEW_CELLS, VIEW_CELLS))[..., 0]
        heights = probe_heights(VIEW_CELLS)
        probe = np.stack([heights, normalise_grey(grey), heights > 0.5]).astype(np.float32)[None]
        model = InferenceModel(OneOutput(network).eval(), probe, "view", ("logit",))
        self.backend, self._run = make_runner(model, backend)

    def predict(
        self, heights: np.ndarray, grey: np.ndarray, patches: list[np.ndarray]
    ) -> list[np.ndarray]:
        """For each patch (H, W) bool the probability (H, W) float32 that a pixel shows the same
        part. heights: (H, W) m over the empty scene, NaN where not measured; grey: (H, W) uint8."""
        found = []
        if patches:
            known = np.isfinite(heights)
            level = np.clip(np.where(known, heights, 0) / HEIGHT_UNIT, *HEIGHT_CLIP)
            level = without_specks(fill_holes(level.astype(np.float32), known))
        for patch in patches:
            affine = around(patch)
            (logits,) = self._run(patch_view(level, grey, patch, affine)[None])
            probability = 1 / (1 + np.exp(-logits[0]))
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            found.append(cv2.warpAffine(probability, affine, grey.shape[::-1], flags=flags))
        return found
