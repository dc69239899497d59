"""Data sets from the simulator: `python -m iwgnet_grasp.data.generate --scenes 100 --out DIR`.

    OUT/dataset.json                       what was made, with its seed and settings
    OUT/<scene %06d>/<object>_<scene>_...  one crop an object, in Jacquard's layout (data.jacquard)
    OUT/detector/images/<scene>.png        the colour image
    OUT/detector/annotations.json          COCO: boxes and run-length masks
    OUT/lifts.json                         labels carried out in Bullet (data.lift_check)

Both depths of a crop are the merged depth of the paper (section 4.2): the object's box pasted into
the depth of the empty table, once noise-free (perfect) and once as the D455 measures it (stereo).
Scenes come in piles of LOOKS: the settled parts, then looks at the same table half cleared, as a
robot sees it, each with its own light, materials and camera. A pile is a function of (seed, its
number) alone and a scene appears whole or not at all, so that a run can be stopped and gone on
with, on any number of workers.
"""

from __future__ import annotations

import copy
import io
import json
import shutil
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import tifffile
import typer
import yaml
from isal import isal_zlib

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import COLUMNS, JAW, OPENING, QUALITY, THETA, X, Y
from iwgnet_grasp.data.jacquard import format_grasps
from iwgnet_grasp.data.lift_check import as_text, plan_check, require_stored, summary
from iwgnet_grasp.data.scene_pool import (
    ProcessPool,
    RayPool,
    SceneKind,
    library_digest,
    open_pool,
    results,
)
from iwgnet_grasp.files import disk_error, sole_writer, write_whole
from iwgnet_grasp.overrides import OverrideError, changed_config, parse_overrides
from iwgnet_grasp.parts.library import PartError, add_to_library, part_from_mesh
from iwgnet_grasp.perception.merged_depth import crop_window
from iwgnet_grasp.perception.types import Box, Window
from iwgnet_grasp.progress import interrupt_on, progress_bar

PACKAGE = Path(__file__).resolve().parents[3]
CONFIG = PACKAGE / "config" / "dataset.yaml"
CROP_PX = 300  # side of a crop: the longest part is about 170 px at 0.6 m
DEPTH_STEP = 2.0**-15  # m: 31 um, far below the noise; rounded floats compress well
LOOKS = 3  # scenes of one pile
_AROUND_PX = CROP_PX // 2 + 40  # rendered beside the parts: half a crop, what its box is off by
PILE_ATTEMPTS = 5  # with other draws, when a pile cannot be built


# One scene ------------------------------------------------------------------------------------


def pile_rng(seed: int, pile: int, attempt: int = 0) -> np.random.Generator:
    """The only source of chance of a pile."""
    return np.random.default_rng([seed, pile, attempt])


