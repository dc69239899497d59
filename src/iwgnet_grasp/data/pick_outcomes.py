"""Picks of piles and what became of them, for the network that foresees it: `iwgnet picks`.

    OUT/picks.json        what was made, with its seed and settings
    OUT/<pile %06d>.npz   the looks at a pile while it is cleared, and picks of each: PickedPile

The robot's own perception looks at a simulated pile, some grasps that it proposes are carried
out from start to end, each on the pile as it was seen, and then a part goes into the tray: so looks
and grasps come as they do in trials. A pile is a function of (seed, its number) and of what decides
a pick (perception's weights, the simulator); a run that was stopped goes on with the same command.
"""

from __future__ import annotations

import io
import json
import math
import signal
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
import typer
import yaml

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.files import disk_error, sole_writer, write_whole
from iwgnet_grasp.perception.types import Box, CameraIntrinsics
from iwgnet_grasp.progress import interrupt_on, progress_bar

if TYPE_CHECKING:
    from iwgnet_grasp.data.generate import SceneMaker
    from iwgnet_grasp.perception.types import GraspRectangle, Look

PACKAGE = Path(__file__).resolve().parents[3]
FAMILIES = ("connecting_rod",)  # what trials are made of
PICKS_OF_A_LOOK = 10
SAFE = 0.5, 0.3  # quality of the best pose above which an object is picked in this share of looks:
# of 144 such picks one failed, of 421 others 45
OTHER_SHARE = 0.5  # of the objects get a second pick, with any of their executable grasps
MARGIN_PX = 140  # kept around all boxes: what a grasp at their edge is surrounded by
DESCRIPTION = "picks.json"
HEIGHT_STEP = 1e-4  # m
CARRIED = 0.10  # m that another part moves at least when it was taken along
UNMEASURED = np.int16(-(2**15))


@dataclass(frozen=True)
class PickedPile:
    """Looks (L) at a pile, a region of (H, W) px of the colour image, and picks (n)."""

    heights: np.ndarray  # (L, H, W) int16 over the empty scene, in HEIGHT_STEP; or UNMEASURED
    greys: np.ndarray  # (L, H, W) uint8
    owners: np.ndarray  # (L, H, W) int8, Look.owners
    look: np.ndarray  # (n,) the look that the grasp was proposed in
    object_id: np.ndarray  # (n,)
    grasps: np.ndarray  # (n, 5) x, y px, theta rad, width px, quality: perception's
    pose_quality: np.ndarray  # (n,) of the pose that was carried out
    good: np.ndarray  # (n,) bool: the judge had nothing against it and one part alone went
    meant: np.ndarray  # (n,) index of the part that the object's pixels show, -1: none
    part: np.ndarray  # (n,) that was held, -1: none
    others_m: np.ndarray  # (n,) farthest that another part was moved


