"""The part library on disk: assets/parts/NAME/{part.yaml, mesh.stl, piece_NN.stl}.

Every mesh and piece has its origin at the part's centre of mass, x along its longest and z along
its shortest extent. part.yaml holds name, family, mass (kg), inertia (9 numbers, row-major,
kg m^2 about the centre of mass), mesh and pieces (file names)."""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yaml

from iwgnet_grasp.parts.connecting_rod import ConnectingRod
from iwgnet_grasp.parts.families import Bracket, Elbow, Flange, HexBolt, Prism, Tee, TurnedPart
from iwgnet_grasp.parts.solids import to_trimesh

# Kind in config/parts.yaml -> what its sizes are.
KINDS = {
    "connecting_rods": ConnectingRod,
    "unseen_connecting_rods": ConnectingRod,
    "hex_bolts": HexBolt,
    "brackets": Bracket,
    "flanges": Flange,
    "tees": Tee,
    "prisms": Prism,
    "turned_parts": TurnedPart,
    "elbows": Elbow,
    "other_connecting_rods": ConnectingRod,
}
LONGEST = 0.17  # m: a slot of the tray (config/cell.yaml) is 0.18 m long
THINNEST = 0.002  # m: thinner parts drown in the depth camera's noise
THICKEST = 0.085  # m: the 2F-85 opens so far
HEAVIEST = 4.0  # kg: the UR5 carries 5 kg, the gripper weighs 0.92
USER_MARK = ".user"  # file in the folder of a part that did not come from config/parts.yaml


class PartError(ValueError):
    """One line: which part or file is wrong, why, what to do."""


def one_line(error: Exception) -> str:
    """An exception's message without line breaks."""
    return " ".join(str(error).split())


@dataclass(frozen=True)
class Part:
    """A part in its library frame."""

    name: str
    family: str
    mass: float  # kg
    inertia: np.ndarray  # (3, 3) kg m^2 about the centre of mass
    mesh: trimesh.Trimesh  # m
    pieces: list[trimesh.Trimesh]  # convex, m


def library_axes(mesh: trimesh.Trimesh) -> np.ndarray:
    """(4, 4) transform that brings a mesh's centre of mass to the origin and turns it by right
    angles so that x is its longest and z its shortest extent."""
    order = np.argsort(-mesh.extents, kind="stable")
    rotation = np.eye(3)[order]
    if np.linalg.det(rotation) < 0:
        rotation[2] = -rotation[2]
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ mesh.center_mass
    return transform


def make_part(
    name: str,
    family: str,
    mesh: trimesh.Trimesh,
    pieces: list[trimesh.Trimesh],
    *,
    density: float | None = None,
    mass: float | None = None,
) -> Part:
    """A part from its mesh in any frame; homogeneous, of a density (kg/m^3) or a mass (kg)."""
    transform = library_axes(mesh)
    mesh = mesh.copy()
    mesh.apply_transform(transform)
    if density is None:
        density = mass / mesh.volume
    mesh.density = density
    moved = []
    for piece in pieces:
        piece = piece.copy()
        piece.apply_transform(transform)
        moved.append(piece)
    return Part(name, family, float(mesh.mass), np.array(mesh.moment_inertia), mesh, moved)


def save_part(part: Part, library: Path) -> Path:
    """Writes library/NAME; a part of that name that was there is replaced whole."""
    library.mkdir(parents=True, exist_ok=True)
    place = library / part.name
    with tempfile.TemporaryDirectory(dir=library, prefix=".") as temporary:
        made = Path(temporary) / part.name
        made.mkdir()
        part.mesh.export(made / "mesh.stl")
        names = [f"piece_{i:02d}.stl" for i in range(len(part.pieces))]
        for file_name, piece in zip(names, part.pieces, strict=True):
            piece.export(made / file_name)
        description = {
            "name": part.name,
            "family": part.family,
            "mass": round(part.mass, 6),
            "inertia": [float(f"{v:.6g}") for v in part.inertia.ravel()],
            "mesh": "mesh.stl",
            "pieces": names,
        }
        text = yaml.safe_dump(description, sort_keys=False, default_flow_style=None, width=100)
        (made / "part.yaml").write_text(text)
        if place.exists():
            place.rename(Path(temporary) / "old")
        made.rename(place)
    return place


