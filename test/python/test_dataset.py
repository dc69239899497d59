"""Generated data: layout, labels that fit the images, the same bits on any number of workers."""

import filecmp
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
import trimesh
import yaml
from pycocotools import mask as coco_mask
from typer.testing import CliRunner

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.generate import (
    CONFIG,
    CROP_PX,
    SceneMaker,
    as_detected,
    bounding_box,
    generate_dataset,
)
from iwgnet_grasp.data.grasp_rectangle import JAW, OPENING, QUALITY, THETA, X, Y
from iwgnet_grasp.data.images import read_depth
from iwgnet_grasp.data.jacquard import find_jacquard
from iwgnet_grasp.data.lift_check import plan_check, require_stored, summary
from iwgnet_grasp.data.mask_dataset import find_masks, load_mask_views
from iwgnet_grasp.files import sole_writer
from iwgnet_grasp.parts.library import add_to_library, part_from_mesh
from iwgnet_grasp.perception.merged_depth import crop_window

ROOT = Path(__file__).resolve().parents[2]
SCENES, SEED = 4, 8  # two piles of three looks, the second cut short
LIFTS = 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("set")
    rods = ["connecting_rod"]
    scenes, crops = generate_dataset(SCENES, SEED, out, rods, 1, quiet=True, lift_check=LIFTS)
    assert scenes == SCENES and crops > 0
    return out


def files(root: Path) -> list[str]:
    """All files of a set but those that tell of the run."""
    names = (str(p.relative_to(root)) for p in root.rglob("*") if p.is_file())
    return sorted(set(names) - {"lifts.json", "dataset.json"})


def command(out: Path, *arguments: str, limit_bytes: int = 0) -> subprocess.Popen:
    """`iwgnet dataset` of the same set; limit_bytes: the largest file that it may write, the
    system's stand-in for a full disk."""

    def limit():
        if limit_bytes:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))

    base = ["dataset", "--scenes", str(SCENES), "--seed", str(SEED), "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "iwgnet_grasp.cli", *base, "--lift-check", "0", *arguments],
        env=os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{os.environ.get('PYTHONPATH', '')}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limit,
    )


def assert_same_set(one: Path, other: Path) -> None:
    assert files(one) == files(other)
    _, differ, errors = filecmp.cmpfiles(one, other, files(one), shallow=False)
    assert differ == [] and errors == []


def test_every_crop_has_all_its_files_in_the_agreed_size(dataset):
    samples = find_jacquard(dataset)
    assert samples
    for sample in samples:
        color = cv2.imread(f"{sample.stem}_RGB.png")
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE)
        assert color.shape == (CROP_PX, CROP_PX, 3)
        assert mask.shape == (CROP_PX, CROP_PX) and mask.any()
        for kind in ("perfect", "stereo"):
            depth = read_depth(Path(f"{sample.stem}_{kind}_depth.tiff"))
            assert depth.shape == (CROP_PX, CROP_PX)
            known = depth[depth != -1]
            assert known.min() > 0.4 and known.max() < 0.8


