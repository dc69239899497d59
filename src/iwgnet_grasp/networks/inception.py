"""The paper's improved inception module (Eq. 6-15)."""

import torch
from torch import Tensor, nn


class ImprovedInception(nn.Module):
    """Four parallel branches at one resolution, concatenated along the channels (Eq. 15).

    1. 1x1, then 3x3 convolution (Eq. 6-7)
    2. 1x1, then two 3x3 convolutions in place of one 5x5 (Eq. 8-10)
    3. 1x1 convolution, then 3x3 max pooling (Eq. 11-12)
    4. 3x3 max pooling, then 3x3 average pooling of the input itself (Eq. 13-14)

    [N, C, H, W] -> [N, 3 * branch_channels + C, H, W]. The equations write the convolutions
    without an activation; `activation` follows each of them (ReLU by default, `nn.Identity` is the
    equations to the letter). All windows have stride 1. A max window sees no padding; an average
    at the border divides by the pixels that exist.
    """

    def __init__(
        self, channels: int, branch_channels: int, activation: type[nn.Module] = nn.ReLU
    ) -> None:
        super().__init__()
        width = branch_channels
        self.branch_1 = nn.Sequential(
            nn.Conv2d(channels, width, 1),
            activation(),
            nn.Conv2d(width, width, 3, padding=1),
            activation(),
        )
        self.branch_2 = nn.Sequential(
            nn.Conv2d(channels, width, 1),
            activation(),
            nn.Conv2d(width, width, 3, padding=1),
            activation(),
            nn.Conv2d(width, width, 3, padding=1),
            activation(),
        )
        self.branch_3 = nn.Sequential(
            nn.Conv2d(channels, width, 1),
            activation(),
            nn.MaxPool2d(3, stride=1, padding=1),
        )
        self.branch_4 = nn.Sequential(
            nn.MaxPool2d(3, stride=1, padding=1),
            nn.AvgPool2d(3, stride=1, padding=1, count_include_pad=False),
        )
        self.channels_out = 3 * width + channels

    def forward(self, x: Tensor) -> Tensor:
        branches = (self.branch_1, self.branch_2, self.branch_3, self.branch_4)
        return torch.cat([branch(x) for branch in branches], dim=1)