def load_part(folder: Path) -> Part:
    """Reads one part of the library. Raises PartError."""
    path = folder / "part.yaml"
    try:
        d = yaml.safe_load(path.read_text())
        part = Part(
            name=str(d["name"]),
            family=str(d["family"]),
            mass=float(d["mass"]),
            inertia=np.array(d["inertia"], dtype=float).reshape(3, 3),
            mesh=trimesh.load(folder / d["mesh"], force="mesh"),
            pieces=[trimesh.load(folder / p, force="mesh") for p in d["pieces"]],
        )
    except FileNotFoundError as error:
        raise PartError(f"{error.filename}: no such file; run scripts/setup") from None
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise PartError(
            f"{path}: not a part description ({one_line(error)}); run scripts/setup"
        ) from None
    return part


def configured_parts(config: Path) -> Iterator[Part]:
    """The parts that config/parts.yaml describes. Raises PartError."""
    try:
        settings = yaml.safe_load(config.read_text())
    except FileNotFoundError:
        raise PartError(f"{config}: no such file") from None
    except yaml.YAMLError as error:
        raise PartError(f"{config}: {one_line(error)}") from None
    try:
        densities, tolerance = settings["densities"], float(settings["piece_tolerance"])
        groups = {kind: settings[kind] for kind in settings if kind in KINDS}
    except (KeyError, TypeError) as error:
        raise PartError(f"{config}: needs densities and piece_tolerance ({error})") from None
    for kind, group in groups.items():
        for name, sizes in group["sizes"].items():
            try:
                values = {k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()}
                density = float(densities[values.pop("material")])
                shape = KINDS[kind](**values)
                mesh = to_trimesh(shape.solid())
                pieces = [to_trimesh(p) for p in shape.pieces(tolerance)]
            except (KeyError, TypeError, ValueError) as error:
                raise PartError(f"{config}: {kind}.sizes.{name}: {error}") from None
            if not mesh.is_watertight or mesh.volume <= 0 or not pieces:
                raise PartError(f"{config}: {kind}.sizes.{name}: these sizes give no solid body")
            yield make_part(name, group["family"], mesh, pieces, density=density)


def make_library(config: Path, library: Path) -> int:
    """Writes all configured parts into `library`; returns how many. Raises PartError."""
    count = 0
    for part in configured_parts(config):
        save_part(part, library)
        count += 1
    return count


