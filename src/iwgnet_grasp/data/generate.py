"""Data sets from the simulator: `python -m iwgnet_grasp.data.generate --scenes 100 --out DIR`.

    OUT/dataset.json                       what was made, with its seed and settings
    OUT/<scene %06d>/<object>_<scene>_...  one crop an object, in Jacquard's layout (data.jacquard)
    OUT/detector/images/<scene>.png        the colour image
    OUT/detector/annotations.json          COCO: boxes and run-length masks

Both depths of a crop are the merged depth of the paper (section 4.2): the object's box pasted into
the depth of the empty table, once noise-free (perfect) and once as the D455 measures it (stereo).
Scenes come in piles of LOOKS: the settled parts, then looks at the same table half cleared, as a
robot sees it, each with its own light, materials and camera. A pile is a function of (seed, its
number) alone and a scene appears whole or not at all, so that a run can be stopped and gone on
with, on any number of workers.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import fcntl
import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
import yaml
from PIL import Image

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_rectangle import COLUMNS, JAW, OPENING, QUALITY, THETA, X, Y
from iwgnet_grasp.data.jacquard import format_grasps
from iwgnet_grasp.perception.merged_depth import crop_window
from iwgnet_grasp.perception.types import Box

PACKAGE = Path(__file__).resolve().parents[3]
CONFIG = PACKAGE / "config" / "dataset.yaml"
CROP_PX = 300  # side of a crop: the longest part is about 170 px at 0.6 m
DEPTH_STEP = 2.0**-15  # m: 31 um, far below the noise; rounded floats compress well
LOOKS = 3  # scenes of one pile
PILE_ATTEMPTS = 5  # with other draws, when a pile cannot be built


# One scene ------------------------------------------------------------------------------------


def pile_rng(seed: int, pile: int, attempt: int = 0) -> np.random.Generator:
    """The only source of chance of a pile."""
    return np.random.default_rng([seed, pile, attempt])


class SceneMaker:
    """Draws, renders and labels scenes with one simulated cell."""

    def __init__(self, families: list[str], settings: dict, package_dir: Path = PACKAGE) -> None:
        from iwgnet_grasp import _core  # only here: training machines have no extension

        self.core = _core
        self.families = families
        self.settings = settings
        self.cell = _core.SimulatedCell(str(package_dir))
        self.labeler = _core.GraspLabeler(str(package_dir / "config"))

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
        color = cell.color()
        ideal, mask = cell.ideal_depth(), cell.part_mask()
        stereo = cell.aligned_depth(cell.depth())
        outline_areas = cell.unoccluded_areas()
        labels = self.labeler.label(cell, ideal, mask)
        cell.show_parts(False)
        empty_ideal = cell.ideal_depth()
        empty_stereo = cell.aligned_depth(cell.depth())
        cell.show_parts(True)
        objects = []
        for part, family in enumerate(cell.part_families):
            seen = self.visible(mask == part, outline_areas[part])
            if seen is None:
                continue
            rows = np.array(
                [rectangle_row(label) for label in labels if label.part == part], np.float32
            ).reshape(-1, COLUMNS)
            box = bounding_box(seen)
            detected = as_detected(box, color.shape, self.settings["crop"], rng)
            objects.append(SceneObject(part, family, seen, box, detected, rows))
        return Scene(color, ideal, empty_ideal, stereo, empty_stereo, objects)

    def visible(self, seen: np.ndarray, outline_area: float) -> np.ndarray | None:
        """The part's mask without crumbs; None when too little of it is seen."""
        crop = self.settings["crop"]
        if np.count_nonzero(seen) < crop["min_pixels"]:
            return None
        count, pieces, statistics, _ = cv2.connectedComponentsWithStats(seen.astype(np.uint8))
        for i in range(1, count):
            if statistics[i, cv2.CC_STAT_AREA] < crop["min_fragment"]:
                seen[pieces == i] = False
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

    color: np.ndarray  # (H, W, 3) uint8 RGB
    ideal: np.ndarray
    empty_ideal: np.ndarray
    stereo: np.ndarray
    empty_stereo: np.ndarray
    objects: list[SceneObject]
    arrangement: str = ""  # scattered or stacked


def rectangle_row(label: Any) -> list[float]:
    """A core GraspLabel as a row of data.grasp_rectangle."""
    row = [0.0] * COLUMNS
    r = label.rectangle
    row[X], row[Y], row[THETA] = r.x_px, r.y_px, r.theta_rad
    row[OPENING], row[JAW], row[QUALITY] = r.width_px, label.jaw_px, r.quality
    return row


