"""Training: metric, loss, and a network that learns, resumes and leaves a usable weight file."""

import json
import resource
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch
import yaml

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import Grasp
from iwgnet_grasp.data.jacquard import format_grasps
from iwgnet_grasp.networks.inference import GraspEstimator
from iwgnet_grasp.training import grasp_training
from iwgnet_grasp.training.card import describe_set
from iwgnet_grasp.training.grasp_training import (
    GraspTrainingSettings,
    TrainingResources,
    draw,
    train_grasp_network,
)
from iwgnet_grasp.training.losses import grasp_loss
from iwgnet_grasp.training.rectangle_metric import matches

ROOT = Path(__file__).resolve().parents[2]
TRUTH = np.array([[100, 100, 0.2, 60, 30, 1], [40, 40, 1.5, 50, 25, 1]], np.float32)


@pytest.mark.parametrize(
    "grasp, right",
    [
        (Grasp(100, 100, 0.2, 60, 1), True),
        (Grasp(40, 40, -1.6, 50, 1), True),  # the same direction beyond the wrap
        (Grasp(100, 100, 0.2 + np.radians(29), 60, 1), True),
        (Grasp(100, 100, 0.2 + np.radians(31), 60, 1), False),
        (Grasp(140, 100, 0.2, 60, 1), False),
        (Grasp(100, 100, 0.2, 14, 1), False),  # 14 of 60 px is an IoU of 0.23
        (Grasp(100, 100, 0.2, 16, 1), True),
        (Grasp(100, 100, 0.2, 0, 1), False),
    ],
)
def test_rectangle_metric(grasp, right):
    assert matches(grasp, TRUTH) is right


def labels_and_logits():
    torch.manual_seed(0)
    labels = torch.zeros(1, 5, 8, 8)
    labels[:, :, 2:4, 2:5] = torch.tensor([0.8, 0.6, 0.8, 0.5, 1.0])[None, :, None, None]
    return labels, torch.randn(1, 4, 8, 8)


def test_background_has_no_angle_and_no_width():
    labels, logits = labels_and_logits()
    before = grasp_loss(logits, labels)
    logits[:, 1:, 5:] += 3.0
    after = grasp_loss(logits, labels)
    assert after.angle == before.angle and after.width == before.width
    logits[:, 1:, 2] += 3.0
    assert grasp_loss(logits, labels).angle > before.angle


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_loss_is_smallest_at_the_labels(power):
    labels, _ = labels_and_logits()
    target = labels[:, :1] ** power
    right = torch.cat([torch.logit(target.clamp(1e-6, 1 - 1e-6)), labels[:, 1:4]], dim=1)
    loss = grasp_loss(right, labels, power)
    assert loss.total < 1e-4
    assert grasp_loss(right + 0.2, labels, power).total > loss.total