_USER_KEYS = {"name", "family", "mesh", "unit", "density", "mass"}
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def part_from_description(description: Path) -> Part:
    """A user's part from YAML: `name`, `mesh` (file beside the YAML), `unit` (m, cm, mm),
    `density` (kg/m^3) or `mass` (kg), `family` (default: the name); see part_from_mesh.
    Raises PartError.
    """
    try:
        d = yaml.safe_load(description.read_text())
    except FileNotFoundError:
        raise PartError(f"{description}: no such file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PartError(f"{description}: {one_line(error)}") from None
    if not isinstance(d, dict):
        raise PartError(f"{description}: must hold keys {', '.join(sorted(_USER_KEYS))}")
    unknown = set(d) - _USER_KEYS
    missing = {"name", "mesh", "unit"} - set(d)
    if unknown or missing:
        what = [f"unknown key '{k}'" for k in sorted(map(str, unknown))]
        what += [f"key '{k}' is missing" for k in sorted(missing)]
        raise PartError(f"{description}: {', '.join(what)}")
    name = str(d["name"])
    given = [k for k in ("density", "mass") if k in d]
    if len(given) != 1:
        raise PartError(f"{description}: give either density (kg/m^3) or mass (kg)")
    amount = d[given[0]]
    if isinstance(amount, bool) or not isinstance(amount, int | float) or not 0 < amount < 1e5:
        raise PartError(f"{description}: {given[0]} must be a positive number, not '{amount}'")

    path = description.parent / str(d["mesh"])
    if not path.is_file():
        raise PartError(f"{path}: no such mesh (named in {description})")
    family = str(d.get("family", name))
    return part_from_mesh(path, name, str(d["unit"]), family, **{given[0]: amount})


def part_from_mesh(
    path: Path,
    name: str,
    unit: str,
    family: str | None = None,
    *,
    density: float | None = None,
    mass: float | None = None,
) -> Part:
    """A part from a mesh file (STL, OBJ, PLY, OFF) in m, cm or mm, homogeneous, of a density
    (kg/m^3) or a mass (kg).

    The mesh must be closed and fit gripper, workspace and robot. Convex pieces come from CoACD.
    Raises PartError.
    """
    if not name or not all(c.isalnum() or c in "_-" for c in name):
        raise PartError(f"{path}: name '{name}' may hold letters, digits, '_' and '-' only")
    if unit not in UNITS:
        raise PartError(f"{path}: unit '{unit}' is none of {', '.join(UNITS)}")
    if not path.is_file():
        raise PartError(f"{path}: no such mesh")
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:  # trimesh's loaders raise whatever their format's parser raises
        raise PartError(f"{path}: cannot be read as a mesh ({one_line(error)})") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise PartError(f"{path}: holds no triangles")
    mesh.apply_scale(UNITS[unit])
    mesh.merge_vertices()
    longest, shortest = 1e3 * mesh.extents.max(), 1e3 * mesh.extents.min()
    wrong = f"is it in {unit}? Known units: {', '.join(UNITS)}"
    if longest > 1e3 * LONGEST:
        raise PartError(f"{path}: {longest:.0f} mm long, more than {1e3 * LONGEST:.0f} mm; {wrong}")
    if shortest < 1e3 * THINNEST:
        raise PartError(f"{path}: only {shortest:.2g} mm thick; {wrong}")
    if shortest > 1e3 * THICKEST:
        raise PartError(
            f"{path}: {shortest:.0f} mm thick, more than the gripper opens "
            f"({1e3 * THICKEST:.0f} mm); {wrong}"
        )
    if not mesh.is_watertight:
        loose = len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
        raise PartError(f"{path}: the mesh is not closed ({loose} open edges); close it first")
    trimesh.repair.fix_normals(mesh)
    mass = mass if density is None else density * mesh.volume
    if mass > HEAVIEST:
        raise PartError(f"{path}: {mass:.1f} kg, more than the robot carries ({HEAVIEST} kg)")
    return make_part(name, family or name, mesh, convex_pieces(mesh), mass=mass)


def convex_pieces(mesh: trimesh.Trimesh, concavity: float = 0.05) -> list[trimesh.Trimesh]:
    """Convex decomposition by CoACD (Wei et al. 2022); deterministic."""
    if mesh.is_convex:
        return [mesh]
    import coacd

    coacd.set_log_level("error")
    hulls = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), threshold=concavity, seed=0)
    return [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in hulls]


def add_part(description: Path, library: Path) -> Part:
    """Adds a user's part to the library (see part_from_description). Raises PartError."""
    return add_to_library(part_from_description(description), library)


def add_to_library(part: Part, library: Path) -> Part:
    """Adds a user's part, in place of an earlier one of that name. Raises PartError when
    config/parts.yaml has the name."""
    configured = library / part.name / "part.yaml"
    if configured.is_file() and not (library / part.name / USER_MARK).is_file():
        raise PartError(f"'{part.name}' is a part of config/parts.yaml; choose another name")
    save_part(part, library)
    (library / part.name / USER_MARK).touch()
    return part


def keep_user_parts(old: Path, new: Path) -> None:
    """Copies the users' parts of one library into another that lacks them."""
    for mark in old.glob(f"*/{USER_MARK}"):
        if not (new / mark.parent.name).exists():
            shutil.copytree(mark.parent, new / mark.parent.name)
