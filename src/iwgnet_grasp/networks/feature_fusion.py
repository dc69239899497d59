"""The paper's weight-adaptive weighted feature fusion module (section 3.2, Eq. 16)."""

import torch
from torch import Tensor, nn


class WeightedFeatureFusion(nn.Module):
    """Adds a shallow and a deep map, each channel scaled by weights learned from both.

    Z = global average pooling of Concat(X_shallow, X_deep) (Eq. 16);
    s = sigmoid(FC2(ReLU(FC1(Z)))), split into s_shallow and s_deep as the channels were joined.

    How the paper's text is read. It says that the two parts of the weighted map are "multiplied
    channel-wise with the original shallow and deep feature maps, respectively, to achieve
    cross-weighting", and that Y = X_shallow + X^_deep, which leaves three things open: what a
    "part" is (map or weights), what "cross" crosses, and why only one term carries the hat.
    Multiplying a map by its own weighted copy would square the activations, so a part is taken to
    be the channel weights; "cross" is taken at its word: each map is scaled by the other's part,

        Y = s_deep * X_shallow + s_shallow * X_deep

    with X_shallow in the paper's sum being the reweighted map, as its own text says one sentence
    before. Since FC2 produces both parts from the same Z, crossed and uncrossed weights can
    represent the same functions; the crossing only names which half is trained for which map.

    Both maps [N, C, H, W] -> [N, C, H, W]: the sum needs C_1 = C_2.
    """

    def __init__(self, channels: int, reduction: int = 4) -> None:
        super().__init__()
        hidden = max(2 * channels // reduction, 4)
        self.attention = nn.Sequential(
            nn.Linear(2 * channels, hidden),
            nn.ReLU(inplace=True),
            nn.Linear(hidden, 2 * channels),
            nn.Sigmoid(),
        )

    def forward(self, shallow: Tensor, deep: Tensor) -> Tensor:
        pooled = torch.cat([shallow.mean((2, 3)), deep.mean((2, 3))], dim=1)
        weights = self.attention(pooled)[:, :, None, None]
        shallow_part, deep_part = weights.chunk(2, dim=1)
        return deep_part * shallow + shallow_part * deep


class PlainFusion(nn.Module):
    """Y = X_shallow + X_deep: what is left when the weights are ablated."""

    def __init__(self, channels: int) -> None:
        super().__init__()

    def forward(self, shallow: Tensor, deep: Tensor) -> Tensor:
        return shallow + deep
