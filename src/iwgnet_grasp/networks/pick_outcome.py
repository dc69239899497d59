"""What will become of a grasp when it is carried out, from what surrounds it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from iwgnet_grasp.networks.backends import make_runner
from iwgnet_grasp.networks.grasp_network import conv_block
from iwgnet_grasp.networks.onnx_model import InferenceModel, OneOutput
from iwgnet_grasp.networks.probes import probe_heights
from iwgnet_grasp.networks.weights import WeightsError, load_state, read_card, weights_path
from iwgnet_grasp.perception.grasp_view import CHANNELS, VIEW_CELLS

NAME = "pick-outcome"
OUTPUTS = ("good", "still")  # the part is taken, alone and without a fault; no other part moves


class PickOutcome(nn.Module):
    """Views of grasps [N, CHANNELS, S, S] (perception.grasp_view) -> logits of OUTPUTS [N, 2].

    As the grasp quality network of Dex-Net 2.0 (Mahler et al. 2017) it sees one grasp at a time, in
    its middle and aligned with it; unlike there, the whole surroundings, because most faults are
    of neighbours that come along.
    """

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            conv_block(CHANNELS, 16, kernel=5, stride=2),
            conv_block(16, 32, stride=2),
            conv_block(32, 32),
            conv_block(32, 64, stride=2),
            conv_block(64, 64),
            conv_block(64, 64, stride=2),
        )
        cells = VIEW_CELLS // 16
        self.head = nn.Sequential(
            nn.Flatten(),
            nn.Dropout(0.3),
            nn.Linear(64 * cells * cells, 64),
            nn.ReLU(inplace=True),
            nn.Dropout(0.3),
            nn.Linear(64, len(OUTPUTS)),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.features(x))


def load_pick_outcome(name_or_path: str | Path) -> tuple[PickOutcome, dict[str, Any]]:
    """The network in eval mode and its card. Raises WeightsError."""
    path = weights_path(name_or_path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weight file; train it with 'iwgnet train outcome'")
    card = read_card(path)
    network = PickOutcome()
    load_state(network, path, NAME)
    return network.eval(), card


class OutcomeEstimator:
    """The network on any of networks.backends. One caller at a time."""

    def __init__(self, weights: str | Path, backend: str = "auto") -> None:
        """Raises WeightsError or BackendError."""
        network, self.card = load_pick_outcome(weights)
        probe = np.zeros((1, CHANNELS, VIEW_CELLS, VIEW_CELLS), np.float32)
        probe[0, 0] = probe_heights(VIEW_CELLS)
        model = InferenceModel(OneOutput(network).eval(), probe, "view", ("logits",))
        self.backend, self._run = make_runner(model, backend)

    def predict(self, views: np.ndarray) -> np.ndarray:
        """Probabilities of OUTPUTS [N, 2] of views [N, CHANNELS, S, S] float32."""
        if len(views) == 0:
            return np.empty((0, len(OUTPUTS)), np.float32)
        (logits,) = self._run(views)
        return 1 / (1 + np.exp(-logits))


def outcome_loss(logits: Tensor, outcomes: Tensor) -> Tensor:
    """Cross entropy, mean over views and OUTPUTS [N, 2]."""
    return nn.functional.binary_cross_entropy_with_logits(logits, outcomes)


def area_under_curve(scores: Tensor, truth: Tensor) -> Tensor:
    """Probability that a true case has a higher score than a false one (ROC AUC); NaN without
    either. [N], [N] bool."""
    order = torch.argsort(torch.argsort(scores)).double() + 1  # Mann and Whitney 1947
    positives, negatives = truth.sum().double(), (~truth).sum().double()
    return (order[truth].sum() - positives * (positives + 1) / 2) / (positives * negatives)
