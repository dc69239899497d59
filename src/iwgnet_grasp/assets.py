"""Meshes that are not kept in the repository: `python -m iwgnet_grasp.assets`.

Writes below assets/ (git-ignored):

- robot/ur5, robot/robotiq_2f_85: the meshes that urdf/cell.urdf names, taken out of two wheels of
  PyPI, in metres, with their licences;
- parts: the part library that config/parts.yaml describes (see iwgnet_grasp.parts).

A second run with nothing changed only compares two digests. Every folder is made beside its
place and renamed into it, so that a run that was cut off leaves no half-made library.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_UR5 = "cmeel.prefix/share/example-robot-data/robots/ur_description/meshes/ur5"
_2F85 = "airo_models/grippers/robotiq_2f_85/meshes"
_UR5_LINKS = ("base", "shoulder", "upperarm", "forearm", "wrist1", "wrist2", "wrist3")
_2F85_LINKS = ("outer_knuckle", "outer_finger", "inner_knuckle", "inner_finger")

# requirement -> {file in the wheel: (file below assets/robot, factor to metres)}; files whose
# suffix changes are converted.
WHEELS = {
    "example-robot-data==6.0.0": {
        **{
            f"{_UR5}/{kind}/{link}.{suffix}": (f"ur5/{kind}/{link}.{suffix}", 1.0)
            for kind, suffix in (("visual", "dae"), ("collision", "stl"))
            for link in _UR5_LINKS
        },
        "example_robot_data-6.0.0.dist-info/licenses/LICENSE": ("ur5/LICENSE", 1.0),
    },
    "airo-models==0.0.12": {
        f"{_2F85}/visual/robotiq_arg2f_85_base_link.obj": (
            "robotiq_2f_85/visual/base_link.stl",
            1.0,
        ),
        f"{_2F85}/collision/robotiq_arg2f_base_link.obj": (
            "robotiq_2f_85/collision/base_link.stl",
            1.0,
        ),
        **{
            f"{_2F85}/{kind}/robotiq_arg2f_85_{link}.obj": (
                f"robotiq_2f_85/{kind}/{link}.stl",
                0.001,
            )
            for kind in ("visual", "collision")
            for link in _2F85_LINKS
        },
        "airo_models-0.0.12.dist-info/licenses/LICENSE": ("robotiq_2f_85/LICENSE", 1.0),
    },
}


class AssetError(RuntimeError):
    """One line: what could not be made and what to do."""


def digest(*inputs: Path | str) -> str:
    """SHA-256 over texts and the contents of files."""
    h = hashlib.sha256()
    for item in inputs:
        h.update(item.read_bytes() if isinstance(item, Path) else item.encode())
        h.update(b"\0")
    return h.hexdigest()


def is_current(folder: Path, wanted: str) -> bool:
    """Whether `folder` was made from inputs with the digest `wanted`."""
    stamp = folder / ".digest"
    return stamp.is_file() and stamp.read_text().strip() == wanted


def replace_folder(made: Path, place: Path) -> None:
    """Renames `made` to `place`; what was there goes away afterwards, never before."""
    place.parent.mkdir(parents=True, exist_ok=True)
    old = place.with_name(f".{place.name}.old-{os.getpid()}")
    if place.exists():
        place.rename(old)
    made.rename(place)
    shutil.rmtree(old, ignore_errors=True)


def _download(requirement: str, folder: Path) -> Path:
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
    ]
    command += ["--disable-pip-version-check", "--dest", str(folder), requirement]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = list(folder.glob(requirement.split("==")[0].replace("-", "_") + "-*.whl"))
    if result.returncode != 0 or len(wheels) != 1:
        lines = [line for line in result.stderr.splitlines() if line.startswith("ERROR")]
        why = lines[-1].removeprefix("ERROR: ") if lines else f"pip ended with {result.returncode}"
        raise AssetError(
            f"cannot download the robot meshes ({requirement}): {why}; "
            "check the network or pip's index and run scripts/setup again"
        )
    return wheels[0]


def _place(data: bytes, source: str, target: Path, to_metres: float) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if Path(source).suffix in (target.suffix, ""):
        target.write_bytes(data)
        return
    import io

    import trimesh

    mesh = trimesh.load(io.BytesIO(data), file_type=Path(source).suffix[1:], force="mesh")
    mesh.apply_scale(to_metres)
    mesh.export(target, file_type="stl")


def make_robot(assets: Path) -> bool:
    """Makes assets/robot. Returns whether there was anything to do. Raises AssetError."""
    place = assets / "robot"
    wanted = digest(repr(WHEELS), "1")
    if is_current(place, wanted):
        return False
    assets.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=assets, prefix=".robot-") as temporary:
        made = Path(temporary) / "robot"
        for requirement, files in WHEELS.items():
            wheel = _download(requirement, Path(temporary))
            with zipfile.ZipFile(wheel) as archive:
                for source, (target, to_metres) in files.items():
                    try:
                        data = archive.read(source)
                    except KeyError:
                        raise AssetError(
                            f"{wheel.name} has no {source}; is the pin in assets.py right?"
                        ) from None
                    _place(data, source, made / target, to_metres)
            wheel.unlink()
        (made / ".digest").write_text(wanted + "\n")
        replace_folder(made, place)
    return True


def make_parts(assets: Path, config: Path = ROOT / "config" / "parts.yaml") -> int:
    """Makes assets/parts, keeping parts that a user added. Returns how many parts it made, 0 when
    the library was up to date. Raises AssetError."""
    place = assets / "parts"
    sources = sorted((Path(__file__).parent / "parts").glob("[!_]*.py"))
    wanted = digest(config if config.is_file() else "", *sources)
    if is_current(place, wanted):
        return 0
    from iwgnet_grasp.parts import library

    assets.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=assets, prefix=".parts-") as temporary:
        made = Path(temporary) / "parts"
        try:
            count = library.make_library(config, made)
        except library.PartError as error:
            raise AssetError(str(error)) from None
        library.keep_user_parts(place, made)
        (made / ".digest").write_text(wanted + "\n")
        replace_folder(made, place)
    return count


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m iwgnet_grasp.assets", description="Make the meshes below assets/."
    )
    parser.add_argument("--assets", type=Path, default=ROOT / "assets", help="default: %(default)s")
    arguments = parser.parse_args()
    try:
        if make_robot(arguments.assets):
            print(f"robot meshes: {arguments.assets / 'robot'}")
        if count := make_parts(arguments.assets):
            print(f"{count} parts: {arguments.assets / 'parts'}")
    except (AssetError, OSError) as error:
        print(f"assets: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