class Picker:
    """Draws piles, looks at them with config/perception.yaml, and picks."""

    def __init__(self, maker: SceneMaker) -> None:
        from iwgnet_grasp.perception import load_perception
        from iwgnet_grasp.trials.lift import Lifter

        self._maker = maker
        self._cell = maker.cell
        self._perception = load_perception()
        self._lifter = Lifter(maker.cell)

    def pile(self, seed: int, pile: int) -> PickedPile:
        """Clears a pile. Raises DataError when none can be built."""
        rng, parts = self._build(seed, pile)
        picked: list[dict[str, Any]] = []
        looks: list[Look] = []
        left = list(range(parts))
        self._maker.dress(rng)
        self._cell.show_parts(False)
        empty = self._depth()
        self._cell.show_parts(True)
        while len(left) > 1:
            poses = self._cell.part_poses()
            color, depth = self._cell.color(), self._depth()
            look = self._perception.look(color, depth, empty)
            _, truth = self._cell.ideal_view()
            slot = parts - len(left)
            lifted = []
            for entry in self._picks(look, truth, slot, rng):
                picked.append({"look": len(looks), **entry})
                if entry["good"] and entry["part"] in left:
                    lifted.append(entry["part"])
            looks.append(look)
            gone = int(rng.choice(lifted or left))  # a part that could go as the next
            left.remove(gone)
            self._cell.lay_parts(poses)
            self._cell.lay_in_tray(gone, slot)
            settle = self._maker.settings["scene"]["resettle_time"]
            self._cell.step(round(settle / self._cell.timestep))
        return _as_arrays(looks, picked)

    def _build(self, seed: int, pile: int) -> tuple[np.random.Generator, int]:
        from iwgnet_grasp.data.generate import PILE_ATTEMPTS, pile_rng

        for attempt in range(PILE_ATTEMPTS):
            rng = pile_rng(seed, pile, attempt)
            spec = self._maker.spec(rng)
            spec.arrangement = self._maker.core.Arrangement.STACKED
            spec.count = max(spec.count, 3)
            try:
                return rng, self._cell.build_scene(spec, int(rng.integers(2**62)))
            except self._maker.core.CoreError as error:
                reason = str(error)
        raise DataError(f"pile {pile} of seed {seed}: {reason}")

    def _depth(self) -> np.ndarray:
        return self._cell.aligned_depth(self._cell.depth())

    def _picks(
        self, look: Look, truth: np.ndarray, slot: int, rng: np.random.Generator
    ) -> list[dict[str, Any]]:
        heights = self._lifter.heights(look.depth)
        camera = self._cell.camera
        entries = []
        for o in (look.objects[i] for i in rng.permutation(len(look.objects))):
            if len(entries) >= PICKS_OF_A_LOOK:
                break
            centroid = self._centroid(o, camera)
            if centroid is None:
                continue
            poses = [self._lifter.pose(g, heights, centroid) for g in o.grasps]
            feasible = [i for i, pose in enumerate(poses) if pose.feasible]
            if not feasible:
                continue
            tried = [max(feasible, key=lambda i: poses[i].quality)]
            if poses[tried[0]].quality > SAFE[0] and rng.random() > SAFE[1]:
                continue
            if rng.random() < OTHER_SHARE:
                tried.append(int(rng.choice(feasible)))
            shown = truth[look.owners == o.object_id]
            shown = shown[shown >= 0]
            for i in dict.fromkeys(tried):
                lift = self._lifter.lift(poses[i], heights, None, centroid, slot)
                if not lift.executed:
                    continue
                entries.append(
                    {
                        "object_id": o.object_id,
                        "grasps": _row(o.grasps[i]),
                        "pose_quality": poses[i].quality,
                        "good": lift.lifted and lift.others_m < CARRIED,
                        "meant": int(np.bincount(shown).argmax()) if shown.size else -1,
                        "part": lift.part,
                        "others_m": lift.others_m,
                    }
                )
        return entries

    @staticmethod
    def _centroid(o: Any, camera: Any) -> np.ndarray | None:
        """(3,) m in base_link, of the object's pixels."""
        z = o.centroid_depth_m
        if not math.isfinite(z):
            return None
        k, T = camera.color, camera.T_base_color
        intrinsics = CameraIntrinsics(k.fx, k.fy, k.cx, k.cy)
        point = intrinsics.deproject(o.centroid_u_px, o.centroid_v_px, z)
        return T[:3, :3] @ point + T[:3, 3]


def _row(grasp: GraspRectangle) -> list[float]:
    return [grasp.x_px, grasp.y_px, grasp.theta_rad, grasp.width_px, grasp.quality]


def height_image(depth: np.ndarray, empty_depth: np.ndarray) -> np.ndarray:
    """int16 (H, W): over the empty scene in HEIGHT_STEP, UNMEASURED where a depth is missing."""
    height = (empty_depth - depth) / HEIGHT_STEP
    known = np.isfinite(height)
    image = np.full(depth.shape, UNMEASURED, np.int16)
    image[known] = np.clip(np.rint(height[known]), -3e4, 3e4)
    return image


_TYPES = {
    "look": np.int16,
    "object_id": np.int16,
    "grasps": np.float32,
    "pose_quality": np.float32,
    "good": bool,
    "meant": np.int16,
    "part": np.int16,
    "others_m": np.float32,
}


