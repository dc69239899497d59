"""Evaluation: what counts as right, calibration, lifts of held-out grasps, the page it writes."""

import json
import shutil

import cv2
import numpy as np
import pytest
import tifffile

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.generate import CROP_PX, LOOKS, generate_dataset
from iwgnet_grasp.data.grasp_rectangle import QUALITY, THETA, Grasp
from iwgnet_grasp.data.jacquard import find_jacquard, format_grasps
from iwgnet_grasp.data.labels import label_maps
from iwgnet_grasp.networks import create_network
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.grasp_network import WIDTH_REFERENCE_PX
from iwgnet_grasp.networks.weights import MODELS, WeightsError, save_weights
from iwgnet_grasp.report.learning import as_markdown, write_report
from iwgnet_grasp.training.comparison import compare_networks, lift_score
from iwgnet_grasp.training.detector_evaluation import evaluate_detector
from iwgnet_grasp.training.evaluation import compare, score, score_by, trained_networks
from iwgnet_grasp.training.held_out import load_held_out
from iwgnet_grasp.training.rectangle_metric import hit
from iwgnet_grasp.training.reliability import reliability
from iwgnet_grasp.trials.held_out_lifts import OBJECTS_OF_A_LOOK, choose_objects, in_view, lift_all

TRUTH = np.array([[100, 100, 0.2, 60, 30, 0.8], [40, 40, 1.5, 50, 25, 0.4]], np.float32)


def grasp(row, **changed):
    x, y, theta, opening, _, quality = (float(v) for v in row)
    return Grasp(x, y, theta, opening, quality)._replace(**changed)


# What counts as right --------------------------------------------------------------------------


def test_a_grasp_hits_the_nearest_of_the_labels_it_matches():
    both = np.array([[100, 100, 0.2, 60, 30, 0.8], [108, 100, 0.2, 60, 30, 0.3]], np.float32)
    assert hit(grasp(both[0], x_px=102), both)[QUALITY] == pytest.approx(0.8)
    assert hit(grasp(both[0], x_px=106), both)[QUALITY] == pytest.approx(0.3)
    turned = both.copy()
    turned[1, THETA] += 1.0  # nearer, but across
    assert hit(grasp(both[0], x_px=106), turned)[QUALITY] == pytest.approx(0.8)
    assert hit(grasp(both[0], x_px=170), both) is None


def test_errors_are_those_of_the_first_grasp_to_the_label_it_hits():
    first = grasp(TRUTH[0], width_px=66, theta_rad=0.2 + np.radians(10), quality=0.9)
    right = compare("a", "rod", "stacked", [first, grasp(TRUTH[1])], TRUTH)
    assert right.right and right.right_of_five
    assert right.width_error_px == pytest.approx(6, abs=1e-3)
    assert right.angle_error_deg == pytest.approx(10, abs=1e-3)
    assert (right.quality, right.predicted_quality) == (pytest.approx(0.8), 0.9)
    wrong = compare("b", "rod", "scattered", [grasp(TRUTH[0], x_px=170), grasp(TRUTH[1])], TRUTH)
    assert not wrong.right and wrong.right_of_five and wrong.width_error_px is None
    none = compare("c", "bolt", "stacked", [], TRUTH[1:])
    assert not none.right and not none.right_of_five and none.predicted_quality == 0

    total = score([right, wrong, none])
    assert total.top1 == pytest.approx(1 / 3) and total.top5 == pytest.approx(2 / 3)
    assert (total.good_objects, total.top1_good) == (2, 0.5)  # c's only label is worth 0.4
    assert total.relative_quality == pytest.approx(1 / 3)
    assert total.width_error_px == pytest.approx(6, abs=1e-3)
    assert {k: s.objects for k, s in score_by([right, wrong, none], "family").items()} == {
        "bolt": 1,
        "rod": 2,
    }
    assert np.isnan(score([]).top1)


def test_labels_drawn_and_decoded_are_right():
    maps = label_maps(TRUTH, 160, 160)
    found = compare("a", "", "", decode_grasps(maps.q, maps.cos, maps.sin, maps.width), TRUTH)
    assert found.right and found.width_error_px < 1 and found.angle_error_deg < 1


# Calibration -----------------------------------------------------------------------------------


def test_a_quality_that_is_the_chance_of_success_is_calibrated():
    rng = np.random.default_rng(0)
    quality = rng.uniform(0, 1, 20000)
    success = rng.random(quality.size) < quality
    assert reliability(quality, success).error < 0.02
    boast = reliability(np.sqrt(quality), success)  # says sqrt(p) where p is true
    # Mean of sqrt(p) - p over [0, 1].
    assert boast.error == pytest.approx(2 / 3 - 1 / 2, abs=0.02)
    assert all(b.predicted > b.observed for b in boast.bins)


def test_calibration_error_of_known_bins():
    result = reliability([0.85, 0.85, 0.85, 0.85, 0.05], [1, 1, 0, 0, 0])
    assert result.error == pytest.approx(0.8 * 0.35 + 0.2 * 0.05)
    assert [b.count for b in result.bins] == [1, 4]
    assert reliability([1.0], [1]).error == 0  # the last bin holds its upper end
    assert np.isnan(reliability([], []).error)
    with pytest.raises(ValueError, match="predictions"):
        reliability([0.5], [])


