"""Training of the detector: data, augmentation, learning, resuming, weights and card."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask

from iwgnet_grasp.data.detection import (
    Augmentation,
    DetectionScene,
    DetectionSet,
    DetectionWindows,
    WholeScenes,
    collate,
    load_detection_set,
    outline,
    overlapping,
)
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.letterbox import checked_region, letterbox
from iwgnet_grasp.networks.weights import load_state, read_card
from iwgnet_grasp.networks.yolov5s import ANCHORS, YOLOv5s
from iwgnet_grasp.training.detector import (
    DetectorTraining,
    DetectorTrainingConfig,
    DetectorTrainingError,
    Phase,
    fit,
    measure,
    measure_batch_norm,
    network_input,
    train_detector,
)
from iwgnet_grasp.training.detector_loss import LossWeights, detection_loss
from iwgnet_grasp.training.detector_metrics import ImageBoxes, average_precision

COLOR = (250, 40, 40)


def scene(seed: int, size=(128, 192), count=2) -> DetectionScene:
    """Red rectangles on dark noise."""
    rng = np.random.default_rng(seed)
    image = rng.integers(20, 60, (*size, 3), dtype=np.uint8)
    boxes = []
    for k in range(count):
        x, y = rng.integers(10 + 90 * k, 40 + 90 * k), rng.integers(10, 60)
        w, h = rng.integers(24, 50, 2)
        image[y : y + h, x : x + w] = COLOR
        boxes.append([x, y, x + w, y + h])
    return DetectionScene(
        f"{seed:06d}", image, np.array(boxes, np.float32), np.zeros(count, np.int64)
    )


def scenes(count: int) -> DetectionSet:
    return DetectionSet(tuple(scene(i) for i in range(count)), ("block",))


TINY = DetectorTrainingConfig(
    phases=(
        Phase(epochs=1, images=4, size=(64, 64), zoom=0.5, batch=2),
        Phase(epochs=1, images=2, size=(64, 96), zoom=1.0, batch=2),
    ),
    input=(128, 192),
    warmup_steps=1,
    seed=5,
)


# Data ---------------------------------------------------------------------------------------------


def test_letterbox_halves_the_cameras_image_and_goes_back():
    image = np.zeros((800, 1280, 3), np.uint8)
    image[200:300, 400:600] = COLOR
    fitted, fit_ = letterbox(image, (416, 640))
    assert fitted.shape == (416, 640, 3)
    assert (fit_.scale, fit_.left, fit_.top) == (0.5, 0, 8)
    box = np.array([[400.0, 200.0, 600.0, 300.0]])
    x1, y1, x2, y2 = fit_.to_input(box)[0].astype(int)
    assert np.all(fitted[y1:y2, x1:x2] == COLOR)
    assert np.all(fitted[y1 - 1, x1:x2] == 0)
    np.testing.assert_allclose(fit_.to_image(fit_.to_input(box)), box)


def test_a_region_is_fitted_and_goes_back_to_the_whole_images_pixels():
    image = np.zeros((800, 1280, 3), np.uint8)
    image[200:300, 400:600] = COLOR
    fitted, fit_ = letterbox(image, (576, 480), (340 / 1280, 40 / 800, 940 / 1280, 760 / 800))
    assert fit_.scale == pytest.approx(0.8)
    box = np.array([[400.0, 200.0, 600.0, 300.0]])
    x1, y1, x2, y2 = np.round(fit_.to_input(box)[0]).astype(int)
    assert (x1, y1, x2, y2) == (48, 128, 208, 208)  # 0.8 of the distance from (340, 40)
    assert np.all(fitted[y1:y2, x1:x2] == COLOR)
    assert np.all(fitted[y1 - 2, x1:x2] == 0)
    np.testing.assert_allclose(fit_.to_image(fit_.to_input(box)), box)


@pytest.mark.parametrize("region", [(0.5, 0, 0.5, 1), (0, 0, 1.2, 1), (0, 0.6, 1, 0.4), (0, 1)])
def test_a_region_outside_the_image_or_turned_round_is_refused(region):
    with pytest.raises(ValueError):
        checked_region(region)


def red(image: np.ndarray) -> np.ndarray:
    return (image[..., 0].astype(int) - image[..., 1]) > 60


def test_augmented_boxes_still_bound_their_objects():
    plain = Augmentation(brightness=0, saturation=0, hue=0, noise=0, min_visible=0.0)
    windows = DetectionWindows([scene(3, count=1)], 40, (96, 160), 1.0, 7, 0, plain)
    seen = 0
    for i in range(len(windows)):
        image, boxes, labels = windows[i]
        rows, columns = np.nonzero(red(image.permute(1, 2, 0).numpy()))
        if len(boxes) == 0:
            continue
        seen += 1
        (box,) = boxes.tolist()
        tight = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert box == pytest.approx(tight, abs=1.5)
        assert labels.tolist() == [0]
    assert seen > 20


def rod(seed: int, size=(128, 192)) -> DetectionScene:
    """A slanted red bar on a dark ground, with its mask's outline."""
    mask = np.zeros(size, np.uint8)
    x, y = np.random.default_rng(seed).integers(40, 60, 2)
    cv2.line(mask, (int(x), int(y)), (int(x) + 70, int(y) + 40), 1, 9)
    image = np.full((*size, 3), 30, np.uint8)
    image[mask > 0] = COLOR
    code = coco_mask.encode(np.asfortranarray(mask))
    points = outline(code, size)
    box = np.hstack([points.min(0), points.max(0)]).astype(np.float32)
    return DetectionScene("rod", image, box[None], np.zeros(1, np.int64), (points,))


