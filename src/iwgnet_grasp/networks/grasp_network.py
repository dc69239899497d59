"""What every grasp network is: depth in, four maps of the same size out."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Opening (px of the network's input) that the width map calls 1. It is only a scale: widths are
# neither clipped nor tied to the input size, so a decoded width is map * WIDTH_REFERENCE_PX in the
# pixels of the image that went in, whatever was cropped or zoomed before.
WIDTH_REFERENCE_PX = 100.0

# Mean of the quality over all pixels of a label, about.
QUALITY_PRIOR = 0.02


class GraspMaps(NamedTuple):
    """Four maps [N, H, W]: quality in [0, 1], cos 2theta, sin 2theta, opening / reference."""

    q: Tensor
    cos: Tensor
    sin: Tensor
    width: Tensor


class GraspNetwork(nn.Module):
    """Base of the networks: a subclass gives `raw`, which needs sizes divisible by `stride`.

    Input [N, 1, H, W]: heights of `iwgnet_grasp.data.depth.normalise_depth`. Any H and W work:
    the lower and right edges are padded with the table (0) up to the stride and cropped again.
    """

    stride = 8
    quality_power = 1.0  # of the quality that the logit was trained for (training.losses)

    def raw(self, x: Tensor) -> Tensor:
        """[N, 4, H, W]: quality logit, cos 2theta, sin 2theta, opening / reference."""
        raise NotImplementedError

    def logits(self, x: Tensor) -> Tensor:
        """`raw` for any input size."""
        height, width = x.shape[-2:]
        down, right = -height % self.stride, -width % self.stride
        if down or right:
            return self.raw(F.pad(x, (0, right, 0, down)))[..., :height, :width]
        return self.raw(x)

    def forward(self, x: Tensor) -> GraspMaps:
        logits = self.logits(x)
        # By way of flat maps: splitting its own layout of images takes OpenVINO 10 % of the time.
        flat = logits.flatten(2).unbind(1)
        q, cos, sin, width = (one.reshape(logits[:, 0].shape) for one in flat)
        quality = torch.sigmoid(q)
        if self.quality_power != 1:
            quality = quality ** (1 / self.quality_power)
        return GraspMaps(quality, cos, sin, width)


def count_parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def set_quality_prior(heads: nn.Conv2d) -> None:
    """Starts the heads with Q = QUALITY_PRIOR everywhere (as Lin et al., Focal Loss, ICCV 2017).

    From Q = 0.5 the first steps would push every feature below zero for the empty table's sake, and
    ReLU keeps them there: all that is left to tell a grasp is that nothing speaks against it.
    `heads`: the last convolution, a quarter of its channels for each map, Q first.
    """
    quality = heads.bias[: heads.out_channels // 4]
    nn.init.constant_(quality, math.log(QUALITY_PRIOR / (1 - QUALITY_PRIOR)))


def conv_block(
    channels_in: int, channels_out: int, kernel: int = 3, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Convolution that keeps the size (at stride 1), batch normalisation and ReLU."""
    padding = dilation * (kernel - 1) // 2
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, kernel, stride, padding, dilation, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )
