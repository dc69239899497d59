"""GR-ConvNet (Kumra et al., IROS 2020) for depth alone, layer for layer; 1,893,124 parameters."""

from torch import Tensor, nn
from torch.nn import functional as F

from iwgnet_grasp.networks.grasp_network import GraspNetwork, set_quality_prior


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.norm_1 = nn.BatchNorm2d(channels)
        self.conv_2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.norm_2 = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm_1(self.conv_1(x)))
        return x + self.norm_2(self.conv_2(y))


class GRConvNet(GraspNetwork):
    stride = 4

    def __init__(self, channels: int = 32) -> None:
        super().__init__()
        c = channels
        self.encoder = nn.Sequential(
            nn.Conv2d(1, c, 9, padding=4),
            nn.BatchNorm2d(c),
            nn.ReLU(inplace=True),
            nn.Conv2d(c, 2 * c, 4, stride=2, padding=1),
            nn.BatchNorm2d(2 * c),
            nn.ReLU(inplace=True),
            nn.Conv2d(2 * c, 4 * c, 4, stride=2, padding=1),
            nn.BatchNorm2d(4 * c),
            nn.ReLU(inplace=True),
        )
        self.residual = nn.Sequential(*(_Residual(4 * c) for _ in range(5)))
        self.decoder = nn.Sequential(
            nn.ConvTranspose2d(4 * c, 2 * c, 4, stride=2, padding=1, output_padding=1),
            nn.BatchNorm2d(2 * c),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(2 * c, c, 4, stride=2, padding=2, output_padding=1),
            nn.BatchNorm2d(c),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(c, c, 9, padding=4),
        )
        # The four published heads are one convolution with four output channels.
        self.heads = nn.Conv2d(c, 4, 2)
        set_quality_prior(self.heads)

    def raw(self, x: Tensor) -> Tensor:
        return self.heads(self.decoder(self.residual(self.encoder(x))))