def test_grasps_lie_on_their_object_and_fit_the_gripper(dataset):
    for sample in find_jacquard(dataset):
        rows = sample.rectangles()
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE) > 0
        near = cv2.dilate(mask.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
        assert ((rows[:, QUALITY] > 0) & (rows[:, QUALITY] <= 1)).all()
        # 85 mm at about 0.55 m and fx 640 px.
        assert (rows[:, OPENING] < 110).all() and (rows[:, JAW] > 10).all()
        columns, lines = np.round(rows[:, [X, Y]]).astype(int).T
        assert near[lines, columns].all()


def test_the_object_rises_over_the_table_in_both_depths(dataset):
    for sample in find_jacquard(dataset):
        mask = cv2.imread(f"{sample.stem}_mask.png", cv2.IMREAD_GRAYSCALE) > 0
        for kind in ("perfect", "stereo"):
            depth = read_depth(Path(f"{sample.stem}_{kind}_depth.tiff"))
            table = np.median(depth[~mask & (depth > 0)])
            assert np.median(depth[mask & (depth > 0)]) < table - 0.005


def test_crops_show_what_the_whole_image_shows():
    """Images are rendered around the parts only."""
    maker = SceneMaker(["connecting_rod"], yaml.safe_load(CONFIG.read_text()), detector=False)
    crops = 0
    for scene in maker.pile(SEED, 0):
        whole = maker.cell.ideal_depth()
        assert np.isnan(scene.ideal).sum() > np.isnan(whole).sum()
        for o in scene.objects:
            window = crop_window(scene.ideal, scene.empty_ideal, o.detected, CROP_PX)
            rows, columns = (slice(first, first + CROP_PX) for first in (window.y, window.x))
            assert np.array_equal(scene.ideal[rows, columns], whole[rows, columns], equal_nan=True)
            crops += 1
    assert crops > 0


def test_boxes_are_those_of_their_masks(dataset):
    text = json.loads((dataset / "detector" / "annotations.json").read_text())
    assert text["categories"] == [{"id": 1, "name": "connecting_rod"}]
    assert len(text["images"]) == SCENES
    assert len({a["id"] for a in text["annotations"]}) == len(text["annotations"]) > 0
    for image in text["images"]:
        picture = cv2.imread(str(dataset / "detector" / "images" / image["file_name"]))
        assert picture.shape == (image["height"], image["width"], 3)
    for entry in text["annotations"]:
        mask = coco_mask.decode(entry["segmentation"])
        assert mask.sum() == entry["area"]
        assert list(bounding_box(mask > 0)) == entry["bbox"]


def test_every_part_in_sight_has_its_mask_and_only_those_with_grasps_are_samples(dataset):
    text = json.loads((dataset / "detector" / "annotations.json").read_text())
    seen = sorted(f"{a['part']}_{a['image_id']:06d}" for a in text["annotations"])
    assert sorted(stem.name for stem in find_masks(dataset)) == seen
    assert len(load_mask_views([dataset])) == len(seen) >= len(find_jacquard(dataset)) > 0


def test_other_projects_loaders_find_what_they_expect(dataset):
    """The facts of the layout that the loaders of GG-CNN and GR-ConvNet rely on: a folder level,
    names by replacing grasps.txt, depth by imageio as 2-D float32, five numbers a line and one
    character at its end, theta in degrees against the sense of Cornell's."""
    found = sorted(dataset.glob("*/*_grasps.txt"))
    ours = {s.stem.name: s.rectangles() for s in find_jacquard(dataset)}
    assert len(found) == len(ours) > 0
    for path in found:
        for kind in ("perfect_depth.tiff", "stereo_depth.tiff"):
            depth = imageio.imread(str(path).replace("grasps.txt", kind))
            assert depth.shape == (CROP_PX, CROP_PX) and depth.dtype == np.float32
            assert np.isfinite(depth).all() and (depth[depth < 0] == -1).all()
        color = imageio.imread(str(path).replace("grasps.txt", "RGB.png"))
        assert color.shape == (CROP_PX, CROP_PX, 3) and color.dtype == np.uint8
        with path.open() as lines:
            rows = np.array([[float(v) for v in line[:-1].split(";")] for line in lines])
        assert path.read_bytes().count(b"\r\n") == len(rows)
        expected = ours[path.name.removesuffix("_grasps.txt")]
        np.testing.assert_allclose(rows[:, [0, 1, 3, 4]], expected[:, [X, Y, OPENING, JAW]], 1e-6)
        turned = np.remainder(np.radians(-rows[:, 2]) - expected[:, THETA] + 1e-3, np.pi)
        np.testing.assert_allclose(turned, 1e-3, atol=1e-4)


def test_going_on_gives_the_same_set_as_one_run_on_two_workers(dataset, tmp_path):
    generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
    generate_dataset(SCENES, SEED, tmp_path, ["connecting_rod"], 2, quiet=True)
    assert_same_set(tmp_path, dataset)


def test_a_set_without_colour_holds_the_same_depth_and_grasps(dataset, tmp_path):
    generate_dataset(SCENES, SEED, tmp_path, ["connecting_rod"], 1, quiet=True, detector=False)
    left_out = re.compile(r"detector/|.*_RGB\.png")
    assert files(tmp_path) == [name for name in files(dataset) if not left_out.match(name)]
    _, differ, errors = filecmp.cmpfiles(dataset, tmp_path, files(tmp_path), shallow=False)
    assert differ == [] and errors == []


def test_a_killed_run_leaves_whole_scenes_and_goes_on(dataset, tmp_path):
    run = command(tmp_path, "--workers", "1")
    try:
        limit = time.monotonic() + 120
        while not any(tmp_path.glob("[0-9]*")) and time.monotonic() < limit:
            time.sleep(0.01)
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    assert 0 < len(list(tmp_path.glob("[0-9]*"))) <= SCENES
    for name in files(tmp_path):
        if "/." not in f"/{name}":  # what begins with a dot is no reader's business
            assert (tmp_path / name).read_bytes() == (dataset / name).read_bytes()
    generate_dataset(SCENES, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
    assert_same_set(tmp_path, dataset)


def test_a_full_disk_is_one_line_and_leaves_no_half_scene(dataset, tmp_path):
    largest = max((dataset / name).stat().st_size for name in files(dataset))
    run = command(tmp_path, "--workers", "1", limit_bytes=largest // 2)
    _, said = run.communicate(timeout=120)
    assert run.returncode == 2
    assert len(said.strip().splitlines()) == 1 and "make room" in said
    assert not list(tmp_path.glob("[0-9]*")) and not list(tmp_path.rglob("*.part"))
    assert json.loads((tmp_path / "detector" / "annotations.json").read_text())["images"] == []


def test_an_address_without_a_cluster_is_one_line(tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        run = command(tmp_path, "--address", address)
        _, said = run.communicate(timeout=120)
    assert run.returncode == 2
    assert len(said.strip().splitlines()) == 1 and f"nobody answers at {address}" in said


RAY_HEAD = """
import ray, sys
ray.init(num_cpus=1, include_dashboard=False)
print(ray.get_runtime_context().gcs_address, flush=True)
sys.stdin.read()
"""


def test_a_ray_cluster_makes_the_same_set(dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    head = subprocess.Popen(
        [sys.executable, "-c", RAY_HEAD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        run = command(tmp_path, "--address", head.stdout.readline().strip())
        _, said = run.communicate(timeout=300)
    finally:
        head.communicate("")
    assert run.returncode == 0, said
    assert_same_set(tmp_path, dataset)


def test_labels_are_lifted_and_the_agreement_is_kept(dataset):
    lifts = json.loads((dataset / "lifts.json").read_text())
    entries = [entry for scene in lifts.values() for entry in scene]
    assert len(entries) >= LIFTS
    for number, scene in lifts.items():
        for entry in scene:
            stem = f"{entry['object']}_{int(number):06d}"
            lines = (dataset / f"{int(number):06d}" / f"{stem}_quality.txt").read_text().split()
            assert float(lines[entry["grasp"]]) == pytest.approx(entry["quality"], abs=1e-4)
    assert json.loads((dataset / "dataset.json").read_text())["lift_check"] == summary(entries)
    # Scattered and stacked rods with labels from geometry: most hold by friction.
    executed = [e for e in entries if e["outcome"] not in ("infeasible", "unreachable", "no_plan")]
    assert sum(e["outcome"] == "lifted" for e in executed) >= 0.7 * len(executed) > 0


def test_lifts_of_labels_that_are_not_those_on_disk_are_refused(dataset):
    lifts = json.loads((dataset / "lifts.json").read_text())
    number, entries = next((int(n), e) for n, e in lifts.items() if e)
    require_stored(dataset, number, entries)
    other = {**entries[0], "quality": entries[0]["quality"] / 2}
    with pytest.raises(DataError, match="does not come out again as it is stored"):
        require_stored(dataset, number, [other])
    with pytest.raises(DataError, match="does not come out again"):
        require_stored(dataset, number, [{**entries[0], "object": 99}])


@pytest.mark.parametrize("scenes, labels", [(1, 100), (4, 4), (200, 100), (1500, 300), (7, 1)])
def test_a_lift_check_tries_as_many_labels_as_asked_for(scenes, labels):
    piles, per_scene = plan_check(scenes, 3, labels)
    tried = per_scene * sum(min(3, scenes - 3 * pile) for pile in piles)
    assert len(set(piles)) == len(piles) and all(0 <= 3 * pile < scenes for pile in piles)
    assert labels <= tried <= 2 * labels + 3


def test_the_agreement_is_told_by_quality():
    lifts = [{"quality": q, "outcome": o} for q, o in ((0.05, "slipped"), (0.9, "lifted"))]
    report = summary([*lifts, {"quality": 1.0, "outcome": "lifted"}])
    assert report["labels"] == 3 and report["lifted"] == pytest.approx(2 / 3, abs=1e-4)
    assert report["outcomes"] == {"lifted": 2, "slipped": 1}
    assert [(b["quality"], b["labels"], b["lifted"]) for b in report["by_quality"]] == [
        ([0.0, 0.1], 1, 0.0),
        ([0.8, 1.0], 2, 1.0),
    ]


def test_a_mesh_of_ones_own_is_labelled_like_any_part(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    for name in ("config", "urdf"):
        (package / name).symlink_to(ROOT / name)
    (package / "assets").mkdir()
    (package / "assets" / "robot").symlink_to(ROOT / "assets" / "robot")
    trimesh.creation.annulus(14, 22, 60).export(tmp_path / "sleeve.stl")
    part = part_from_mesh(tmp_path / "sleeve.stl", "sleeve", "mm", density=2700)
    add_to_library(part, package / "assets" / "parts")
    assert len(part.pieces) > 1  # a tube is not convex
    scenes, crops = generate_dataset(
        3, 0, tmp_path / "set", ["sleeve"], 1, quiet=True, package_dir=package, detector=False
    )
    assert scenes == 3 and crops > 0
    rows = np.concatenate([s.rectangles() for s in find_jacquard(tmp_path / "set")])
    # Outside 44 mm across and at most 60 mm long, seen at some 0.55 m with fx 640 px.
    assert (rows[:, OPENING] > 40).all() and (rows[:, OPENING] < 85).all()


def test_a_folder_with_another_set_is_refused(dataset):
    with pytest.raises(DataError, match="another"):
        generate_dataset(SCENES, SEED + 1, dataset, ["connecting_rod"], 1, quiet=True)


def test_settings_can_be_changed_by_name_and_make_another_set(dataset, tmp_path):
    few = ["scene.parts=[2, 2]", "scene.scattered_share=1.0"]
    generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True, changes=few)
    made = json.loads((tmp_path / "dataset.json").read_text())
    assert made["settings"]["scene"]["parts"] == [2, 2]
    with pytest.raises(DataError, match="another seed, families, parts or settings"):
        generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
    with pytest.raises(DataError, match="did you mean 'parts'"):
        generate_dataset(1, SEED, tmp_path / "x", ["connecting_rod"], 1, changes=["scene.party=3"])


def test_an_unknown_family_is_named_with_the_known_ones(tmp_path):
    with pytest.raises(DataError, match=r"unicorn.*connecting_rod"):
        generate_dataset(1, 0, tmp_path / "set", ["unicorn"], 1, quiet=True)
    assert not (tmp_path / "set").exists()


def test_the_command_says_what_is_wrong_in_one_line(tmp_path):
    import typer

    from iwgnet_grasp.data.generate import generate

    app = typer.Typer()
    app.command()(generate)
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--families", "unicorn"])
    assert result.exit_code == 2
    assert "unicorn" in result.output and "Traceback" not in result.output


def test_detected_boxes_stay_near_the_true_one_and_in_the_image():
    rng = np.random.default_rng(0)
    crop = {"box_shift_px": 4.0, "box_scale": 0.08}
    for _ in range(200):
        box = as_detected(np.array([2, 700, 150, 99]), (800, 1280, 3), crop, rng)
        assert box.x >= 0 and box.y >= 0
        assert box.x + box.width <= 1280 and box.y + box.height <= 800
        assert abs(box.x - 2) <= 11 and abs(box.width - 150) <= 24


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    with (
        sole_writer(tmp_path, DataError),
        pytest.raises(DataError, match="another run"),
    ):
        generate_dataset(1, SEED, tmp_path, ["connecting_rod"], 1, quiet=True)
