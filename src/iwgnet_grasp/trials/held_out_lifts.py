"""Networks' first grasps carried out open loop on the scenes of a held-out set.

The scenes are made again from the set's seed (a pile is a function of seed and number), the grasps
are executed by trials.lift: friction and contact forces, nothing attached, no second look. All
networks get the same objects. Lifts are kept in a file, so that a run that was stopped goes on, and
the same grasp on the same scene is not tried twice.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.generate import CROP_PX, LOOKS, PACKAGE
from iwgnet_grasp.data.grasp_rectangle import Grasp, wrap_theta

if TYPE_CHECKING:
    from iwgnet_grasp.data.generate import Scene, SceneMaker, SceneObject

OBJECTS_OF_A_LOOK = 5  # lifted at most: many piles say more than many parts of one
NO_GRASP = "no_grasp"  # the network proposed none
_DIGITS = 4  # of a grasp's numbers, px and rad: as they are executed and kept


class LiftsUnavailable(RuntimeError):
    """Lifts cannot be done here; one line says why."""


@dataclass(frozen=True)
class HeldOutObject:
    """<part>_<scene> of a set made by 'iwgnet dataset'."""

    name: str
    mask_digest: str  # of its mask.png: the scene must come out again as it is stored

    @property
    def part(self) -> int:
        return int(self.name.partition("_")[0])

    @property
    def scene(self) -> int:
        return int(self.name.partition("_")[2])


def choose_objects(names: Sequence[str], count: int, seed: int) -> list[str]:
    """About `count` objects of a set: piles in a random order, one look of each, of that up to
    OBJECTS_OF_A_LOOK objects. A function of its arguments alone."""
    rng = np.random.default_rng(seed)
    piles: dict[int, dict[int, list[str]]] = {}
    for name in sorted(names):
        scene = int(name.partition("_")[2])
        piles.setdefault(scene // LOOKS, {}).setdefault(scene, []).append(name)
    chosen: list[str] = []
    for pile in rng.permutation(sorted(piles)):
        looks = piles[int(pile)]
        look = looks[int(rng.choice(sorted(looks)))]
        chosen += [look[i] for i in rng.permutation(len(look))[:OBJECTS_OF_A_LOOK]]
        if len(chosen) >= count:
            break
    return sorted(chosen[:count])


def in_view(grasp: Grasp, input_px: int) -> Grasp:
    """A grasp in px of the network's input -> px of the stored crop, whose centre the input is."""
    offset = (CROP_PX - input_px) // 2
    values = [grasp.x_px + offset, grasp.y_px + offset, *grasp[2:]]
    return Grasp(*(round(float(v), _DIGITS) for v in values))


