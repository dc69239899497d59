"""GG-CNN and GG-CNN2 (Morrison et al., RSS 2018 and IJRR 2019), layer for layer."""

import torch
from torch import Tensor, nn

from iwgnet_grasp.networks.grasp_network import GraspNetwork, set_quality_prior


class GGCNN(GraspNetwork):
    """Three strided convolutions, three transposed ones, four 2x2 heads; 62,420 parameters."""

    stride = 12

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(1, 32, 9, stride=3, padding=3),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 16, 5, stride=2, padding=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 8, 3, stride=2, padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(8, 8, 3, stride=2, padding=1, output_padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(8, 16, 5, stride=2, padding=2, output_padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(16, 32, 9, stride=3, padding=3, output_padding=1),
            nn.ReLU(inplace=True),
        )
        # The four published heads are one convolution with four output channels.
        self.heads = nn.Conv2d(32, 4, 2)
        _xavier(self)
        set_quality_prior(self.heads)

    def raw(self, x: Tensor) -> Tensor:
        return self.heads(self.features(x))


class GGCNN2(GraspNetwork):
    """Max pooling, two dilated convolutions, bilinear upsampling; 66,676 parameters."""

    stride = 4

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(1, 16, 11, padding=5),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 16, 5, padding=2),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2),
            nn.Conv2d(16, 16, 5, padding=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 16, 5, padding=2),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2),
            nn.Conv2d(16, 32, 5, dilation=2, padding=4),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 32, 5, dilation=4, padding=8),
            nn.ReLU(inplace=True),
            nn.UpsamplingBilinear2d(scale_factor=2),
            nn.Conv2d(32, 16, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.UpsamplingBilinear2d(scale_factor=2),
            nn.Conv2d(16, 16, 3, padding=1),
            nn.ReLU(inplace=True),
        )
        self.heads = nn.Conv2d(16, 4, 1)
        _xavier(self)
        set_quality_prior(self.heads)

    def raw(self, x: Tensor) -> Tensor:
        return self.heads(self.features(x))


def _xavier(network: nn.Module) -> None:
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.xavier_uniform_(layer.weight, gain=1)
            torch.nn.init.zeros_(layer.bias)
