"""Which pixels of a window are the object's whose box it was cut around."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from iwgnet_grasp.networks.backends import make_runner
from iwgnet_grasp.networks.grasp_network import conv_block
from iwgnet_grasp.networks.onnx_model import InferenceModel, OneOutput
from iwgnet_grasp.networks.probes import probe_heights, probe_image
from iwgnet_grasp.networks.weights import WeightsError, load_state, read_card, weights_path

NAME = "object-mask"
INPUT_PX = 208  # the longest rod is 170 px at 0.6 m, 200 px on top of a pile
_LEAST_CONTRAST = 8.0  # grey levels, deviation of an image that shows nothing but the table


def _upsample(channels_in: int, channels_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, 4 * channels_out, 1, bias=False),
        nn.PixelShuffle(2),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )


class ObjectMask(nn.Module):
    """Height and brightness [N, 2, H, W] -> logit of "the object's" [N, H, W]; networks.same_part
    gives it a third channel.

    Channel 0: data.depth.normalise_depth of the merged depth, in which neighbours outside the box
    are pits; channel 1: `normalise_grey`. H and W are multiples of 16. A U-Net (Ronneberger et al.
    2015) down to 1/16 of the size.
    """

    def __init__(self, channels: int = 2) -> None:
        super().__init__()
        self.stem = conv_block(channels, 16, kernel=5, stride=2)
        self.down_4 = nn.Sequential(conv_block(16, 32, stride=2), conv_block(32, 32))
        self.down_8 = nn.Sequential(conv_block(32, 64, stride=2), conv_block(64, 64))
        self.down_16 = nn.Sequential(
            conv_block(64, 96, stride=2), conv_block(96, 96, dilation=2), conv_block(96, 96)
        )
        self.up_8, self.smooth_8 = _upsample(96, 64), conv_block(64, 64)
        self.up_4, self.smooth_4 = _upsample(64, 32), conv_block(32, 32)
        self.up_2, self.smooth_2 = _upsample(32, 16), conv_block(16, 16)
        self.head = nn.Sequential(nn.Conv2d(16, 4, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, x: Tensor) -> Tensor:
        half = self.stem(x)
        quarter = self.down_4(half)
        eighth = self.down_8(quarter)
        deep = self.smooth_8(self.up_8(self.down_16(eighth)) + eighth)
        deep = self.smooth_4(self.up_4(deep) + quarter)
        deep = self.smooth_2(self.up_2(deep) + half)
        return self.head(deep)[:, 0]


def normalise_grey(grey: np.ndarray) -> np.ndarray:
    """float32 [H, W] of mean 0 and deviation 1: light and camera's gain make no difference."""
    grey = grey.astype(np.float32)
    return (grey - grey.mean()) / max(float(grey.std()), _LEAST_CONTRAST)


def load_object_mask(name_or_path: str | Path) -> tuple[ObjectMask, dict[str, Any]]:
    """The network in eval mode and its card. Raises WeightsError."""
    path = weights_path(name_or_path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weight file; train it with 'iwgnet train mask'")
    card = read_card(path)
    if card.get("input_px") != INPUT_PX:
        raise WeightsError(
            f"{path.with_suffix('.json')}: input_px is {card.get('input_px')}, this version reads "
            f"{INPUT_PX}; train again"
        )
    network = ObjectMask()
    load_state(network, path, NAME)
    return network.eval(), card


class MaskEstimator:
    """The network on any of networks.backends. One caller at a time."""

    input_px = INPUT_PX

    def __init__(self, weights: str | Path, backend: str = "auto") -> None:
        """Raises WeightsError or BackendError."""
        network, self.card = load_object_mask(weights)
        grey = probe_image((INPUT_PX, INPUT_PX))[..., 0]
        probe = np.stack([probe_heights(INPUT_PX), normalise_grey(grey)])[None]
        model = InferenceModel(OneOutput(network).eval(), probe, "window", ("logit",))
        self.backend, self._run = make_runner(model, backend)

    def predict(self, heights: np.ndarray, greys: np.ndarray) -> np.ndarray:
        """Logits [N, S, S] float32. heights: normalise_depth, [N, S, S]; greys: uint8 [N, S, S];
        S = INPUT_PX."""
        if len(heights) == 0:
            return np.empty((0, INPUT_PX, INPUT_PX), np.float32)
        greys = np.stack([normalise_grey(grey) for grey in greys])
        (logits,) = self._run(np.stack([heights, greys], axis=1).astype(np.float32))
        return logits


def mask_loss(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross entropy and 1 - Dice (Milletari et al. 2016), mean over windows. masks: [N, H, W]."""
    entropy = nn.functional.binary_cross_entropy_with_logits(logits, masks)
    found = torch.sigmoid(logits)
    overlap = (found * masks).sum((1, 2))
    dice = (2 * overlap + 1) / (found.sum((1, 2)) + masks.sum((1, 2)) + 1)
    return entropy + (1 - dice).mean()