def lift_all(
    folder: Path,
    generator: Mapping[str, Any],
    grasps: Mapping[str, Sequence[Grasp]],
    kept: Path,
    workers: int = 1,
    address: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[tuple[str, Grasp], dict]:
    """Outcomes by object and grasp: {"outcome", "slip_mm", "slip_deg"} (trials.lift.Lift).

    grasps: in px of the stored crop (in_view), by object. kept: file that outcomes are read from
    and appended to. Objects whose scene does not come out as it is stored have no outcome.
    progress(n) is told of n grasps that are done. Raises LiftsUnavailable without the extension,
    DataError.
    """
    from iwgnet_grasp.data.scene_pool import SceneKind, library_digest, open_pool

    families = list(generator["families"])
    seed, settings = int(generator["seed"]), generator["settings"]
    library = library_digest(PACKAGE, families)
    circumstances = [seed, families, settings, library, simulator_digest()]
    keys = {
        (name, grasp): _digest([circumstances, name, grasp])
        for name, wanted in grasps.items()
        for grasp in wanted
    }
    known = _read(kept)
    outcomes = {pair: known[key] for pair, key in keys.items() if key in known}
    _tell(progress, len(outcomes))
    piles: dict[int, dict[HeldOutObject, list[Grasp]]] = {}
    for name, grasp in keys:
        if (name, grasp) not in outcomes:
            thing = HeldOutObject(name, _stored_mask_digest(folder, name))
            piles.setdefault(thing.scene // LOOKS, {}).setdefault(thing, []).append(grasp)
    if not piles:
        return outcomes
    kept.parent.mkdir(parents=True, exist_ok=True)
    kind = SceneKind(tuple(families), settings, library, detector=False)
    pool = open_pool(kind, workers, address, PACKAGE)
    try:
        whole = not kept.is_file() or kept.read_text().endswith("\n")
        with kept.open("a") as file:
            file.write("" if whole else "\n")  # after the line of a killed run
            running = {
                pool.submit("network_lifts", seed, pile, wanted): wanted
                for pile, wanted in sorted(piles.items())
            }
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    wanted = running.pop(future)
                    for name, grasp, outcome in pool.result(future):
                        outcomes[name, grasp] = outcome
                        line = json.dumps({"key": keys[name, grasp], "object": name, **outcome})
                        file.write(line + "\n")
                    file.flush()
                    _tell(progress, sum(len(g) for g in wanted.values()))
    finally:
        pool.close()
    return outcomes


def lift_pile(
    maker: SceneMaker, seed: int, pile: int, wanted: Mapping[HeldOutObject, Sequence[Grasp]]
) -> list[tuple[str, Grasp, dict]]:
    """(object, grasp, outcome) of the wanted grasps of one pile, except for objects that do not
    come out as they are stored."""
    from iwgnet_grasp.data.generate import crop
    from iwgnet_grasp.trials.lift import Lifter

    # All looks first: a lift sets the cell's time back, and later looks would come out otherwise.
    looks = max(thing.scene for thing in wanted) - pile * LOOKS + 1
    try:
        scenes = dict(enumerate(islice(maker.pile(seed, pile), looks), start=pile * LOOKS))
    except DataError:  # a pile of another version, which cannot be built by this one
        return []
    lifter = Lifter(maker.cell)
    results = []
    for thing, grasps in sorted(wanted.items(), key=lambda item: item[0].name):
        scene = scenes[thing.scene]
        shown = [o for o in scene.objects if o.part == thing.part]
        if not shown:
            continue
        window, _ = crop(scene, shown[0])
        view = shown[0].mask[window.y : window.y + CROP_PX, window.x : window.x + CROP_PX]
        if _mask_digest(view) != thing.mask_digest:
            continue
        for grasp in grasps:
            moved = grasp._replace(x_px=grasp.x_px + window.x, y_px=grasp.y_px + window.y)
            results.append((thing.name, grasp, _lift(lifter, scene, shown[0], moved)))
    return results


def _lift(lifter, scene: Scene, thing: SceneObject, grasp: Grasp) -> dict:
    """A grasp in px of the whole image, from the depth that the D455 measured."""
    from iwgnet_grasp.perception.merged_depth import grasp_depth, object_mask
    from iwgnet_grasp.perception.pipeline import PerceptionConfig
    from iwgnet_grasp.perception.types import GraspRectangle

    config = PerceptionConfig.load()
    lifter.cell.lay_parts(scene.poses)
    lifter.cell.camera = scene.camera
    heights = lifter.heights(scene.stereo)
    rectangle = GraspRectangle(
        grasp.x_px, grasp.y_px, float(wrap_theta(grasp.theta_rad)), grasp.width_px, grasp.quality
    )
    seen = object_mask(scene.stereo, scene.empty_stereo, thing.detected, config.min_height)
    radius = config.grasp_depth_radius_px
    depth = grasp_depth(scene.stereo, seen, thing.detected, rectangle, radius)
    pose = lifter.pose(replace(rectangle, depth_m=depth), heights)
    centroid = scene.poses[thing.part][:3, 3]
    lift = lifter.lift(pose, heights, thing.part, centroid, scene.laid_away)
    return {
        "outcome": lift.outcome,
        "slip_mm": round(lift.slip_mm, 2),
        "slip_deg": round(lift.slip_deg, 2),
    }


def simulator_digest() -> str:
    """Digest of what decides a lift beside scene and grasp: the extension and config/*.yaml."""
    try:
        from iwgnet_grasp import _core
    except ImportError as error:
        raise LiftsUnavailable(
            f"the C++ extension cannot be loaded ({error}); run scripts/setup, then source "
            "scripts/env.sh"
        ) from None
    digest = hashlib.sha256(Path(_core.__file__).read_bytes())
    for path in sorted((PACKAGE / "config").glob("*.yaml")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _stored_mask_digest(folder: Path, name: str) -> str:
    """ "" for a mask that is missing or broken: no scene comes out like that."""
    path = folder / name.partition("_")[2] / f"{name}_mask.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    return "" if image is None else _mask_digest(image > 0)


def _mask_digest(mask: np.ndarray) -> str:
    return hashlib.sha256(np.packbits(mask).tobytes()).hexdigest()[:16]


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:24]


def _read(path: Path) -> dict[str, dict]:
    """Outcomes by key; a line that a killed run left unfinished is passed over."""
    outcomes = {}
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            entry = json.loads(line)
            del entry["object"]
            outcomes.setdefault(entry.pop("key"), entry)
        except (ValueError, KeyError, TypeError):
            continue
    return outcomes


def _tell(progress: Callable[[int], None] | None, count: int) -> None:
    if progress and count:
        progress(count)