def _as_arrays(looks: Sequence[Look], picked: Sequence[dict[str, Any]]) -> PickedPile:
    columns = {
        name: np.array([entry[name] for entry in picked], kind) for name, kind in _TYPES.items()
    }
    columns["grasps"] = columns["grasps"].reshape(-1, 5)
    boxes = [o.box for look in looks for o in look.objects] or [Box(0, 0, 1, 1)]
    left = max(min(box.x for box in boxes) - MARGIN_PX, 0)
    top = max(min(box.y for box in boxes) - MARGIN_PX, 0)
    right = max(box.x + box.width for box in boxes) + MARGIN_PX
    bottom = max(box.y + box.height for box in boxes) + MARGIN_PX
    columns["grasps"][:, :2] -= left, top
    region = slice(top, bottom), slice(left, right)
    return PickedPile(
        np.stack([height_image(look.depth[region], look.empty_depth[region]) for look in looks]),
        np.stack([cv2.cvtColor(look.color[region], cv2.COLOR_RGB2GRAY) for look in looks]),
        np.stack([look.owners[region].astype(np.int8) for look in looks]),
        **columns,
    )


def encode_pile(pile: PickedPile) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{f.name: getattr(pile, f.name) for f in fields(pile)})
    return buffer.getvalue()


def read_pile(path: Path) -> PickedPile:
    """Raises DataError for a file that is none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return PickedPile(*(file[f.name] for f in fields(PickedPile)))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        line = " ".join(str(error).split())
        raise DataError(f"{path}: not a file of 'iwgnet picks' ({line})") from None


def make_picks(
    piles: int,
    seed: int,
    out: Path,
    workers: int = 0,
    address: str | None = None,
    quiet: bool = False,
) -> int:
    """Makes the piles 0 .. piles-1 that are not there yet; returns how many the folder then holds.
    workers, address: as for data.generate.generate_dataset. DataError."""
    from iwgnet_grasp.data.generate import CONFIG, write_json
    from iwgnet_grasp.data.scene_pool import SceneKind, library_digest, open_pool

    settings = yaml.safe_load(CONFIG.read_text())
    library = library_digest(PACKAGE, FAMILIES)
    kind = SceneKind(FAMILIES, settings, library)
    description = {"seed": seed, "piles": piles, "library": library, "settings": settings}
    try:
        with sole_writer(out, DataError):
            old = describe_picks(out) if any(out.glob("[0-9]*.npz")) else description
            if any(old.get(key) != description[key] for key in ("seed", "library", "settings")):
                raise DataError(
                    f"{out}: holds picks of another seed, parts or settings; choose another --out "
                    "or remove it"
                )
            write_json(out / DESCRIPTION, description)
            missing = [i for i in range(piles) if not (out / f"{i:06d}.npz").is_file()]
            if missing:
                _fill(out, missing, seed, open_pool(kind, workers, address, PACKAGE), quiet)
    except OSError as error:
        raise DataError(disk_error(error, out, "run the same command again to go on")) from None
    return len(list(out.glob("[0-9]*.npz")))


def describe_picks(folder: Path) -> dict:
    """picks.json of a folder. DataError when there is none."""
    path = folder / DESCRIPTION
    try:
        return dict(json.loads(path.read_text()))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; make picks with 'iwgnet picks'") from None
    except (TypeError, ValueError):
        raise DataError(f"{path}: not JSON; remove the folder to begin anew") from None


def _fill(out: Path, missing: list[int], seed: int, pool: Any, quiet: bool) -> None:
    from iwgnet_grasp.data.scene_pool import results

    try:
        with progress_bar(quiet) as bar:
            task = bar.add_task(f"piles in {out}", total=len(missing))
            for pile, content in results(pool, ((i, ("picks", seed, i)) for i in missing)):
                write_whole(out / f"{pile:06d}.npz", content)
                bar.advance(task)
    finally:
        pool.close()


def pick(
    piles: Annotated[int, typer.Option(help="Number of piles.", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="Of every random draw.", min=0)] = 3000,
    out: Annotated[Path, typer.Option(help="Folder of the set; goes on where it ended.")] = Path(
        "data/picks"
    ),
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
    """Carries out grasps of simulated piles, for the network that foresees what becomes of them.

    A run that was stopped goes on with the same command.
    """
    interrupt_on(signal.SIGINT, signal.SIGTERM)
    try:
        made = make_picks(piles, seed, out, workers, address)
    except KeyboardInterrupt:
        typer.echo(f"stopped; run the same command again to go on with {out}", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"{out}: {made} piles (seed {seed})")
