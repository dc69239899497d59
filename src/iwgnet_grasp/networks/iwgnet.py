"""IWGNet: a GG-CNN-style encoder and decoder with improved inception and weighted fusion."""

from torch import Tensor, nn

from iwgnet_grasp.networks.feature_fusion import PlainFusion, WeightedFeatureFusion
from iwgnet_grasp.networks.grasp_network import GraspNetwork, conv_block, set_quality_prior
from iwgnet_grasp.networks.inception import ImprovedInception


def _inception(channels: int, branch_channels: int) -> nn.Sequential:
    module = ImprovedInception(channels, branch_channels)
    return nn.Sequential(module, nn.BatchNorm2d(module.channels_out))


def _plain(channels: int, branch_channels: int) -> nn.Sequential:
    """3x3, then 1x1 convolution: the inception module's output channels, slightly more weights."""
    return nn.Sequential(
        conv_block(channels, 2 * branch_channels),
        conv_block(2 * branch_channels, 3 * branch_channels + channels, kernel=1),
    )


def _upsample(channels_in: int, channels_out: int, kernel: int) -> nn.Sequential:
    """Twice the size by convolution and PixelShuffle."""
    return nn.Sequential(
        nn.Conv2d(channels_in, 4 * channels_out, kernel, padding=kernel // 2, bias=False),
        nn.PixelShuffle(2),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )


class IWGNet(GraspNetwork):
    """Depth -> quality, cos 2theta, sin 2theta and width.

    Encoder: 1/2 (stem), 1/4 and 1/8 of the input with inception modules and, as in GG-CNN2,
    dilated convolutions at the bottom. Decoder: convolution + PixelShuffle, fused with the
    encoder's maps of the same size. One convolution makes all four maps, at half the size and
    shuffled up. `inception` and `weighted_fusion` switch the paper's two modules off for the
    ablations.
    """

    stride = 8

    def __init__(self, inception: bool = True, weighted_fusion: bool = True) -> None:
        super().__init__()
        block = _inception if inception else _plain
        fusion = WeightedFeatureFusion if weighted_fusion else PlainFusion
        self.stem = conv_block(1, 16, kernel=5, stride=2)
        self.down_4 = nn.Sequential(conv_block(16, 32, stride=2), block(32, 16))
        self.down_8 = nn.Sequential(
            conv_block(80, 64, stride=2),
            block(64, 32),
            conv_block(160, 64, dilation=2),
            block(64, 32),
            conv_block(160, 64, dilation=4),
        )
        self.lateral_4 = conv_block(80, 48, kernel=1)
        self.up_4 = _upsample(64, 48, kernel=1)
        self.fuse_4 = fusion(48)
        self.smooth_4 = conv_block(48, 48)
        self.up_2 = _upsample(48, 16, kernel=3)
        self.fuse_2 = fusion(16)
        self.smooth_2 = conv_block(16, 32)
        heads = nn.Conv2d(32, 4 * 4, 3, padding=1)
        set_quality_prior(heads)
        self.heads = nn.Sequential(heads, nn.PixelShuffle(2))

    def raw(self, x: Tensor) -> Tensor:
        half = self.stem(x)
        quarter = self.down_4(half)
        deep = self.up_4(self.down_8(quarter))
        deep = self.smooth_4(self.fuse_4(self.lateral_4(quarter), deep))
        deep = self.smooth_2(self.fuse_2(half, self.up_2(deep)))
        return self.heads(deep)