def bar_set(root, count, seed=0):
    """Bars of random place, direction and thickness on a noisy table, grasped across."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        angle, thickness = rng.uniform(0, np.pi), int(rng.integers(10, 20))
        centre = 150 + rng.uniform(-6, 6, 2)
        along = np.array([np.cos(angle), -np.sin(angle)])
        height = np.zeros((300, 300), np.float32)
        ends = [tuple(np.round(centre + s * 34 * along).astype(int).tolist()) for s in (-1, 1)]
        cv2.line(height, ends[0], ends[1], 0.02, thickness)
        depth = (0.6 - height + rng.normal(0, 5e-4, height.shape)).astype(np.float32)
        places = [centre + s * along for s in np.linspace(-20, 20, 9)]
        rows = [[*p, angle + np.pi / 2, thickness + 20, 22, 1] for p in places]
        folder = root / f"{i:03d}"
        folder.mkdir(parents=True)
        tifffile.imwrite(folder / f"0_{i:03d}_stereo_depth.tiff", depth)
        text = format_grasps(np.array(rows))
        (folder / f"0_{i:03d}_grasps.txt").write_bytes(text.encode())
    return root


RESOURCES = TrainingResources(accelerator="cpu", workers=0, threads=1)


def train(data, out, resume=False, initial=None, **settings):
    chosen = {"epochs": 2, "batch": 8, "input_px": 96} | settings
    return train_grasp_network(
        GraspTrainingSettings(**chosen),
        [data],
        out / "models",
        out / "logs",
        initial=initial,
        resume=resume,
        resources=RESOURCES,
        progress=False,
    )


def test_iwgnet_learns_to_grasp_a_bar(tmp_path):
    """48 pictures, some 100 steps: most unseen bars are grasped right, and the file works."""
    weights = train(bar_set(tmp_path / "data", 53), tmp_path, epochs=12)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["network"] == "iwgnet" and card["parameters"] < 600_000
    assert card["data"]["samples"] == 48 and card["training"]["seed"] == 0
    assert card["validation"]["top1"] >= 0.8
    assert list((tmp_path / "logs" / "iwgnet").glob("events.out.tfevents*"))

    bar = np.zeros((96, 96), np.float32)
    cv2.line(bar, (20, 48), (76, 48), 0.02, 14)
    best = GraspEstimator(weights, backend="torch").predict((0.6 - bar)[None])[0][0]
    assert abs(best.y_px - 48) < 5 and 15 < best.x_px < 81
    assert abs(best.theta_rad) > np.radians(70)  # closes along y
    assert 22 < best.width_px < 46


def test_a_killed_run_ends_as_if_it_had_not_been(tmp_path, monkeypatch):
    data = bar_set(tmp_path / "data", 18)
    whole = train(data, tmp_path / "whole")

    original = grasp_training.GraspTraining.training_step

    def killed_in_the_second_epoch(self, batch, index):
        if self.current_epoch == 1:
            raise KeyboardInterrupt
        return original(self, batch, index)

    monkeypatch.setattr(grasp_training.GraspTraining, "training_step", killed_in_the_second_epoch)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        train(data, tmp_path / "halves")
    monkeypatch.setattr(grasp_training.GraspTraining, "training_step", original)
    halves = train(data, tmp_path / "halves", resume=True)
    first = torch.load(tmp_path / "whole/logs/iwgnet/last.ckpt", weights_only=True)
    second = torch.load(tmp_path / "halves/logs/iwgnet/last.ckpt", weights_only=True)
    assert first["global_step"] == second["global_step"] == 4
    for name, tensor in first["state_dict"].items():
        assert torch.equal(tensor, second["state_dict"][name]), name
    assert whole.with_suffix(".json").read_text() == halves.with_suffix(".json").read_text()


def fails_to_resume(out, data, message, **settings):
    with pytest.raises(DataError, match=message) as caught:
        train(data, out, resume=True, **settings)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_that_does_not_fit_is_one_line(tmp_path):
    data = bar_set(tmp_path / "data", 9)
    train(data, tmp_path, network="ggcnn", epochs=1)
    last = tmp_path / "logs" / "ggcnn" / "last.ckpt"
    fails_to_resume(tmp_path, data, "epochs 1, not 3", network="ggcnn", epochs=3)
    fails_to_resume(tmp_path, bar_set(tmp_path / "more", 18), "samples 8, not", network="ggcnn")
    (tmp_path / "logs" / "iwgnet").mkdir()
    shutil.copy(last, tmp_path / "logs" / "iwgnet")
    fails_to_resume(tmp_path, data, "network ggcnn, not iwgnet", epochs=1)
    stored = torch.load(last, weights_only=True)
    torch.save({"state_dict": stored["state_dict"]}, tmp_path / "logs" / "iwgnet" / "last.ckpt")
    fails_to_resume(tmp_path, data, "another network than this 'iwgnet'")
    last.write_bytes(last.read_bytes()[:100_000])
    fails_to_resume(tmp_path, data, "not a whole checkpoint", network="ggcnn", epochs=1)


@pytest.mark.parametrize("limit_bytes", [100_000, 400_000])
def test_a_full_disk_is_one_line_and_leaves_no_half_file(tmp_path, limit_bytes):
    """Files may not grow beyond a limit, the system's stand-in for a full disk: GG-CNN's weights
    need 250 kB, its checkpoint with the optimizer's state 750 kB."""
    data = bar_set(tmp_path / "data", 9)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        with pytest.raises(DataError, match="File too large; make room") as caught:
            train(data, tmp_path, network="ggcnn", epochs=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    whole = limit_bytes > 300_000
    assert (tmp_path / "models" / "ggcnn.safetensors").exists() == whole
    assert not (tmp_path / "logs" / "ggcnn" / "last.ckpt").exists()
    assert not [p for p in tmp_path.rglob(".*") if p.is_file()]
    train(data, tmp_path, network="ggcnn", epochs=1)


def test_the_card_tells_how_to_make_the_data_again(tmp_path):
    settings = yaml.safe_load((ROOT / "config" / "dataset.yaml").read_text())
    (tmp_path / "set").mkdir()
    made = {"seed": 3, "scenes": 7, "families": ["tee"], "library": "ab", "settings": settings}
    (tmp_path / "set" / "dataset.json").write_text(json.dumps(made))
    described = describe_set(tmp_path / "set")
    digest = described.pop("settings_sha256")
    assert described == {"folder": "set", "settings": {}} | {
        k: made[k] for k in ("seed", "scenes", "families", "library")
    }
    settings["camera"]["tilt"] = 0.5
    (tmp_path / "set" / "dataset.json").write_text(json.dumps(made))
    assert describe_set(tmp_path / "set")["settings"] == {"camera.tilt": 0.5}
    assert describe_set(tmp_path / "set")["settings_sha256"] != digest
    assert describe_set(tmp_path) == {"folder": tmp_path.name}


def test_the_card_keeps_what_earlier_stages_did_otherwise(tmp_path):
    data = bar_set(tmp_path / "data", 9)
    first = train(data, tmp_path / "a", network="ggcnn", epochs=1)
    second = train(
        data, tmp_path / "b", network="ggcnn", epochs=1, learning_rate=1e-3, initial=first
    )
    third = train(data, tmp_path / "c", network="ggcnn", epochs=2, seed=5, initial=second)
    card = json.loads(third.with_suffix(".json").read_text())
    assert card["before"]["training"] == {"epochs": 1, "learning_rate": 1e-3, "seed": 0}
    assert card["before"]["before"]["training"] == {"learning_rate": 2e-3}
    assert "data" not in card["before"] and card["before"]["validation"]["top1"] >= 0


def test_bad_requests_are_one_line(tmp_path):
    data = bar_set(tmp_path / "data", 2)
    with pytest.raises(ValueError, match="no grasp network 'vgg'"):
        train(data, tmp_path, network="vgg")
    with pytest.raises(ValueError, match="no split 'random'"):
        train(data, tmp_path, split="random")
    with pytest.raises(DataError, match="no checkpoint to resume from"):
        train(data, tmp_path, resume=True)
    with pytest.raises(DataError, match="no such folder"):
        train(tmp_path / "absent", tmp_path)


@pytest.mark.parametrize(
    ("hard_count", "share"), [(10, 0.5), (70, 0.5), (0, 0.5), (100, 0.5), (3, 1.0)]
)
def test_an_epoch_has_its_share_of_hard_samples(hard_count, share):
    hard = np.zeros(100, bool)
    hard[:hard_count] = True
    order = draw(hard, share, np.random.default_rng(1))
    assert len(order) == 100
    drawn = np.count_nonzero(hard[order])
    natural = hard_count in (0, 100)
    assert drawn == (hard_count if natural else max(hard_count, share * 100))
    # Each kind is gone through evenly.
    for kind in (order[hard[order]], order[~hard[order]]):
        counts = np.unique(kind, return_counts=True)[1]
        assert len(counts) == 0 or counts.max() - counts.min() <= 1