def bounding_box(mask: np.ndarray) -> np.ndarray:
    """(4,) x, y, width, height of the smallest box around a mask that is not empty."""
    columns = np.flatnonzero(mask.any(axis=0))
    rows = np.flatnonzero(mask.any(axis=1))
    return np.array(
        [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1], int
    )


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


def write_scene(scene: Scene, number: int, out: Path, categories: list[str]) -> None:
    """Writes one scene; its folder is renamed into place when everything else is written."""
    images = out / "detector" / "images"
    images.mkdir(parents=True, exist_ok=True)
    write_image(images / f"{number:06d}.png", scene.color[:, :, ::-1])
    folder = out / f".{number:06d}.part"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for o in scene.objects:
        if len(o.rectangles) == 0:
            continue  # a part that nothing can be done with: the detector's business only
        perfect = crop_window(scene.ideal, scene.empty_ideal, o.detected, CROP_PX)
        stereo = crop_window(scene.stereo, scene.empty_stereo, o.detected, CROP_PX)
        window = slice(stereo.y, stereo.y + CROP_PX), slice(stereo.x, stereo.x + CROP_PX)
        rows = o.rectangles.copy()
        rows[:, X] -= stereo.x
        rows[:, Y] -= stereo.y
        rows = rows[((rows[:, [X, Y]] >= 0) & (rows[:, [X, Y]] <= CROP_PX - 1)).all(axis=1)]
        if len(rows) == 0:
            continue
        stem = f"{o.part}_{number:06d}"
        write_image(folder / f"{stem}_RGB.png", scene.color[window][:, :, ::-1])
        write_depth(folder / f"{stem}_perfect_depth.tiff", perfect.depth)
        write_depth(folder / f"{stem}_stereo_depth.tiff", stereo.depth)
        write_image(folder / f"{stem}_mask.png", o.mask[window].astype(np.uint8) * 255)
        (folder / f"{stem}_grasps.txt").write_text(format_grasps(rows), newline="")
        (folder / f"{stem}_quality.txt").write_text(
            "".join(f"{max(q, 1e-4):.4f}\n" for q in rows[:, QUALITY])
        )
    annotations = [annotation(o, categories) for o in scene.objects]
    height, width = scene.color.shape[:2]
    (folder / "detector.json").write_text(
        json.dumps(
            {
                "width": width,
                "height": height,
                "arrangement": scene.arrangement,
                "annotations": annotations,
            }
        )
    )
    folder.rename(out / f"{number:06d}")


def annotation(o: SceneObject, categories: list[str]) -> dict:
    """COCO, without the ids that depend on the other scenes."""
    from pycocotools import mask as coco_mask

    code = coco_mask.encode(np.asfortranarray(o.mask.astype(np.uint8)))
    return {
        "category_id": categories.index(o.family) + 1,
        "part": o.part,  # the <object> of its crop's name
        "bbox": [int(v) for v in o.box],
        "area": int(np.count_nonzero(o.mask)),
        "segmentation": {"size": list(code["size"]), "counts": code["counts"].decode("ascii")},
        "iscrowd": 0,
    }


def write_image(path: Path, image: np.ndarray) -> None:
    """PNG, BGR or grey. DataError when it cannot be written."""
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise DataError(f"{path}: cannot be written")


def write_depth(path: Path, depth: np.ndarray) -> None:
    """TIFF float32 m; -1 where there is no depth (Jacquard's mark). OSError when it cannot be
    written. By Pillow: OpenCV writes float images without compression."""
    rounded = np.round(depth / DEPTH_STEP) * DEPTH_STEP
    stored = np.where(np.isfinite(depth), rounded, -1).astype(np.float32)
    Image.fromarray(stored).save(path, compression="tiff_lzw")


def write_annotations(out: Path, categories: list[str]) -> tuple[int, int]:
    """Gathers the scenes' annotations; returns the numbers of scenes and of crops."""
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
    _replace(out / "detector" / "annotations.json", json.dumps(text))
    return len(images), crops


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text)
    os.replace(temporary, path)


# The run --------------------------------------------------------------------------------------

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_maker: SceneMaker | None = None


def _start_worker(families: list[str], settings: dict) -> None:
    global _maker
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)  # no worker outlives the run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the run
    cv2.setNumThreads(1)
    _maker = SceneMaker(families, settings)


def _make(seed: int, pile: int, wanted: list[int], out: Path, categories: list[str]) -> int:
    for look, scene in enumerate(_maker.pile(seed, pile)):
        number = pile * LOOKS + look
        if number in wanted:
            write_scene(scene, number, out, categories)
    return len(wanted)