def test_boxes_of_masked_objects_are_tight_at_any_turn_and_where_the_window_cuts():
    plain = Augmentation(any_turn=1.0, brightness=0, saturation=0, hue=0, noise=0, min_visible=0.0)
    windows = DetectionWindows([rod(2)], 60, (64, 64), 1.0, 4, 0, plain)
    whole, errors = 0, []
    for image, found, _ in (windows[i] for i in range(len(windows))):
        rows, columns = np.nonzero(red(image.permute(1, 2, 0).numpy()))
        if len(found) == 0:
            continue
        tight = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        errors.append(np.abs(found[0].numpy() - tight).max())
        whole += rows.min() > 0 and rows.max() < 63
    assert whole > 3  # not only windows that the bar crosses from edge to edge
    # The pixel at the edge decides where a bar that nearly lies along it is cut.
    assert np.mean(errors) < 1.0 and max(errors) < 5.0


def test_outline_bounds_a_mask_in_every_coco_form():
    square = [[10, 20, 30, 20, 30, 50, 10, 50]]
    mask = np.zeros((80, 60), np.uint8)
    mask[20:50, 10:30] = 1
    code = coco_mask.encode(np.asfortranarray(mask))
    counts = [20 + 10 * 80, 30] + [50, 30] * 19 + [80 * 60 - (29 * 80 + 50)]  # by columns
    for form in (square, code, {"size": [80, 60], "counts": counts}):
        points = outline(form, (80, 60))
        assert (*points.min(0), *points.max(0)) == (10, 20, 30, 50)


def test_windows_are_a_function_of_seed_epoch_and_index():
    data = scenes(3).scenes
    first = DetectionWindows(data, 4, (64, 64), 1.0, seed=1, epoch=2)
    again = DetectionWindows(data, 4, (64, 64), 1.0, seed=1, epoch=2)
    later = DetectionWindows(data, 4, (64, 64), 1.0, seed=1, epoch=3)
    assert torch.equal(first[2][0], again[2][0])
    assert not torch.equal(first[2][0], later[2][0])


def test_collate_gives_centres_and_sizes_with_the_image_index():
    images, targets = collate([WholeScenes([scene(0), scene(1)])[i] for i in (0, 1)])
    assert images.shape == (2, 3, 128, 192) and images.dtype == torch.uint8
    assert targets[:, 0].tolist() == [0, 0, 1, 1]
    x1, y1, x2, y2 = scene(1).boxes[0].tolist()
    assert targets[2, 2:].tolist() == [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1]


def test_parts_of_piles_are_looked_at_more_often():
    boxes = np.array([[0, 0, 40, 40], [30, 30, 60, 60], [38, 10, 70, 35], [80, 80, 90, 90]], float)
    assert overlapping(boxes).tolist() == [2, 2, 2, 0]
    pile = replace(scene(0), boxes=boxes.astype(np.float32), labels=np.zeros(4, np.int64))
    windows = DetectionWindows([scene(1), pile], 4, (64, 64), 1.0, 0, 0)
    times = [windows.objects.count(entry) for entry in ((0, 0), (1, 0), (1, 3))]
    assert times == [1, 3, 1]


def write_coco(folder, count=4):
    images = folder / "detector" / "images"
    images.mkdir(parents=True)
    entries, annotations = [], []
    for i in range(count):
        picture = np.zeros((200, 320, 3), np.uint8)
        picture[50:90, 100 + i : 160 + i] = COLOR
        cv2.imwrite(str(images / f"{i:06d}.png"), picture[..., ::-1])
        entries.append({"id": i, "file_name": f"{i:06d}.png", "width": 320, "height": 200})
        annotations.append(
            {"id": i + 1, "image_id": i, "category_id": 1, "bbox": [100 + i, 50, 60, 40]}
        )
    text = {
        "images": entries,
        "annotations": annotations,
        "categories": [{"id": 1, "name": "connecting_rod"}],
    }
    (folder / "detector" / "annotations.json").write_text(json.dumps(text))
    return folder