class SceneMaker:
    """Draws, renders and labels scenes with one simulated cell."""

    def __init__(
        self,
        families: list[str],
        settings: dict,
        package_dir: Path = PACKAGE,
        detector: bool = True,
    ) -> None:
        from iwgnet_grasp import _core  # only here: training machines have no extension

        self.core = _core
        self.families = families
        self.settings = settings
        self.detector = detector  # whether colour images are made
        self.cell = _core.SimulatedCell(str(package_dir))
        self.labeler = _core.GraspLabeler(str(package_dir / "config"))
        self.pose_config = _core.load_grasp_pose_config(str(package_dir / "config"))

    def pile(self, seed: int, pile: int) -> Iterator[Scene]:
        """The LOOKS scenes of a pile. Raises DataError when no attempt can be built."""
        for attempt in range(PILE_ATTEMPTS):
            rng = pile_rng(seed, pile, attempt)
            spec = self.spec(rng)
            try:
                self.cell.build_scene(spec, int(rng.integers(2**62)))
                break
            except self.core.CoreError as error:
                reason = str(error)
        else:
            raise DataError(f"pile {pile} of seed {seed}: {reason}")
        left = list(range(len(self.cell.part_names)))
        slot = 0
        for look in range(LOOKS):
            if look:
                # A few parts go; at least one stays.
                for _ in range(int(rng.integers(1, max(len(left) // LOOKS, 1) + 1))):
                    if len(left) > 1:
                        gone = left.pop(int(rng.integers(len(left))))
                        self.cell.lay_in_tray(gone, slot)
                        slot += 1
                settle = self.settings["scene"]["resettle_time"]
                self.cell.step(round(settle / self.cell.timestep))
            self.dress(rng)
            scene = self.observe(rng)
            scene.arrangement = spec.arrangement.name.lower()
            scene.poses, scene.camera = self.cell.part_poses(), copy.copy(self.cell.camera)
            scene.laid_away = slot
            yield scene

    def spec(self, rng: np.random.Generator) -> Any:
        s = self.settings["scene"]
        count = int(rng.integers(s["parts"][0], s["parts"][1] + 1))
        scattered = rng.random() < s["scattered_share"] and count <= s["scattered_max_parts"]
        kinds = self.core.Arrangement
        return self.core.SceneSpec(
            count=count,
            arrangement=kinds.SCATTERED if scattered else kinds.STACKED,
            families=self.families,
            min_gap=rng.uniform(*s["min_gap"]),
            drop_area=np.full(2, rng.uniform(*s["drop_area"])),
            drop_height=s["drop_height"],
            drop_interval=s["drop_interval"],
            settle_time=s["settle_time"],
        )

    def dress(self, rng: np.random.Generator) -> None:
        """Light, materials and camera."""
        settings, core = self.settings, self.core
        light = settings["light"]
        around, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*light["distance"])
        config = self.cell.config
        x, y = (config.workspace_min + config.workspace_max) / 2
        tint = 1 + light["tint"] * rng.uniform(-1, 1, 3)
        self.cell.set_light(
            core.Light(
                [
                    x + distance * np.cos(around),
                    y + distance * np.sin(around),
                    rng.uniform(*light["height"]),
                ],
                rng.uniform(*light["intensity"]) * tint,
                rng.uniform(*light["ambient"]),
            )
        )
        table = settings["table"]
        albedo = rng.uniform(*table["albedo"], 3)
        if rng.random() < table["grey_share"]:
            albedo = albedo[0] * (1 + 0.05 * rng.uniform(-1, 1, 3))
        self.cell.set_table_material(
            core.Material(
                albedo, 0.0, rng.uniform(*table["roughness"]), rng.uniform(*table["texture"])
            )
        )
        part = settings["part"]
        metal = rng.random() < part["metal_share"]
        if metal:
            base = rng.uniform(*part["metal_albedo"]) * (1 + 0.06 * rng.uniform(-1, 1, 3))
        else:
            base = rng.uniform(*part["paint_albedo"], 3)
        for i in range(len(self.cell.part_names)):
            shade = base * (1 + part["spread"] * rng.uniform(-1, 1))
            self.cell.set_part_material(
                i,
                core.Material(
                    np.clip(shade, 0, 1),
                    rng.uniform(0.6, 1.0) if metal else 0.0,
                    rng.uniform(*part["roughness"]),
                    rng.uniform(*part["texture"]),
                ),
            )
        self.cell.camera = self.camera(rng)

    def camera(self, rng: np.random.Generator) -> Any:
        jitter, factors = self.settings["camera"], self.settings["noise"]
        camera = copy.copy(self.cell.camera)
        T = camera.T_base_color
        turns = [jitter["tilt"], jitter["tilt"], jitter["turn"]] * rng.uniform(-1, 1, 3)
        T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(turns)[0]
        T[:3, 3] += jitter["position"] * rng.uniform(-1, 1, 3)
        camera.T_base_color = T
        zoom = 1 + jitter["focal_length"] * rng.uniform(-1, 1)
        shift = jitter["principal_point"] * rng.uniform(-1, 1, 2)
        for name in ("color", "depth"):
            k = getattr(camera, name)
            k.fx, k.fy = k.fx * zoom, k.fy * zoom
            k.cx, k.cy = k.cx + shift[0], k.cy + shift[1]
            setattr(camera, name, k)
        camera.subpixel_sigma_px *= rng.uniform(*factors["subpixel_sigma"])
        camera.lateral_sigma_px *= rng.uniform(*factors["lateral_sigma"])
        camera.outlier_fraction *= rng.uniform(*factors["outlier_fraction"])
        return camera

    def observe(self, rng: np.random.Generator) -> Scene:
        """Images with and without parts, and the labels."""
        cell = self.cell
        color = cell.color() if self.detector else self.skip_frame()
        camera = cell.camera
        cell.view_around_parts(_AROUND_PX * camera.T_base_color[2, 3] / camera.color.fx)
        ideal, mask = cell.ideal_view()
        stereo = cell.aligned_depth(cell.depth())
        outline_areas = cell.unoccluded_areas()
        labels = self.executable(self.labeler.label(cell, ideal, mask), stereo)
        cell.show_parts(False)
        empty_ideal = cell.ideal_depth()
        empty_stereo = cell.aligned_depth(cell.depth())
        cell.show_parts(True)
        cell.view_around_parts(None)
        objects = []
        for part, family in enumerate(cell.part_families):
            seen = self.visible(mask == part, outline_areas[part])
            if seen is None:
                continue
            rows = np.array(
                [rectangle_row(label) for label in labels if label.part == part], np.float32
            ).reshape(-1, COLUMNS)
            box = bounding_box(seen)
            detected = as_detected(box, ideal.shape, self.settings["crop"], rng)
            objects.append(SceneObject(part, family, seen, box, detected, rows))
        return Scene(color, ideal, empty_ideal, stereo, empty_stereo, objects)

    def skip_frame(self) -> None:
        """Counts as a colour image without being one: the noise of the depth images is drawn by
        the number of images before, so that it is the same with and without colour."""
        whole, small = copy.copy(self.cell.camera), copy.copy(self.cell.camera)
        k = small.color
        k.width = k.height = 8
        small.color = k
        self.cell.camera = small
        self.cell.color()
        self.cell.camera = whole

    def executable(self, labels: list, stereo: np.ndarray) -> list:
        """The labels that can be carried out with what the camera measures, too: a grasp that is
        only free by less than the noise is none."""
        camera, config = self.cell.camera, self.cell.config
        view = camera.color, camera.T_base_color
        heights = self.core.HeightMap(stereo, *view, config)
        return [
            label
            for label in labels
            if self.core.grasp_pose(
                label.rectangle, *view, heights, config, self.pose_config
            ).feasible
        ]

    def visible(self, seen: np.ndarray, outline_area: float) -> np.ndarray | None:
        """The part's mask without crumbs; None when too little of it is seen."""
        crop = self.settings["crop"]
        if np.count_nonzero(seen) < crop["min_pixels"]:
            return None
        x, y, width, height = bounding_box(seen)
        window = seen[y : y + height, x : x + width]
        count, pieces, statistics, _ = cv2.connectedComponentsWithStats(window.astype(np.uint8))
        for i in range(1, count):
            if statistics[i, cv2.CC_STAT_AREA] < crop["min_fragment"]:
                window[pieces == i] = False
        pixels = np.count_nonzero(seen)
        if pixels < crop["min_pixels"] or pixels < crop["min_visible"] * outline_area:
            return None
        return seen


@dataclass
class SceneObject:
    part: int
    family: str
    mask: np.ndarray  # (H, W) bool, what is seen of it
    box: np.ndarray  # (4,) x, y, width, height, px: whole pixels
    detected: Box  # the same as a detector would give it
    rectangles: np.ndarray  # (n, 6) data.grasp_rectangle, full-image px


@dataclass
class Scene:
    """All depths (H, W) float32 m of the colour camera, NaN where there is none."""

    color: np.ndarray | None  # (H, W, 3) uint8 RGB; None without detector
    ideal: np.ndarray
    empty_ideal: np.ndarray
    stereo: np.ndarray
    empty_stereo: np.ndarray
    objects: list[SceneObject]
    arrangement: str = ""  # scattered or stacked
    # How to set the scene up again (lift_check):
    poses: np.ndarray | None = None  # (parts, 4, 4) T_base_part
    camera: Any = None  # _core.CameraConfig
    laid_away: int = 0  # parts that lie in the tray


def rectangle_row(label: Any) -> list[float]:
    """A core GraspLabel as a row of data.grasp_rectangle."""
    row = [0.0] * COLUMNS
    r = label.rectangle
    row[X], row[Y], row[THETA] = r.x_px, r.y_px, r.theta_rad
    row[OPENING], row[JAW], row[QUALITY] = r.width_px, label.jaw_px, r.quality
    return row


def bounding_box(mask: np.ndarray) -> np.ndarray:
    """(4,) x, y, width, height of the smallest box around a mask that is not empty."""
    return np.array(cv2.boundingRect(mask.view(np.uint8)), int)


def as_detected(box: np.ndarray, image_shape: tuple, crop: dict, rng: np.random.Generator) -> Box:
    """A box as a detector would give it: shifted and scaled a little, inside the image."""
    x, y, width, height = box
    u = x + width / 2 + crop["box_shift_px"] * rng.uniform(-1, 1)
    v = y + height / 2 + crop["box_shift_px"] * rng.uniform(-1, 1)
    width, height = np.array([width, height]) * (1 + crop["box_scale"] * rng.uniform(-1, 1, 2))
    rows, columns = image_shape[:2]
    left, top = max(round(u - width / 2), 0), max(round(v - height / 2), 0)
    right, bottom = min(round(u + width / 2), columns), min(round(v + height / 2), rows)
    return Box(left, top, right - left, bottom - top)


# On disk --------------------------------------------------------------------------------------


def encode_scene(scene: Scene, number: int, categories: list[str]) -> dict[str, bytes]:
    """Path in the data set -> content of all files of a scene."""
    files = {}
    if scene.color is not None:
        files[f"detector/images/{number:06d}.png"] = png(scene.color[:, :, ::-1])
    for o in scene.objects:
        window, rows = crop(scene, o)
        cut = slice(window.y, window.y + CROP_PX), slice(window.x, window.x + CROP_PX)
        stem = f"{number:06d}/{o.part}_{number:06d}"
        if scene.color is not None:
            files[f"{stem}_RGB.png"] = png(scene.color[cut][:, :, ::-1])
        files[f"{stem}_stereo_depth.tiff"] = tiff(window.depth)
        files[f"{stem}_mask.png"] = png(o.mask[cut].astype(np.uint8) * 255)
        if len(rows) == 0:
            continue  # readers of Jacquard's layout go by grasps.txt
        perfect = crop_window(scene.ideal, scene.empty_ideal, o.detected, CROP_PX)
        quality = "".join(f"{max(q, 1e-4):.4f}\n" for q in rows[:, QUALITY])
        files[f"{stem}_perfect_depth.tiff"] = tiff(perfect.depth)
        files[f"{stem}_grasps.txt"] = format_grasps(rows).encode()
        files[f"{stem}_quality.txt"] = quality.encode()
    height, width = scene.ideal.shape
    description = {
        "width": width,
        "height": height,
        "arrangement": scene.arrangement,
        "annotations": [annotation(o, categories) for o in scene.objects],
    }
    files[f"{number:06d}/detector.json"] = json.dumps(description).encode()
    return files


def crop(scene: Scene, o: SceneObject) -> tuple[Window, np.ndarray]:
    """The crop of an object from the D455's depth, and its rectangles whose centre lies in it,
    (n, 6) data.grasp_rectangle in px of the crop."""
    window = crop_window(scene.stereo, scene.empty_stereo, o.detected, CROP_PX)
    rows = o.rectangles.copy()
    rows[:, X] -= window.x
    rows[:, Y] -= window.y
    return window, rows[((rows[:, [X, Y]] >= 0) & (rows[:, [X, Y]] <= CROP_PX - 1)).all(axis=1)]


def write_scene(files: dict[str, bytes], number: int, out: Path) -> None:
    """Writes the files of encode_scene(); the scene's folder is renamed into place when everything
    else is written. OSError when there is no room."""
    name = f"{number:06d}"
    folder = out / f".{name}.part"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path, content in files.items():
        inside = path.removeprefix(f"{name}/")
        if inside != path:
            (folder / inside).write_bytes(content)
        else:
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            write_whole(out / path, content)
    folder.rename(out / name)


def annotation(o: SceneObject, categories: list[str]) -> dict:
    """COCO, without the ids that depend on the other scenes."""
    from pycocotools import mask as coco_mask

    # Column by column, as COCO counts; NumPy's own way there takes five times as long.
    code = coco_mask.encode(cv2.transpose(o.mask.view(np.uint8)).T)
    return {
        "category_id": categories.index(o.family) + 1,
        "part": o.part,  # the <object> of its crop's name
        "bbox": [int(v) for v in o.box],
        "area": int(np.count_nonzero(o.mask)),
        "segmentation": {"size": list(code["size"]), "counts": code["counts"].decode("ascii")},
        "iscrowd": 0,
    }


def png(image: np.ndarray) -> bytes:
    """PNG of an image, BGR or grey."""
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if image.ndim == 3:  # noise repeats nothing: without the search smaller and faster
        parameters += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    return cv2.imencode(".png", image, parameters)[1].tobytes()


def tiff(depth: np.ndarray) -> bytes:
    """TIFF float32 m; -1 where there is no depth (Jacquard's mark). Deflated: the readers of other
    projects (imageio, tifffile) know LZW only with a codec package."""
    rounded = np.round(depth / DEPTH_STEP) * DEPTH_STEP
    stored = np.where(np.isfinite(depth), rounded, -1).astype(np.float32)
    stream = io.BytesIO()
    # ISA-L takes a quarter of zlib's time for the same stream.
    tifffile.imwrite(
        stream,
        iter([isal_zlib.compress(stored, 1)]),
        shape=stored.shape,
        dtype=stored.dtype,
        rowsperstrip=len(stored),
        compression="zlib",
        metadata=None,
    )
    return stream.getvalue()


def write_annotations(out: Path, categories: list[str], detector: bool) -> tuple[int, int]:
    """Gathers the scenes' annotations where there are images for them; returns the numbers of
    scenes and of crops."""
    images, annotations, crops = [], [], 0
    for file in sorted(out.glob("[0-9]*/detector.json")):
        number = int(file.parent.name)
        scene = json.loads(file.read_text())
        images.append(
            {
                "id": number,
                "file_name": f"{number:06d}.png",
                "width": scene["width"],
                "height": scene["height"],
                "arrangement": scene.get("arrangement", ""),
            }
        )
        for entry in scene["annotations"]:
            annotations.append({"id": len(annotations) + 1, "image_id": number, **entry})
        crops += sum(1 for _ in file.parent.glob("*_grasps.txt"))
    text = {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(categories)],
    }
    if detector:
        write_whole(out / "detector" / "annotations.json", json.dumps(text).encode())
    return len(images), crops


# The run --------------------------------------------------------------------------------------


def open_dataset(out: Path, description: dict) -> dict:
    """Begins a set or goes on with it; returns the content of dataset.json. DataError when the
    folder holds another set."""
    path = out / "dataset.json"
    if path.is_file():
        old = read_description(path)
        # A set from before an entry was kept has nothing to compare it with.
        same = ("seed", "families", "settings", "library", "detector")
        if any(old.get(key, description[key]) != description[key] for key in same):
            raise DataError(
                f"{out}: holds a data set of another seed, families, parts or settings; "
                "choose another --out or remove it"
            )
        description = {**old, **description}
    elif out.is_dir() and any(out.glob("[0-9]*")):
        raise DataError(f"{out}: holds scenes but no dataset.json; choose another --out")
    write_json(path, description)
    return description


def read_description(path: Path) -> dict:
    """dataset.json. DataError when it is none."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, TypeError, ValueError):
        raise DataError(f"{path}: not JSON; remove the folder to begin anew") from None


def write_json(path: Path, content: dict) -> None:
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


def known_families(package_dir: Path = PACKAGE) -> list[str]:
    """Families of the part library, by name. DataError when there is no library."""
    found = set()
    for path in (package_dir / "assets" / "parts").glob("*/part.yaml"):
        found.add(yaml.safe_load(path.read_text())["family"])
    if not found:
        raise DataError(f"{package_dir}/assets/parts: holds no part; run scripts/setup")
    return sorted(found)


def generate_dataset(
    scenes: int,
    seed: int,
    out: Path,
    families: list[str],
    workers: int,
    quiet: bool = False,
    *,
    address: str | None = None,
    lift_check: int = 0,
    detector: bool = True,
    changes: Sequence[str] = (),
    package_dir: Path = PACKAGE,
) -> tuple[int, int]:
    """Makes the scenes 0 .. scenes-1 that are not there yet and lifts about `lift_check` labels of
    the set; returns the numbers of scenes and crops that the folder then holds.

    workers: processes of this machine, or actors on the Ray cluster at `address`; 0: one for each
    core. detector: with colour images. changes: KEY.KEY=VALUE, in place of config/dataset.yaml's.
    DataError for arguments that cannot be used and when there is no room on the disk. Whatever ends
    the run, annotations.json then fits the scenes on disk.
    """
    unknown = sorted(set(families) - set(known_families(package_dir)))
    if unknown or not families:
        known = ", ".join(known_families(package_dir))
        raise DataError(f"families: '{', '.join(unknown)}' not in the part library ({known})")
    settings = changed_settings(changes)
    # Detector classes: connecting_rod first wherever it takes part, then by name.
    categories = sorted(families, key=lambda name: (name != "connecting_rod", name))
    kind = SceneKind(tuple(categories), settings, library_digest(package_dir, families), detector)
    description = {
        "seed": seed,
        "scenes": scenes,
        "families": categories,
        "library": kind.library,
        "detector": detector,
        "settings": settings,
    }
    try:
        with sole_writer(out, DataError):
            description = open_dataset(out, description)
            try:
                _fill(description, out, kind, workers, address, package_dir, lift_check, quiet)
            finally:
                for rest in out.glob(".*.part"):
                    shutil.rmtree(rest, ignore_errors=True)
                counts = write_annotations(out, categories, detector)
    except OSError as error:
        again = "run the same command again to go on"
        raise DataError(disk_error(error, out, again)) from None
    return counts


def changed_settings(changes: Sequence[str]) -> dict:
    """config/dataset.yaml with changes KEY.KEY=VALUE. Raises DataError."""
    try:
        overrides = parse_overrides([f"{CONFIG.stem}.{change}" for change in changes])
        with changed_config(CONFIG.parent, overrides) as folder:
            return dict(yaml.safe_load((folder / CONFIG.name).read_text()))
    except OverrideError as error:
        raise DataError(str(error)) from None


def _fill(
    description: dict,
    out: Path,
    kind: SceneKind,
    workers: int,
    address: str | None,
    package_dir: Path,
    lift_check: int,
    quiet: bool,
) -> None:
    """Makes the scenes that are missing, then lifts the labels that are to be tried."""
    seed, scenes = description["seed"], description["scenes"]
    missing = [i for i in range(scenes) if not (out / f"{i:06d}").is_dir()]
    lifts_file = out / "lifts.json"
    lifts = read_description(lifts_file) if lifts_file.is_file() else {}
    piles, labels = plan_check(scenes, LOOKS, lift_check) if lift_check else ([], 0)
    looks = [pile * LOOKS + look for pile in piles for look in range(LOOKS)]
    untried = [i for i in looks if i < scenes and str(i) not in lifts]
    if not missing and not untried:
        return
    pool = open_pool(kind, workers, address, package_dir)
    try:
        with progress_bar(quiet) as bar:
            task = bar.add_task(f"scenes in {out}", total=len(missing))
            for files in _in_piles(pool, missing, "scenes", seed):
                for number, content in files.items():
                    write_scene(content, number, out)
                bar.advance(task, len(files))
            if untried:
                task = bar.add_task("scenes with labels lifted", total=len(untried))
            for tried in _in_piles(pool, untried, "lifts", seed, labels):
                for number, entries in tried.items():
                    require_stored(out, number, entries)
                    lifts[str(number)] = entries
                write_whole(lifts_file, json.dumps(lifts).encode())
                bar.advance(task, len(tried))
    finally:
        pool.close()
    if lifts:
        description["lift_check"] = summary([entry for i in lifts for entry in lifts[i]])
        write_json(out / "dataset.json", description)


def _in_piles(
    pool: ProcessPool | RayPool, numbers: list[int], method: str, seed: int, *arguments: Any
) -> Iterator[Any]:
    """SceneWorker.method(seed, pile, its numbers, ...) of all scenes' piles, as they are done."""
    piles: dict[int, list[int]] = {}
    for number in numbers:
        piles.setdefault(number // LOOKS, []).append(number)
    calls = ((pile, (method, seed, pile, wanted, *arguments)) for pile, wanted in piles.items())
    for _, result in results(pool, calls):
        yield result


def generate(
    scenes: Annotated[int, typer.Option(help="Number of scenes.", min=1)] = 1500,
    seed: Annotated[int, typer.Option(help="Of every random draw.", min=0)] = 1000,
    out: Annotated[Path, typer.Option(help="Folder of the set; goes on where it ended.")] = Path(
        "data/train"
    ),
    families: Annotated[
        str | None,
        typer.Option(
            help="Part families of assets/parts, comma-separated; default: connecting_rod, or the "
            "meshes alone where some are given."
        ),
    ] = None,
    mesh: Annotated[
        list[Path] | None,
        typer.Option(
            help="A closed mesh of your own (STL, OBJ, PLY, OFF); joins the part library under its "
            "file's name. Give it again for more."
        ),
    ] = None,
    mesh_unit: Annotated[str, typer.Option(help="Of the meshes: m, cm or mm.")] = "mm",
    mesh_density: Annotated[
        float, typer.Option(help="Of the meshes, kg/m^3 (steel 7850, aluminium 2700).", min=1)
    ] = 7850,
    lift_check: Annotated[
        int,
        typer.Option(help="Labels that are lifted in Bullet to see whether they hold.", min=0),
    ] = 100,
    detector: Annotated[
        bool, typer.Option(help="Make colour images, which the detector needs (1.5x the time).")
    ] = True,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY.KEY=VALUE",
            help="Another value in place of config/dataset.yaml's. Give it again for more.",
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes, or cores of the cluster; 0: all.", min=0)
    ] = 0,
    address: Annotated[
        str | None,
        typer.Option(
            help="Of a Ray cluster (HOST:PORT, ray://HOST:PORT or auto); its machines have the "
            "checkout at the same path."
        ),
    ] = None,
) -> None:
    """Makes a data set for grasp network and detector in the simulator.

    OUT is in Jacquard's layout, one folder a scene and one 300x300 crop an object; boxes and masks
    for the detector are in OUT/detector. A run that was stopped goes on with the same command.

    Examples:

    iwgnet dataset --scenes 200 --out data/mine

    iwgnet dataset --set scene.scattered_share=0.0 --set scene.parts=[6,12] --out data/piles

    iwgnet dataset --mesh valve.stl --mesh-unit mm --mesh-density 2700 --out data/valves

    ray start --head --port 6379; iwgnet dataset --address HOST:6379 --workers 64
    """
    names = [name.strip() for name in (families or "").split(",") if name.strip()]
    if families is None and not mesh:
        names = ["connecting_rod"]

    interrupt_on(signal.SIGINT, signal.SIGTERM)
    try:
        for path in mesh or []:
            part = part_from_mesh(path, path.stem, mesh_unit, density=mesh_density)
            add_to_library(part, PACKAGE / "assets" / "parts")
            names.append(part.family)
        made, crops = generate_dataset(
            scenes,
            seed,
            out,
            names,
            workers,
            address=address,
            lift_check=lift_check,
            detector=detector,
            changes=changes or (),
        )
    except (DataError, PartError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    except KeyboardInterrupt:
        typer.echo(f"stopped; run the same command again to go on with {out}", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"{out}: {made} scenes, {crops} object crops (seed {seed})")
    report = read_description(out / "dataset.json").get("lift_check")
    if report:
        typer.echo(as_text(report))


if __name__ == "__main__":
    typer.run(generate)