def open_dataset(out: Path, description: dict) -> None:
    """Begins a set or goes on with it. DataError when the folder holds another one."""
    path = out / "dataset.json"
    if path.is_file():
        try:
            old = json.loads(path.read_text())
        except ValueError:
            raise DataError(f"{path}: not JSON; remove the folder to begin anew") from None
        same = ("seed", "families", "settings")
        if any(old.get(key) != description[key] for key in same):
            raise DataError(
                f"{out}: holds a data set of another seed, families or settings; "
                "choose another --out or remove it"
            )
    elif out.is_dir() and any(out.glob("[0-9]*")):
        raise DataError(f"{out}: holds scenes but no dataset.json; choose another --out")
    _replace(path, json.dumps(description, indent=2) + "\n")


def known_families(package_dir: Path = PACKAGE) -> list[str]:
    """Families of the part library, by name. DataError when there is no library."""
    found = set()
    for path in (package_dir / "assets" / "parts").glob("*/part.yaml"):
        found.add(yaml.safe_load(path.read_text())["family"])
    if not found:
        raise DataError(f"{package_dir}/assets/parts: holds no part; run scripts/setup")
    return sorted(found)


def generate_dataset(
    scenes: int, seed: int, out: Path, families: list[str], workers: int, quiet: bool = False
) -> tuple[int, int]:
    """Makes the scenes 0 .. scenes-1 that are not there yet; returns the numbers of scenes and
    crops that the folder then holds. DataError for arguments that cannot be used. Whatever ends
    the run, annotations.json then fits the scenes on disk."""
    unknown = sorted(set(families) - set(known_families()))
    if unknown or not families:
        known = ", ".join(known_families())
        raise DataError(f"families: '{', '.join(unknown)}' not in the part library ({known})")
    settings = yaml.safe_load(CONFIG.read_text())
    # Detector classes: connecting_rod first wherever it takes part, then by name.
    categories = sorted(families, key=lambda name: (name != "connecting_rod", name))
    with sole_writer(out):
        open_dataset(
            out, {"seed": seed, "scenes": scenes, "families": categories, "settings": settings}
        )
        missing = [i for i in range(scenes) if not (out / f"{i:06d}").is_dir()]
        try:
            if missing:
                _run(missing, seed, out, categories, settings, workers, quiet)
        finally:
            for rest in out.glob(".*.part"):
                shutil.rmtree(rest, ignore_errors=True)
            counts = write_annotations(out, categories)
    return counts


@contextlib.contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Holds the folder's lock. DataError when another run has it."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DataError(f"{out}: another run is writing it; wait or choose another") from None
        yield


def _run(
    missing: list[int],
    seed: int,
    out: Path,
    categories: list[str],
    settings: dict,
    workers: int,
    quiet: bool,
) -> None:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(categories, settings),
    )
    piles: dict[int, list[int]] = {}
    for number in missing:
        piles.setdefault(number // LOOKS, []).append(number)
    left = iter(piles.items())
    running: set[Future] = set()
    try:
        with Progress(*columns, disable=quiet) as progress:
            task = progress.add_task(f"scenes in {out}", total=len(missing))
            while True:
                for pile, wanted in left:
                    running.add(pool.submit(_make, seed, pile, wanted, out, categories))
                    if len(running) >= 2 * workers:
                        break
                if not running:
                    return
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    progress.advance(task, future.result())
    except BrokenProcessPool:
        raise DataError(
            "a worker died (out of memory?); run the same command again to go on"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def generate(
    scenes: Annotated[int, typer.Option(help="Number of scenes.", min=1)] = 1500,
    seed: Annotated[int, typer.Option(help="Of every random draw.", min=0)] = 1000,
    out: Annotated[Path, typer.Option(help="Folder of the set; goes on where it ended.")] = Path(
        "data/train"
    ),
    families: Annotated[
        str, typer.Option(help="Part families, comma-separated.")
    ] = "connecting_rod",
    workers: Annotated[int, typer.Option(help="Processes.", min=1)] = os.cpu_count() or 1,
) -> None:
    """Makes a data set for grasp network and detector in the simulator."""
    names = [name.strip() for name in families.split(",") if name.strip()]

    def stop(*_):
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)  # a shell may have started it with SIGINT ignored
    signal.signal(signal.SIGTERM, stop)
    try:
        made, crops = generate_dataset(scenes, seed, out, names, workers)
    except DataError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    except KeyboardInterrupt:
        typer.echo(f"stopped; run the same command again to go on with {out}", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"{out}: {made} scenes, {crops} object crops (seed {seed})")


if __name__ == "__main__":
    typer.run(generate)