def test_coco_set_is_read_into_input_pixels(tmp_path):
    data = load_detection_set(write_coco(tmp_path), (128, 160))
    assert data.classes == ("connecting_rod",)
    assert [s.name for s in data.scenes] == ["000000", "000001", "000002", "000003"]
    # 320 x 200 -> 160 x 100, 14 rows of grey above.
    assert data.scenes[2].boxes.tolist() == [[51.0, 39.0, 81.0, 59.0]]
    assert tuple(data.scenes[2].image[50, 60]) == COLOR
    assert len(load_detection_set(tmp_path, (128, 160), limit=2).scenes) == 2


def test_split_holds_out_the_last_scenes():
    train, test = scenes(10).split(0.2)
    assert [s.name for s in test.scenes] == ["000008", "000009"]
    assert len(train.scenes) == 8
    with pytest.raises(DataError, match="cannot be split"):
        scenes(1).split(0.1)


def test_faults_of_a_set_are_one_line_with_the_file(tmp_path):
    with pytest.raises(DataError, match="annotations.json"):
        load_detection_set(tmp_path, (128, 160))
    write_coco(tmp_path)
    (tmp_path / "detector" / "images" / "000001.png").unlink()
    with pytest.raises(DataError, match="000001.png"):
        load_detection_set(tmp_path, (128, 160))
    (tmp_path / "detector" / "annotations.json").write_text('{"images": []}')
    with pytest.raises(DataError, match="not COCO"):
        load_detection_set(tmp_path, (128, 160))


# Metrics ------------------------------------------------------------------------------------------


def boxes(*rows, scores=None) -> ImageBoxes:
    return ImageBoxes(
        np.array(rows, float).reshape(-1, 4),
        np.zeros(len(rows), int),
        None if scores is None else np.array(scores),
    )


def test_average_precision_of_known_detections():
    truth = [boxes([0, 0, 40, 40], [60, 60, 100, 100])]
    assert average_precision(truth, [boxes(*truth[0].boxes, scores=[0.9, 0.8])], 1) == {
        "map50": pytest.approx(1.0),
        "map50_95": pytest.approx(1.0),
        "recall": pytest.approx(1.0),
    }
    # Found one of two, exactly: precision 1 up to recall 1/2 -> 51 of COCO's 101 points.
    half = average_precision(truth, [boxes([0, 0, 40, 40], scores=[0.9])], 1)
    assert half["map50"] == pytest.approx(51 / 101, abs=1e-6)
    # IoU 0.64 counts at 0.50, 0.55 and 0.60 of the ten thresholds.
    loose = average_precision([boxes([0, 0, 100, 100])], [boxes([0, 0, 80, 80], scores=[0.9])], 1)
    assert loose["map50"] == pytest.approx(1.0)
    assert loose["map50_95"] == pytest.approx(0.3)


def test_average_precision_without_detections_or_truth():
    truth = [boxes([0, 0, 40, 40])]
    assert average_precision(truth, [boxes(scores=[])], 1)["map50"] == 0.0
    assert np.isnan(average_precision([boxes()], [boxes(scores=[])], 1)["map50"])


# Training -----------------------------------------------------------------------------------------


def test_a_few_steps_on_one_batch_lower_the_loss():
    torch.manual_seed(0)
    module = DetectorTraining(TINY, 1)
    images, targets = collate(
        [DetectionWindows([scene(0)], 2, (64, 64), 0.5, 0, 0)[i] for i in (0, 1)]
    )
    optimizer = torch.optim.AdamW(module.model.parameters(), 1e-3)
    losses = []
    for _ in range(6):
        loss, _terms = detection_loss(
            module.model(network_input(images)), targets, module.model.anchors, LossWeights()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_phases_follow_each_other():
    assert [TINY.phase(e).size for e in range(2)] == [(64, 64), (64, 96)]
    assert TINY.epochs == 2 and TINY.steps == 3


def test_resumed_training_ends_where_the_whole_one_does(tmp_path):
    train, test = scenes(3).split(0.34)
    whole = fit(TINY, train, test, tmp_path / "whole")

    class Interrupted(Exception):
        pass

    calls = {"epochs": 0}
    start = DetectorTraining.on_train_epoch_start

    def interrupt(self):
        if calls["epochs"] == 1:
            raise Interrupted
        calls["epochs"] += 1
        start(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DetectorTraining, "on_train_epoch_start", interrupt)
        with pytest.raises(Interrupted):
            fit(TINY, train, test, tmp_path / "cut")
    resumed = fit(TINY, train, test, tmp_path / "cut", resume=True)
    for name, value in whole.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[name], value, msg=name)


