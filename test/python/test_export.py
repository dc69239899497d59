"""`iwgnet export`: files that other programs read, equal to torch, or nothing at all."""

import json

import numpy as np
import onnxruntime
import openvino
import pytest
import torch
from safetensors.torch import load_file
from typer.testing import CliRunner

from iwgnet_grasp.cli import app
from iwgnet_grasp.networks import create_network
from iwgnet_grasp.networks import export as export_module
from iwgnet_grasp.networks.backends import BackendError, missing
from iwgnet_grasp.networks.export import ExportError, export
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX
from iwgnet_grasp.networks.weights import save_weights
from iwgnet_grasp.networks.yolov5s import YOLOv5s


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Weights of two grasp networks and of a detector, with a cache of their own."""
    path = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    for name in ("iwgnet", "grconvnet"):
        card = {"network": name, "input_px": 64, "width_reference_px": WIDTH_REFERENCE_PX}
        save_weights(create_network(name), path / f"{name}.safetensors", card)
    card = {"network": "yolov5s", "labels": ["rod"], "input": [64, 96]}
    save_weights(YOLOv5s(1), path / "yolov5s.safetensors", card)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield path


@pytest.mark.parametrize("name", ["iwgnet", "grconvnet"])
def test_files_of_a_grasp_network_give_its_maps(folder, tmp_path, name):
    written, _ = export(folder / f"{name}.safetensors", ("onnx", "openvino"), tmp_path, size=80)
    assert [entry.precision for entry in written] == ["fp32", "fp32"]
    stem = f"{name}_80x80"
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        f"{stem}.bin",
        f"{stem}.json",
        f"{stem}.onnx",
        f"{stem}.xml",
    ]
    network = create_network(name)
    network.load_state_dict(load_file(folder / f"{name}.safetensors"))
    heights = np.random.default_rng(0).uniform(0, 2, (1, 1, 80, 80)).astype(np.float32)
    with torch.inference_mode():
        maps = network.eval()(torch.from_numpy(heights))
    session = onnxruntime.InferenceSession(tmp_path / f"{stem}.onnx")
    outputs = session.run(list(maps._fields), {"height": heights})
    for key, found in zip(maps._fields, outputs, strict=True):
        np.testing.assert_allclose(found, getattr(maps, key).numpy(), atol=1e-4)
    exact = {"INFERENCE_PRECISION_HINT": "f32"}
    compiled = openvino.Core().compile_model(tmp_path / f"{stem}.xml", "CPU", exact)
    found = compiled({"height": heights})
    for key in maps._fields:
        np.testing.assert_allclose(found[key], getattr(maps, key).numpy(), atol=1e-4)
    about = json.loads((tmp_path / f"{stem}.json").read_text())
    assert about["input"] == {"height": ["float32", 1, 1, 80, 80]}
    assert about["outputs"] == ["q", "cos", "sin", "width"]
    assert all(entry["largest_difference"] < 1e-3 for entry in about["files"])


def test_the_detector_takes_an_images_bytes(folder, tmp_path):
    export(folder / "yolov5s.safetensors", ["onnx"], tmp_path)
    model = YOLOv5s(1)
    model.load_state_dict(load_file(folder / "yolov5s.safetensors"))
    image = np.random.default_rng(0).integers(0, 255, (1, 3, 64, 96), dtype=np.uint8)
    with torch.inference_mode():
        exact = model.eval()(torch.from_numpy(image).float() / 255)
    session = onnxruntime.InferenceSession(tmp_path / "yolov5s_64x96.onnx")
    names = ["stride_8", "stride_16", "stride_32"]
    for expected, found in zip(exact, session.run(names, {"image": image}), strict=True):
        np.testing.assert_allclose(found, expected.numpy(), atol=1e-3)


def test_half_precision_halves_the_file(folder, tmp_path):
    weights = folder / "grconvnet.safetensors"
    sizes = {}
    for precision in ("fp32", "fp16"):
        (entry,), _ = export(weights, ["openvino"], tmp_path / precision, precision=precision)
        assert entry.mean_difference < 0.01
        sizes[precision] = (tmp_path / precision / "grconvnet_64x64.bin").stat().st_size
    assert sizes["fp16"] < 0.6 * sizes["fp32"]


def test_a_file_that_differs_is_not_written(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(export_module, "EXACT", 0.0)
    with pytest.raises(ExportError, match=r"iwgnet_64x64\.onnx: differs from torch by"):
        export(folder / "iwgnet.safetensors", ["onnx"], tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "tflite"], "no format 'tflite'; known: onnx, openvino, tensorrt"),
        (["--format", "onnx", "--precision", "int8"], "no precision 'int8' for this format"),
        (["--precision", "fp4"], "no precision 'fp4'"),
        (["--precision", "int8"], "int8 is calibrated on samples"),
        (["--data", "absent"], "absent: no such folder"),
        (["--size", "400", "--data", "."], "samples have 300 px"),
    ],
)
def test_requests_that_cannot_be_met(folder, tmp_path, arguments, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = ["--weights", str(folder / "iwgnet.safetensors")]
    result = CliRunner().invoke(app, ["export", *weights, *arguments])
    assert result.exit_code != 0 and message in str(result.exception)
    assert "\n" not in str(result.exception)
    assert list(tmp_path.rglob("*.onnx")) == []


def test_a_detector_has_the_size_of_its_card(folder, tmp_path):
    with pytest.raises(ExportError, match="leave --size out"):
        export(folder / "yolov5s.safetensors", ["onnx"], tmp_path, size=300)


@pytest.mark.skipif(not missing("tensorrt"), reason="TensorRT is installed")
def test_a_library_that_is_missing_is_named(folder, tmp_path):
    with pytest.raises(BackendError, match="tensorrt: the package is not installed"):
        export(folder / "iwgnet.safetensors", ["tensorrt"], tmp_path)
    written, left_out = export(folder / "iwgnet.safetensors", ["onnx", "tensorrt"], tmp_path)
    assert [entry.format for entry in written] == ["onnx"]
    assert len(left_out) == 1 and left_out[0].startswith("tensorrt: ")
