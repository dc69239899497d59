"""Every library gives what torch gives in float32, and `auto` takes none that does not."""

import numpy as np
import pytest
import torch

from iwgnet_grasp.networks import backends, create_network
from iwgnet_grasp.networks.backends import AGREEMENT, BackendError, difference, make_runner
from iwgnet_grasp.networks.detector_model import detector_model
from iwgnet_grasp.networks.inference import grasp_model, make_predictor
from iwgnet_grasp.networks.yolov5s import YOLOv5s

HERE = [name for name in backends.BACKENDS if not backends.missing(name)]
SIZE = 72  # divisible by GG-CNN's stride and by none of 16, 32


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def grasps(name="iwgnet"):
    torch.manual_seed(0)
    return grasp_model(create_network(name), SIZE)


def heights(count, size=SIZE):
    return np.random.default_rng(1).uniform(-0.1, 2, (count, 1, size, size)).astype(np.float32)


@pytest.mark.parametrize("name", ["iwgnet", "ggcnn2", "grconvnet"])
@pytest.mark.parametrize("backend", HERE)
def test_grasp_networks_agree_with_torch_in_float32(name, backend):
    model = grasps(name)
    images = heights(2)
    taken, run = make_runner(model, backend)
    assert taken == backend
    found = run(images)
    assert [f.shape for f in found] == [(2, SIZE, SIZE)] * 4
    assert all(f.dtype == np.float32 for f in found)
    assert difference(model.exact(images), found) < AGREEMENT


@pytest.mark.parametrize("backend", HERE)
def test_the_detector_agrees_with_torch_in_float32(backend):
    torch.manual_seed(0)
    model = detector_model(YOLOv5s(2), (64, 96))
    images = np.random.default_rng(0).integers(0, 255, (2, 3, 64, 96), dtype=np.uint8)
    _, run = make_runner(model, backend)
    found = run(images)
    assert [f.shape for f in found] == [(2, 64 // s, 96 // s, 3, 7) for s in (8, 16, 32)]
    assert difference(model.exact(images), found) < AGREEMENT


@pytest.mark.parametrize("backend", [name for name in HERE if name != "torch"])
def test_an_image_gives_the_same_alone_and_among_others(backend):
    name, predict = make_predictor(create_network("ggcnn"), SIZE, backend)
    images = heights(3)[:, 0]
    together = predict(images)
    assert name == backend and together.shape == (3, 4, SIZE, SIZE)
    for i in range(3):
        assert np.array_equal(predict(images[i : i + 1])[0], together[i])


def test_difference_is_a_mean_and_relative_to_large_outputs():
    small, large = np.full((2, 2), 0.5), np.full((2, 2), 10.0)
    assert difference([small], [small + 0.02]) == pytest.approx(0.02)
    assert difference([large], [large + 0.02]) == pytest.approx(0.002)
    assert difference([small, large], [small, large + 1]) == pytest.approx(0.1)
    assert np.isnan(difference([small, large], [small, large * np.nan]))


def test_auto_is_the_first_in_order_that_agrees(monkeypatch, caplog):
    monkeypatch.setattr(backends, "FASTEST_FIRST", {"cpu": tuple(reversed(HERE))} | {"gpu": ()})
    model = grasps()
    first, second = HERE[-1], HERE[-2]
    assert make_runner(model, "auto")[0] == first

    honest = backends.BACKENDS[first]

    def off(model):
        run = honest(model)
        return lambda images: [output + 2 * AGREEMENT for output in run(images)]

    monkeypatch.setitem(backends.BACKENDS, first, off)
    assert make_runner(model, "auto")[0] == second
    assert f"backend {first} is left out: it differs from torch" in caplog.text

    def broken(model):
        raise RuntimeError("no such\nlayer")

    monkeypatch.setitem(backends.BACKENDS, first, broken)
    assert make_runner(model, "auto")[0] == second
    assert f"backend {first} is left out: no such layer" in caplog.text


def test_backends_that_cannot_be_used_are_named():
    with pytest.raises(BackendError, match="no backend 'caffe'; known: auto, torch, onnxruntime"):
        make_runner(grasps(), "caffe")
    if "tensorrt" not in HERE:
        with pytest.raises(BackendError, match="backend tensorrt: ") as caught:
            make_runner(grasps(), "tensorrt")
        assert "\n" not in str(caught.value)


def test_a_cache_that_cannot_be_written_is_done_without(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    model = grasps("ggcnn")
    assert difference(model.exact(heights(1)), make_runner(model, "onnxruntime")[1](heights(1))) < (
        AGREEMENT
    )


def test_other_weights_are_another_model():
    model = grasps("ggcnn")
    assert model.digest == grasps("ggcnn").digest
    other = create_network("ggcnn")
    other.load_state_dict(model.module.state_dict())
    with torch.no_grad():
        other.heads.bias[0] += 1e-6
    assert grasp_model(other, SIZE).digest != model.digest
    assert grasp_model(create_network("ggcnn"), SIZE + 12).digest != model.digest
