"""Networks: the paper's modules against their equations, published sizes, any input size."""

import numpy as np
import pytest
import torch
from torch import nn

from iwgnet_grasp.networks import GRASP_NETWORKS, count_parameters, create_network
from iwgnet_grasp.networks.feature_fusion import PlainFusion, WeightedFeatureFusion
from iwgnet_grasp.networks.grasp_network import QUALITY_PRIOR
from iwgnet_grasp.networks.inception import ImprovedInception


def convolve(x, weight, bias):
    """Same-size convolution [C, H, W] by plain loops."""
    out_channels, in_channels, k, _ = weight.shape
    _, rows, columns = x.shape
    y = np.zeros((out_channels, rows, columns))
    for o in range(out_channels):
        for r in range(rows):
            for c in range(columns):
                total = bias[o]
                for i in range(in_channels):
                    for dr in range(k):
                        for dc in range(k):
                            rr, cc = r + dr - k // 2, c + dc - k // 2
                            if 0 <= rr < rows and 0 <= cc < columns:
                                total += weight[o, i, dr, dc] * x[i, rr, cc]
                y[o, r, c] = total
    return y


def pool(x, reduce):
    """3x3 windows of stride 1, only the pixels inside the image."""
    _, rows, columns = x.shape
    y = np.zeros_like(x)
    for i in range(len(x)):
        for r in range(rows):
            for c in range(columns):
                y[i, r, c] = reduce(x[i, max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2])
    return y


def parameters(layer):
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


@pytest.mark.parametrize("activation", [nn.Identity, nn.ReLU])
def test_inception_module_is_equations_6_to_15(activation):
    torch.manual_seed(0)
    module = ImprovedInception(3, 2, activation)
    x = torch.randn(1, 3, 5, 6)
    act = (lambda v: np.maximum(v, 0)) if activation is nn.ReLU else (lambda v: v)
    image = x[0].double().numpy()

    x1 = act(convolve(image, *parameters(module.branch_1[0])))  # Eq. 6
    x11 = act(convolve(x1, *parameters(module.branch_1[2])))  # Eq. 7
    x2 = act(convolve(image, *parameters(module.branch_2[0])))  # Eq. 8
    x21 = act(convolve(x2, *parameters(module.branch_2[2])))  # Eq. 9
    x22 = act(convolve(x21, *parameters(module.branch_2[4])))  # Eq. 10
    x3 = act(convolve(image, *parameters(module.branch_3[0])))  # Eq. 11
    x31 = pool(x3, np.max)  # Eq. 12
    x41 = pool(image, np.max)  # Eq. 13
    x42 = pool(x41, np.mean)  # Eq. 14
    expected = np.concatenate([x11, x22, x31, x42])  # Eq. 15

    y = module(x)[0].detach().numpy()
    assert y.shape == (module.channels_out, 5, 6) == (9, 5, 6)
    np.testing.assert_allclose(y, expected, atol=1e-5)


def test_inception_has_two_small_kernels_in_place_of_a_5x5():
    module = ImprovedInception(3, 2)
    kernels = [m.kernel_size[0] for m in module.branch_2 if isinstance(m, nn.Conv2d)]
    assert kernels == [1, 3, 3]
    assert not any(m.kernel_size[0] == 5 for m in module.modules() if isinstance(m, nn.Conv2d))


def test_fusion_module_is_equation_16_and_the_cross_reweighting():
    torch.manual_seed(1)
    channels, rows, columns = 3, 4, 5
    module = WeightedFeatureFusion(channels, reduction=2)
    shallow, deep = torch.randn(2, channels, rows, columns), torch.randn(2, channels, rows, columns)
    w1, b1 = parameters(module.attention[0])
    w2, b2 = parameters(module.attention[2])
    y = module(shallow, deep).detach().numpy()
    for n in range(2):
        concat = np.concatenate([shallow[n].numpy(), deep[n].numpy()]).astype(np.float64)
        z = np.zeros(2 * channels)
        for c in range(2 * channels):
            for i in range(rows):
                for j in range(columns):
                    z[c] += concat[c, i, j] / (rows * columns)  # Eq. 16
        hidden = np.maximum(w1 @ z + b1, 0)
        s = 1 / (1 + np.exp(-(w2 @ hidden + b2)))
        for c in range(channels):
            expected = s[channels + c] * concat[c] + s[c] * concat[channels + c]
            np.testing.assert_allclose(y[n, c], expected, atol=1e-6)


def test_fusion_weights_by_hand():
    """FC weights of zero and a bias of ln 3 and 0: the deep map weighs 3/4, the shallow 1/2."""
    module = WeightedFeatureFusion(1)
    for layer in (module.attention[0], module.attention[2]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    with torch.no_grad():
        module.attention[2].bias[0] = np.log(3)  # the shallow half, which scales the deep map
    y = module(torch.full((1, 1, 2, 2), 10.0), torch.full((1, 1, 2, 2), 100.0))
    torch.testing.assert_close(y, torch.full((1, 1, 2, 2), 0.5 * 10 + 0.75 * 100))


@pytest.mark.parametrize(
    "name, published", [("ggcnn", 62_420), ("ggcnn2", 66_676), ("grconvnet", 1_893_124)]
)
def test_rivals_have_their_published_size(name, published):
    assert count_parameters(create_network(name)) == published


def test_iwgnet_is_small_and_its_ablations_lack_one_module_each():
    def has(name, kind):
        return any(isinstance(m, kind) for m in create_network(name).modules())

    assert count_parameters(create_network("iwgnet")) < 600_000
    assert has("iwgnet", ImprovedInception) and has("iwgnet", WeightedFeatureFusion)
    assert not has("iwgnet-noinception", ImprovedInception)
    assert has("iwgnet-noinception", WeightedFeatureFusion)
    assert not has("iwgnet-nowff", WeightedFeatureFusion)
    assert has("iwgnet-nowff", ImprovedInception) and has("iwgnet-nowff", PlainFusion)
    # The ablation must not win or lose by its size.
    ratio = count_parameters(create_network("iwgnet-noinception")) / count_parameters(
        create_network("iwgnet")
    )
    assert 0.9 < ratio < 1.2


@pytest.mark.parametrize("name", GRASP_NETWORKS)
@pytest.mark.parametrize("size", [(64, 64), (72, 104), (60, 50)])
def test_maps_have_the_size_of_the_input(name, size):
    torch.manual_seed(0)
    with torch.no_grad():
        maps = create_network(name).eval()(torch.randn(2, 1, *size))
    assert all(m.shape == (2, *size) for m in maps)
    assert maps.q.min() >= 0 and maps.q.max() <= 1


@pytest.mark.parametrize("name", GRASP_NETWORKS)
def test_an_untrained_network_sees_few_grasps(name):
    torch.manual_seed(0)
    with torch.no_grad():
        q = create_network(name).eval()(torch.randn(2, 1, 72, 72)).q
    assert q.mean() == pytest.approx(QUALITY_PRIOR, rel=0.2)


def test_an_item_of_a_batch_does_not_depend_on_the_others():
    torch.manual_seed(0)
    network = create_network("iwgnet").eval()
    x = torch.randn(3, 1, 64, 64)
    with torch.no_grad():
        together, alone = network(x), network(x[1:2])
    for a, b in zip(together, alone, strict=True):
        torch.testing.assert_close(a[1:2], b, atol=1e-5, rtol=1e-4)


def test_unknown_network_names_the_known_ones():
    with pytest.raises(ValueError, match="no grasp network 'resnet'; known: iwgnet"):
        create_network("resnet")
