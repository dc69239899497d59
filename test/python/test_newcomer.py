"""A newcomer's first run, in small: make data, train, evaluate, each with one command.

The README's size (200 scenes, 2 epochs) takes under 10 minutes on 2 cores.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from iwgnet_grasp.data.grasp_dataset import find_samples
from iwgnet_grasp.networks.weights import load_weights

ROOT = Path(__file__).resolve().parents[2]


def iwgnet(folder: Path, *arguments: str) -> str:
    """Output of a command that has to succeed, run in `folder`."""
    path = f"{ROOT / 'src'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    result = subprocess.run(
        [sys.executable, "-m", "iwgnet_grasp.cli", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path, "NO_COLOR": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout


def test_data_training_and_evaluation_in_three_commands(tmp_path):
    said = iwgnet(
        tmp_path, "dataset", "--scenes", "6", "--seed", "3", "--out", "data/mine",
        "--lift-check", "6",
    )  # fmt: skip
    assert "6 scenes" in said and "labels lift in Bullet" in said
    samples = find_samples(tmp_path / "data" / "mine")

    said = iwgnet(
        tmp_path, "train", "--network", "iwgnet", "--data", "data/mine", "--epochs", "1",
        "--batch", "4", "--workers", "0",
    )  # fmt: skip
    assert "wrote models/iwgnet.safetensors and models/iwgnet.json" in said
    weights = tmp_path / "models" / "iwgnet.safetensors"
    _, card = load_weights(weights)
    assert card["data"]["samples"] + card["data"]["validation_samples"] == len(samples)
    assert card["data"]["training"][0]["seed"] == 3
    assert list((tmp_path / "results" / "training" / "iwgnet").glob("events.out.tfevents*"))

    said = iwgnet(
        tmp_path, "evaluate", "--weights", str(weights), "--data", "data/mine",
        "--detector", "", "--lifts", "3", "--backend", "torch",
    )  # fmt: skip
    written = json.loads((tmp_path / "results" / "evaluation" / "evaluation.json").read_text())
    (network,) = written["networks"]
    result = network["sets"]["mine"]
    assert "| iwgnet |" in said and network["parameters"] == card["parameters"]
    assert result["score"]["objects"] == len(samples)
    assert 0 <= result["score"]["top1"] <= result["score"]["top5"] <= 1
    assert result["lifts"]["tried"] == 3
