"""`python -m iwgnet_grasp.parts`: lists, draws and adds parts of the library."""

import argparse
import sys
from pathlib import Path

from iwgnet_grasp.parts.library import Part, PartError, add_part, load_part

LIBRARY = Path(__file__).resolve().parents[3] / "assets" / "parts"


def _line(part: Part) -> str:
    size = " x ".join(f"{1e3 * e:.0f}" for e in part.mesh.extents)
    return (
        f"{part.name:18} {part.family:22} {part.mass:6.3f} kg  {size:14} mm  "
        f"{len(part.mesh.faces)} triangles, {len(part.pieces)} convex pieces"
    )


def _load(library: Path, names: list[str]) -> list[Part]:
    known = sorted(path.parent.name for path in library.glob("*/part.yaml"))
    if not known:
        raise PartError(f"{library}: no parts there; run scripts/setup")
    for name in names:
        if name not in known:
            raise PartError(f"no part '{name}' in {library}; there are {', '.join(known)}")
    return [load_part(library / name) for name in names or known]


def draw(parts: list[Part], path: Path) -> None:
    """Writes a picture of each part's mesh and, beside it, of its convex pieces."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    light = np.array([0.3, -0.4, 0.87])
    columns = 3
    rows = -(-len(parts) // columns)
    figure = plt.figure(figsize=(6 * columns, 3 * rows))
    for i, part in enumerate(parts):
        half = part.mesh.extents.max() / 2
        pieces = [(piece, plt.cm.tab20(k % 20)[:3]) for k, piece in enumerate(part.pieces)]
        for j, meshes in enumerate(([(part.mesh, (0.75, 0.77, 0.8))], pieces)):
            axes = figure.add_subplot(rows, 2 * columns, 2 * i + j + 1, projection="3d")
            for mesh, colour in meshes:
                shade = 0.35 + 0.65 * np.clip(mesh.face_normals @ light, 0, 1)
                faces = Poly3DCollection(mesh.triangles)
                faces.set_facecolor(shade[:, None] * np.array(colour))
                axes.add_collection3d(faces)
            axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half))
            axes.set_axis_off()
            axes.view_init(50, -65)
            axes.set_box_aspect((1, 1, 1), zoom=1.4)
            if j == 0:
                axes.set_title(part.name)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m iwgnet_grasp.parts", description=__doc__)
    parser.add_argument("--library", type=Path, default=LIBRARY, help="default: %(default)s")
    commands = parser.add_subparsers(dest="command", required=True)
    listing = commands.add_parser("list", help="one line a part")
    listing.add_argument("names", nargs="*", metavar="NAME")
    drawing = commands.add_parser("draw", help="picture of meshes and convex pieces")
    drawing.add_argument("picture", type=Path, metavar="FILE.png")
    drawing.add_argument("names", nargs="*", metavar="NAME")
    adding = commands.add_parser(
        "add",
        help="add a mesh of your own",
        description="The YAML holds name, mesh (file beside it), unit (m, cm or mm), density "
        "(kg/m^3) or mass (kg), and family if it is to differ from the name.",
    )
    adding.add_argument("description", type=Path, metavar="FILE.yaml")
    arguments = parser.parse_args()
    try:
        if arguments.command == "add":
            print(_line(add_part(arguments.description, arguments.library)))
        elif arguments.command == "draw":
            draw(_load(arguments.library, arguments.names), arguments.picture)
            print(arguments.picture)
        else:
            for part in _load(arguments.library, arguments.names):
                print(_line(part))
    except (PartError, OSError) as error:
        print(f"parts: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