# Which objects are lifted ----------------------------------------------------------------------


def test_objects_to_lift_are_few_of_many_piles_and_always_the_same():
    names = [f"{part}_{scene:06d}" for scene in range(60) for part in range(9)]
    chosen = choose_objects(names, 40, seed=3)
    assert chosen == choose_objects(names[::-1], 40, seed=3) != choose_objects(names, 40, seed=4)
    assert len(chosen) == len(set(chosen)) == 40 and set(chosen) <= set(names)
    scenes = [int(name.partition("_")[2]) for name in chosen]
    assert max(scenes.count(s) for s in scenes) <= OBJECTS_OF_A_LOOK
    assert len(set(scenes)) == len({s // LOOKS for s in scenes}) == 8  # one look of a pile
    assert len(choose_objects(names[:4], 100, seed=0)) == 4


def test_lifts_that_were_not_tried_do_not_count():
    predictions = [compare(name, "", "", [grasp(TRUTH[0])], TRUTH) for name in "abcd"]
    result = lift_score(predictions, {"a": "lifted", "b": "slipped", "c": "lifted"})
    assert (result["tried"], result["lifted"]) == (3, 2)
    assert result["outcomes"] == {"lifted": 2, "slipped": 1}
    assert result["quality"]["error"] == pytest.approx(0.8 - 2 / 3, abs=1e-6)


# On data ---------------------------------------------------------------------------------------


def bars(root, count):
    """Level bars on a table, one a scene, grasped across in their middle."""
    for i in range(count):
        folder = root / f"{i:06d}"
        folder.mkdir(parents=True)
        depth = np.full((CROP_PX, CROP_PX), 0.6, np.float32)
        depth[145:155, 100:200] = 0.58
        tifffile.imwrite(folder / f"0_{i:06d}_stereo_depth.tiff", depth)
        row = np.array([[150, 150, np.pi / 2, 40, 22, 1]])
        (folder / f"0_{i:06d}_grasps.txt").write_bytes(format_grasps(row).encode())
    return root


def untrained(folder, name, **card):
    card = {"network": name, "input_px": 96, "width_reference_px": WIDTH_REFERENCE_PX} | card
    return str(save_weights(create_network(name), folder / f"{name}.safetensors", card))


def test_networks_are_found_in_the_order_of_their_names_list(tmp_path):
    for name in ("ggcnn2", "iwgnet", "ggcnn"):
        untrained(tmp_path, name)
    (tmp_path / "other.safetensors").write_bytes(b"")
    (tmp_path / "other.json").write_text('{"network": "yolov5s"}')
    names = [name.rpartition("/")[2] for name in trained_networks(tmp_path)]
    assert names == ["iwgnet", "ggcnn", "ggcnn2"]


def test_bad_input_is_named_in_one_line_and_the_rest_goes_on(tmp_path, caplog):
    data, empty = bars(tmp_path / "bars", 5), tmp_path / "empty"
    empty.mkdir()
    tiff = data / "000000" / "0_000000_stereo_depth.tiff"
    tiff.write_bytes(tiff.read_bytes()[:1000])
    (data / "000001" / "0_000001_grasps.txt").write_text("150;abc;90;40;22\r\n")
    (data / "000002" / "0_000002_stereo_depth.tiff").unlink()
    good = untrained(tmp_path / "models", "ggcnn")
    other = untrained(tmp_path / "other", "ggcnn2")
    card = (tmp_path / "other" / "ggcnn2.json").read_text().replace("ggcnn2", "iwgnet")
    (tmp_path / "other" / "ggcnn2.json").write_text(card)

    result = compare_networks([good, other], [data, empty], tmp_path / "out", progress=False)
    assert [n["weights"] for n in result["networks"]] == ["ggcnn"]
    assert result["networks"][0]["sets"]["bars"]["score"]["objects"] == 2
    said = [record.getMessage() for record in caplog.records]
    for words in ("0_000000_stereo_depth.tiff", "0_000001_grasps.txt:1", "no such depth image"):
        assert sum(words in line for line in said) == 1
    assert any(str(empty) in line for line in said)
    assert any("holds weights of 'ggcnn2', not of 'iwgnet'" in line for line in said)
    assert not any("\n" in line for line in said)

    with pytest.raises(WeightsError, match="ggcnn2"):
        compare_networks([other], [data], tmp_path / "out", progress=False)
    with pytest.raises(DataError, match="empty"):
        compare_networks([good], [empty], tmp_path / "out", progress=False)


def test_lifts_need_a_set_that_can_be_made_again(tmp_path, caplog):
    good = untrained(tmp_path / "models", "ggcnn")
    data = bars(tmp_path / "bars", 2)
    result = compare_networks([good], [data], tmp_path / "out", lifts=2, progress=False)
    assert result["networks"][0]["sets"]["bars"]["lifts"]["tried"] == 0
    assert "not made by 'iwgnet dataset'" in caplog.text


@pytest.fixture(scope="module")
def rods(tmp_path_factory):
    out = tmp_path_factory.mktemp("rods")
    generate_dataset(LOOKS, 6, out, ["connecting_rod"], 1, quiet=True, lift_check=0)
    return out


def test_a_set_tells_family_and_arrangement_of_its_objects(rods):
    held_out = load_held_out(rods)
    assert set(held_out.families) == {"connecting_rod"}
    assert set(held_out.arrangements) <= {"scattered", "stacked"}
    assert len(load_held_out(rods, limit=2).views) == 2


def test_the_shipped_detector_finds_the_rods(rods, tmp_path):
    data = tmp_path / "rods"
    shutil.copytree(rods / "detector", data / "detector")
    weights = MODELS / "yolov5s.safetensors"
    whole = evaluate_detector(weights, data)
    assert (whole["scenes"], whole["left_out"]) == (LOOKS, [])
    assert 0.5 < whole["map50_95"] <= whole["map50"] and whole["map50"] > 0.9
    assert sum(part["scenes"] for part in whole["arrangements"].values()) == LOOKS
    broken = data / "detector" / "images" / "000001.png"
    broken.write_bytes(broken.read_bytes()[:100])
    rest = evaluate_detector(weights, data)
    assert (rest["scenes"], rest["left_out"]) == (LOOKS - 1, [broken])
    (data / "detector" / "annotations.json").write_text("[]")
    with pytest.raises(DataError, match="not COCO annotations"):
        evaluate_detector(weights, data)


def test_lifts_tell_good_grasps_from_bad_ones_and_are_not_repeated(rods, tmp_path):
    """The best labels lift, the same grasps beside the part do not."""
    samples = {s.name: s for s in find_jacquard(rods)}
    generator = json.loads((rods / "dataset.json").read_text())
    names = choose_objects(sorted(samples), 3, seed=0)
    good, bad = {}, {}
    for name in names:
        rows = samples[name].rectangles()
        best = grasp(rows[rows[:, QUALITY].argmax()])
        assert best.quality > 0.5
        good[name] = in_view(best, CROP_PX)
        bad[name] = good[name]._replace(x_px=good[name].x_px + 120)
    grasps = {name: [good[name], bad[name]] for name in names}
    kept = tmp_path / "lifts.jsonl"
    done = []
    outcomes = lift_all(rods, generator, grasps, kept, progress=done.append)
    assert sum(done) == len(outcomes) == 2 * len(names)
    assert [outcomes[n, good[n]]["outcome"] for n in names] == ["lifted"] * len(names)
    assert all(outcomes[n, bad[n]]["outcome"] != "lifted" for n in names)

    stored = kept.read_text()
    kept.write_text(stored + '{"key": "half a li')  # as a killed run leaves it
    assert lift_all(rods, generator, grasps, kept) == outcomes
    assert kept.read_text() == stored + '{"key": "half a li'  # nothing was tried again
    lost = stored.splitlines(keepends=True)[-1]
    kept.write_text(stored.removesuffix(lost) + lost[:20])
    assert lift_all(rods, generator, grasps, kept) == outcomes
    assert kept.read_text().endswith("\n" + lost)  # the same lift, to the bit


def test_objects_that_do_not_come_out_as_stored_are_not_lifted(rods, tmp_path):
    other = tmp_path / "rods"
    shutil.copytree(rods, other)
    name = sorted(s.name for s in find_jacquard(other))[0]
    path = other / name.partition("_")[2] / f"{name}_mask.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(path), np.roll(mask, 3, axis=1))
    generator = json.loads((other / "dataset.json").read_text())
    wanted = {name: [Grasp(150.0, 150.0, 0.0, 30.0, 0.5)]}
    assert lift_all(other, generator, wanted, tmp_path / "lifts.jsonl") == {}
    path.unlink()
    assert lift_all(other, generator, wanted, tmp_path / "lifts.jsonl") == {}


def test_the_page_names_every_network_and_set(rods, tmp_path):
    models = tmp_path / "models"
    names = [untrained(models, name) for name in ("iwgnet", "ggcnn")]
    data = [rods, bars(tmp_path / "bars", 2)]
    comparison = compare_networks(names, data, tmp_path, progress=False)
    paths = write_report(comparison, tmp_path / "out", "scripts/iwgnet evaluate")
    assert sorted(p.suffix for p in paths) == [".json", ".md", ".png", ".png"]
    stored = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert stored["networks"] == json.loads(json.dumps(comparison["networks"]))
    for path in paths[2:]:
        assert path.stat().st_size < 100_000
        assert cv2.imread(str(path)).std() > 5
    page = as_markdown(comparison, "scripts/iwgnet evaluate", "pictures")
    tables = [line for line in page.splitlines() if line.startswith(("| iwgnet |", "| ggcnn |"))]
    assert len(tables) == 4  # two networks on two sets
    for words in ("`bars`", "connecting_rod", "pictures/learning_success.png", "392,608"):
        assert words in page