def test_nothing_to_resume_is_said(tmp_path):
    train, test = scenes(4).split(0.25)
    with pytest.raises(DetectorTrainingError, match="no run to resume"):
        fit(TINY, train, test, tmp_path, resume=True)


def test_command_writes_weights_that_load_and_a_card(tmp_path, capsys):
    write_coco(tmp_path / "set")
    config = tmp_path / "training.yaml"
    config.write_text(
        "input: [128, 160]\nregion: [0, 0, 1, 1]\nbatch_norm_images: 4\n"
        "held_out: 0.25\nseed: 3\nlearning_rate: 0.001\n"
        "final_learning_rate: 0.0001\nwarmup_steps: 1\nweight_decay: 0.01\nema_decay: 0.5\n"
        "phases: [{epochs: 1, images: 4, size: [64, 64], zoom: 1.0, batch: 2}]\n"
        f"anchors: {[[list(a) for a in scale] for scale in ANCHORS]}\n"
        "loss: {box: 0.05, objectness: 1.0, class: 0.5, anchor_ratio: 4.0,"
        " balance: [4.0, 1.0, 0.4]}\n"
    )
    output = tmp_path / "models" / "tiny.safetensors"
    train_detector(data=[tmp_path / "set"], output=output, config=config, run=tmp_path / "run")
    card = read_card(output)
    assert card["network"] == "yolov5s" and card["labels"] == ["connecting_rod"]
    assert card["input"] == [128, 160] and card["parameters"] == 7_022_326
    assert card["training"]["seed"] == 3 and card["data"]["scenes"] == 3
    assert 0.0 <= card["validation"]["map50"] <= 1.0
    assert output.stat().st_size < 15e6
    load_state(YOLOv5s(1), output, "yolov5s")
    assert "epoch 1/1" in capsys.readouterr().out

    later = tmp_path / "models" / "later.safetensors"
    train_detector(
        data=[tmp_path / "set", tmp_path / "set"],
        output=later,
        config=config,
        run=tmp_path / "later",
        initial=output,
        seed=4,
    )
    before = read_card(later)["before"]  # of the first stage what differs
    assert before["training"] == {"seed": 3} and before["steps"] == 2
    assert read_card(later)["data"]["scenes"] == 6
    assert before["validation"] == card["validation"]


def test_batch_norms_take_the_statistics_of_the_batches():
    torch.manual_seed(2)
    model = YOLOv5s(1)
    batches = [(torch.randint(0, 255, (2, 3, 64, 64), dtype=torch.uint8), None) for _ in range(2)]
    measure_batch_norm(model, batches)
    first = model.stage2[0]
    assert not model.training and first.bn.momentum == pytest.approx(0.03)
    with torch.no_grad():
        outputs = [first.conv(network_input(images)) for images, _ in batches]
    mean = torch.stack([x.mean((0, 2, 3)) for x in outputs]).mean(0)
    variance = torch.stack([x.var((0, 2, 3)) for x in outputs]).mean(0)
    torch.testing.assert_close(first.bn.running_mean, mean, rtol=0.02, atol=0.005)
    torch.testing.assert_close(first.bn.running_var, variance, rtol=0.05, atol=1e-4)


def test_metrics_of_each_arrangement_stand_beside_those_of_all():
    data = [
        replace(scene(i), arrangement=kind) for i, kind in enumerate(("stacked", "", "stacked"))
    ]
    metrics = measure(YOLOv5s(1), data)
    assert metrics["stacked"].keys() == {"scenes", "map50", "map50_95", "recall"}
    assert metrics["stacked"]["scenes"] == 2 and "scattered" not in metrics


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("phases: []", "missing"),
        ("phases: 3", "not a valid detector training config"),
        ("[", "not a valid detector training"),
    ],
)
def test_malformed_training_config_is_one_line(tmp_path, text, complaint):
    path = tmp_path / "training.yaml"
    path.write_text(text)
    with pytest.raises(DetectorTrainingError, match=complaint) as caught:
        DetectorTrainingConfig.load(path)
    assert "\n" not in str(caught.value)


def test_config_of_the_package_loads():
    config = DetectorTrainingConfig.load()
    assert config.epochs == sum(p.epochs for p in config.phases) > 0
    assert config.phases[-1].zoom == 1.0  # ends at the resolution that the detector sees
