"""Weight files: written whole, read strictly, every fault named in one line."""

import json
import pickle

import numpy as np
import pytest
import torch

from iwgnet_grasp.networks import create_network
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX
from iwgnet_grasp.networks.inference import GraspEstimator
from iwgnet_grasp.networks.weights import WeightsError, load_weights, save_weights

CARD = {"network": "iwgnet", "input_px": 96, "width_reference_px": WIDTH_REFERENCE_PX}


@pytest.fixture
def weights(tmp_path):
    torch.manual_seed(0)
    return save_weights(create_network("iwgnet"), tmp_path / "iwgnet.safetensors", CARD)


def change_card(path, **entries):
    path.with_suffix(".json").write_text(json.dumps(CARD | entries))


def test_weights_and_card_are_read_back(weights):
    torch.manual_seed(0)
    expected = create_network("iwgnet").state_dict()
    network, card = load_weights(weights)
    assert card == CARD and not network.training
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, expected[name])
    assert sorted(p.name for p in weights.parent.iterdir()) == [
        "iwgnet.json",
        "iwgnet.safetensors",
    ]


def test_quality_is_that_of_the_labels_whatever_power_of_it_was_learnt(weights):
    heights = torch.rand(1, 1, 96, 96)
    with torch.inference_mode():
        learnt = load_weights(weights)[0](heights)
        change_card(weights, training={"quality_power": 0.5})
        maps = load_weights(weights)[0](heights)
    torch.testing.assert_close(maps.q, learnt.q**2)
    assert torch.equal(maps.width, learnt.width)


def fails(path, *words):
    with pytest.raises(WeightsError) as caught:
        load_weights(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def test_missing_files(weights):
    fails(weights.parent / "other.safetensors", "other.safetensors", "no such weight file")
    weights.with_suffix(".json").unlink()
    fails(weights, "iwgnet.json", "card", "missing")


@pytest.mark.parametrize("size", [0, 7, 1000, -1000])
def test_truncated_files(weights, size):
    weights.write_bytes(weights.read_bytes()[:size])
    fails(weights, "iwgnet.safetensors", "not a whole safetensors file")


def test_a_pickle_is_not_opened(weights):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("a pickle from disk was run",))

    weights.write_bytes(pickle.dumps(Bomb()))
    fails(weights, "not a whole safetensors file")


def test_weights_of_another_network(weights):
    change_card(weights, network="ggcnn")
    fails(weights, "holds weights of 'iwgnet', not of 'ggcnn'")
    change_card(weights, network="resnet")
    fails(weights, "no grasp network 'resnet'")


def test_weights_of_another_version(tmp_path):
    class Other(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(2, 2)

    path = save_weights(Other(), tmp_path / "iwgnet.safetensors", CARD)
    fails(path, "is not a 'iwgnet' of this version")


def test_weights_that_are_not_numbers(tmp_path):
    network = create_network("iwgnet")
    with torch.no_grad():
        network.stem[0].weight[0] = float("nan")
    fails(save_weights(network, tmp_path / "iwgnet.safetensors", CARD), "NaN")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a": 1}'])
def test_broken_cards(weights, text):
    weights.with_suffix(".json").write_text(text)
    fails(weights, "iwgnet.json", "not a weight card")


def test_cards_with_other_units(weights):
    change_card(weights, width_reference_px=150.0)
    fails(weights, "150.0 px", "train again")
    weights.with_suffix(".json").write_text(json.dumps({"network": "iwgnet"}))
    fails(weights, "input_px")


def test_a_failed_write_leaves_the_old_file(weights, monkeypatch):
    before = weights.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space"):
        save_weights(create_network("iwgnet"), weights, CARD)
    assert weights.read_bytes() == before
    assert len(list(weights.parent.iterdir())) == 2


def windows(count, size=96):
    depth = np.full((count, size, size), 0.6, np.float32)
    depth[:, 40:56, 20:80] -= 0.02
    return depth


def test_the_estimator_takes_batches_and_refuses_other_sizes(weights):
    estimator = GraspEstimator(weights, backend="torch")
    assert estimator.input_px == 96
    depth = windows(2)
    depth[1] = np.nan  # nothing measured: no grasp, no error
    results = estimator.predict(depth, windows(2))
    assert len(results) == 2 and results[1] == []
    qualities = [grasp.quality for grasp in results[0]]
    assert qualities == sorted(qualities, reverse=True)
    assert estimator.predict(np.zeros((0, 96, 96), np.float32)) == []
    with pytest.raises(ValueError, match=r"must be \[N, 96, 96\]"):
        estimator.predict(np.zeros((1, 64, 64), np.float32))
    with pytest.raises(ValueError, match="differ"):
        estimator.predict(depth, windows(3))
