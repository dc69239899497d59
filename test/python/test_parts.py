"""The part library: solids, convex pieces, files, and parts that users add."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial import ConvexHull

from iwgnet_grasp import assets
from iwgnet_grasp.parts import PartError, add_part, configured_parts, load_part, save_part
from iwgnet_grasp.parts.families import Elbow, TurnedPart, sum_of
from iwgnet_grasp.parts.library import library_axes, make_library, part_from_mesh
from iwgnet_grasp.parts.solids import ring_sectors, to_manifold

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "parts.yaml"
SETTINGS = yaml.safe_load(CONFIG.read_text())
PARTS = {part.name: part for part in configured_parts(CONFIG)}
RODS = [name for name, part in PARTS.items() if part.family.startswith("connecting_rod")]
EVERY_PART = pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())


def rod_sizes(name):
    for kind in ("connecting_rods", "unseen_connecting_rods", "other_connecting_rods"):
        if name in SETTINGS[kind]["sizes"]:
            return SETTINGS[kind]["sizes"][name]
    raise KeyError(name)


def height_over_faces(points, piece):
    """(n,) how far points lie outside a convex piece (at most their distance to it)."""
    offsets = np.einsum("ij,ij->i", piece.face_normals, piece.triangles_center)
    return (points @ piece.face_normals.T - offsets).max(axis=1)


def test_the_families_that_scenes_and_training_ask_for():
    count = {}
    for part in PARTS.values():
        count[part.family] = count.get(part.family, 0) + 1
    assert count["connecting_rod"] >= 6
    assert count["connecting_rod_unseen"] >= 3
    assert len(count) >= 6


@EVERY_PART
def test_mesh_is_closed_centred_and_turned_by_its_extents(part):
    assert part.mesh.is_watertight and part.mesh.is_winding_consistent
    assert part.mesh.volume > 0
    np.testing.assert_allclose(part.mesh.center_mass, 0.0, atol=1e-9)
    x, y, z = part.mesh.extents
    assert x >= y - 1e-9 and y >= z - 1e-9
    assert len(part.mesh.faces) < 4000


@EVERY_PART
def test_inertia_is_that_of_a_real_body(part):
    np.testing.assert_allclose(part.inertia, part.inertia.T, atol=1e-12)
    a, b, c = np.linalg.eigvalsh(part.inertia)
    assert a > 0 and a + b >= c
    # No part is slimmer than a thin bar of its mass nor stouter than its bounding box's corners.
    assert c < part.mass * (part.mesh.extents**2).sum() / 4


def test_inertia_against_the_formula_of_a_box():
    side, length = 0.025 / np.sqrt(2), 0.080  # prism_4 is named by its circumscribed circle
    part = PARTS["prism_4"]
    assert part.mass == pytest.approx(7850 * side**2 * length, rel=1e-6)
    across = part.mass * (side**2 + length**2) / 12
    along = part.mass * side**2 / 6
    np.testing.assert_allclose(
        part.inertia, np.diag([along, across, across]), rtol=1e-6, atol=1e-12
    )


def test_a_turned_parts_volume_is_that_of_its_cylinders():
    steps, bore = ((0.066, 0.008), (0.044, 0.010)), 0.016
    turned = TurnedPart(steps, bore)
    exact = sum(np.pi / 4 * (d**2 - bore**2) * length for d, length in steps)
    assert turned.solid().volume() == pytest.approx(exact, rel=5e-3)  # circles are polygons
    assert TurnedPart(steps, 0).solid().volume() == pytest.approx(
        exact + np.pi / 4 * bore**2 * 0.018, rel=5e-3
    )


def test_an_elbow_reaches_as_far_as_its_legs():
    x, y, _ = Elbow(0.02, (0.07, 0.04), 90.0).solid().bounding_box()[3:]
    assert (x, y) == pytest.approx((0.07, 0.04), abs=1e-6)


@EVERY_PART
def test_pieces_are_convex_and_together_fit_the_mesh(part):
    for piece in part.pieces:
        assert piece.volume == pytest.approx(ConvexHull(piece.vertices).volume, rel=1e-6)
    union = sum_of([to_manifold(piece) for piece in part.pieces])
    assert union.volume() == pytest.approx(part.mesh.volume, rel=0.025)

    tolerance = 1.1e-3
    surface = np.vstack([part.mesh.vertices, part.mesh.sample(1500, seed=0)])
    missing = np.min([height_over_faces(surface, piece) for piece in part.pieces], axis=0)
    assert missing.max() < tolerance
    corners = np.vstack([piece.vertices for piece in part.pieces])
    outside = np.vstack([corners] + [piece.sample(60, seed=0) for piece in part.pieces])
    protruding = -trimesh.proximity.signed_distance(part.mesh, outside)
    assert protruding.max() < tolerance


@pytest.mark.parametrize("name", RODS)
def test_rods_keep_to_sizes_weights_and_open_bores(name):
    part, sizes = PARTS[name], rod_sizes(name)
    assert 0.2 <= part.mass <= 0.6
    assert part.mesh.extents[0] < 0.161
    assert part.mesh.euler_number == -2  # genus 2: two bores, nothing else goes through
    assert all(0.014 <= w <= 0.022 for w in sizes["shank_width"])
    assert 0.018 <= sizes["shank_thickness"] <= sizes["big_thickness"] <= 0.028

    # A gauge of the bore's size, less a little, goes through mesh and pieces at both ends.
    big_x = part.mesh.bounds[0][0] + sizes["big_bore"] / 2 + sizes["big_wall"]
    for x, bore in (
        (big_x, sizes["big_bore"]),
        (big_x + sizes["centre_distance"], sizes["small_bore"]),
    ):
        angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        for radius in (0.0, bore / 2 - 1.0e-3):
            gauge = np.stack(
                [x + radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1
            )
            assert not part.mesh.contains(gauge).any()
            assert min(height_over_faces(gauge, piece).min() for piece in part.pieces) > 0
        # ... and one that is larger does not.
        wall = np.stack(
            [x + (bore / 2 + 1e-3) * np.cos(angle), (bore / 2 + 1e-3) * np.sin(angle), 0 * angle],
            axis=1,
        )
        assert part.mesh.contains(wall).all()


def test_ring_sectors_stray_from_the_bore_to_both_sides_alike():
    bore, tolerance = 0.040, 0.0005
    pieces = ring_sectors(bore, 0.060, tolerance)
    points = np.vstack([np.vstack(piece.to_polygons()) for piece in pieces])
    radius = np.linalg.norm(points, axis=1)
    inner = radius[radius < 0.025].max()  # corners
    middle = inner * np.cos(np.pi / len(pieces))  # of the chord between two of them
    assert inner - bore / 2 == pytest.approx(bore / 2 - middle, rel=1e-6)
    assert inner - bore / 2 <= tolerance


def test_library_axes_is_a_rigid_motion():
    box = trimesh.creation.box((0.01, 0.03, 0.02))
    box.apply_translation((0.1, 0.2, 0.3))
    transform = library_axes(box)
    assert np.linalg.det(transform[:3, :3]) == pytest.approx(1.0)
    box.apply_transform(transform)
    np.testing.assert_allclose(box.extents, (0.03, 0.02, 0.01))
    np.testing.assert_allclose(box.center_mass, 0.0, atol=1e-12)


def test_a_part_survives_its_files(tmp_path):
    for name in ("rod_088", "tee_080"):
        part = PARTS[name]
        read = load_part(save_part(part, tmp_path))
        assert (read.name, read.family) == (part.name, part.family)
        assert read.mass == pytest.approx(part.mass, abs=1e-6)
        np.testing.assert_allclose(read.inertia, part.inertia, rtol=1e-5, atol=1e-12)
        assert read.mesh.is_watertight  # after float32 and merging, as every reader will
        assert read.mesh.volume == pytest.approx(part.mesh.volume, rel=1e-5)
        assert len(read.pieces) == len(part.pieces)


def test_making_the_library_twice_gives_the_same_files(tmp_path):
    make_library(CONFIG, tmp_path / "a")
    make_library(CONFIG, tmp_path / "b")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) > 100
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def describe(folder, solid, **keys):
    solid.export(folder / "part.stl")
    description = {"name": "knob", "mesh": "part.stl", "unit": "mm", "density": 1200, **keys}
    path = folder / "part.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in description.items() if v is not None}))
    return path


def test_a_user_part_gets_the_library_format(tmp_path):
    angle = trimesh.creation.box((60, 20, 10)).union(
        trimesh.creation.box((20, 20, 40), trimesh.transformations.translation_matrix((20, 0, 15)))
    )
    part = add_part(describe(tmp_path, angle), tmp_path / "library")
    read = load_part(tmp_path / "library" / "knob")
    assert read.family == "knob"
    assert read.mass == pytest.approx(1200 * angle.volume * 1e-9, rel=1e-5)
    assert len(read.pieces) > 1
    assert sum(piece.volume for piece in part.pieces) == pytest.approx(part.mesh.volume, rel=0.1)


def test_a_given_mass_is_kept(tmp_path):
    box = trimesh.creation.box((60, 20, 10))
    part = add_part(describe(tmp_path, box, density=None, mass=0.25), tmp_path / "library")
    assert part.mass == pytest.approx(0.25)
    assert part.inertia[2, 2] == pytest.approx(0.25 * (0.06**2 + 0.02**2) / 12)


def open_box():
    box = trimesh.creation.box((60, 20, 10))
    return trimesh.Trimesh(box.vertices, box.faces[:-1])


@pytest.mark.parametrize(
    ("mesh", "keys", "says"),
    [
        (open_box(), {}, "not closed (3 open edges)"),
        (trimesh.creation.box((60, 20, 10)), {"unit": "m"}, "60000 mm long"),
        (trimesh.creation.box((60, 20, 10)), {"unit": "m"}, "is it in m?"),
        (trimesh.creation.box((99, 99, 90)), {}, "more than the gripper opens (85 mm)"),
        (trimesh.creation.box((60, 20, 1)), {}, "mm thick"),
        (trimesh.creation.box((60, 20, 10)), {"unit": "inch"}, "none of m, cm, mm"),
        (trimesh.creation.box((60, 20, 10)), {"density": -1}, "positive number"),
        (trimesh.creation.box((60, 20, 10)), {"mass": 9}, "either density"),
        (
            trimesh.creation.box((60, 20, 10)),
            {"density": None, "mass": 9},
            "than the robot carries",
        ),
        (trimesh.creation.box((60, 20, 10)), {"mesh": "none.stl"}, "no such mesh"),
        (trimesh.creation.box((60, 20, 10)), {"mesh": "part.yaml"}, "cannot be read as a mesh"),
        (trimesh.creation.box((60, 20, 10)), {"name": "../knob"}, "letters, digits"),
        (trimesh.creation.box((60, 20, 10)), {"colour": "red"}, "unknown key 'colour'"),
        (trimesh.creation.box((60, 20, 10)), {"unit": None}, "key 'unit' is missing"),
    ],
)
def test_a_bad_user_part_is_refused_in_one_line(tmp_path, mesh, keys, says):
    with pytest.raises(PartError) as error:
        add_part(describe(tmp_path, mesh, **keys), tmp_path / "library")
    assert says in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "library" / "knob").exists()


@pytest.mark.parametrize("content", [b"", b"solid\nendsolid\n", bytes(80) + bytes(4), b"x" * 200])
def test_a_mesh_file_without_a_mesh_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "knob.stl").write_bytes(content)
    with pytest.raises(PartError, match="knob.stl: (holds no triangles|cannot be read)") as error:
        part_from_mesh(tmp_path / "knob.stl", "knob", "mm", density=1200)
    assert "\n" not in str(error.value)


def test_a_user_part_may_not_replace_a_configured_one(tmp_path):
    save_part(PARTS["tee_080"], tmp_path / "library")
    box = trimesh.creation.box((60, 20, 10))
    with pytest.raises(PartError, match="choose another name"):
        add_part(describe(tmp_path, box, name="tee_080"), tmp_path / "library")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1", "parts.yaml"),
        ("prisms: {family: prism, sizes: {}}", "densities"),
        (
            "densities: {steel: 7850}\npiece_tolerance: 0.001\n"
            "prisms: {family: prism, sizes: {p: {material: brass, sides: 3}}}",
            "prisms.sizes.p",
        ),
        (
            "densities: {steel: 7850}\npiece_tolerance: 0.001\n"
            "prisms: {family: prism, sizes: {p: {material: steel, sides: 3, width: 1}}}",
            "prisms.sizes.p",
        ),
        (
            "densities: {steel: 7850}\npiece_tolerance: 0.001\nprisms: {family: prism, sizes: "
            "{p: {material: steel, sides: 3, across: 0.02, length: -0.1}}}",
            "no solid body",
        ),
    ],
)
def test_a_bad_configuration_is_named(tmp_path, text, says):
    config = tmp_path / "parts.yaml"
    config.write_text(text)
    with pytest.raises(PartError) as error:
        make_library(config, tmp_path / "library")
    assert says in str(error.value) and "\n" not in str(error.value)


def test_assets_are_made_once_and_again_when_the_sizes_change(tmp_path):
    config = tmp_path / "parts.yaml"
    config.write_text(CONFIG.read_text())
    made = assets.make_parts(tmp_path / "assets", config)
    assert made == len(PARTS)
    assert assets.make_parts(tmp_path / "assets", config) == 0

    box = trimesh.creation.box((60, 20, 10))
    add_part(describe(tmp_path, box), tmp_path / "assets" / "parts")
    (tmp_path / "part.yaml").unlink()
    config.write_text(CONFIG.read_text().replace("prism_4:", "prism_four:"))
    assert assets.make_parts(tmp_path / "assets", config) == len(PARTS)
    names = {path.name for path in (tmp_path / "assets" / "parts").iterdir()}
    assert "prism_four" in names and "prism_4" not in names
    assert "knob" in names  # a user's part stays
    assert [p.name for p in (tmp_path / "assets").iterdir()] == ["parts"]  # nothing left behind


def test_without_an_index_the_robot_meshes_fail_in_one_line(tmp_path):
    environment = dict(
        os.environ,
        PYTHONPATH=str(ROOT / "src"),
        PIP_CONFIG_FILE=os.devnull,
        PIP_INDEX_URL="http://127.0.0.1:9/simple",
        PIP_EXTRA_INDEX_URL="",
        PIP_FIND_LINKS="",
        PIP_RETRIES="0",
        PIP_TIMEOUT="1",
    )
    result = subprocess.run(
        [sys.executable, "-m", "iwgnet_grasp.assets", "--assets", str(tmp_path / "assets")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1
    assert len(result.stderr.strip().splitlines()) == 1
    assert "cannot download the robot meshes" in result.stderr
    assert not (tmp_path / "assets" / "robot").exists()
