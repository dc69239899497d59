"""Parts: parametric solids, their convex pieces, and the library that holds them on disk.

`python -m iwgnet_grasp.parts --help` lists, draws and adds parts."""

from iwgnet_grasp.parts.library import (
    Part,
    PartError,
    add_part,
    configured_parts,
    load_part,
    make_library,
    save_part,
)

__all__ = [
    "Part",
    "PartError",
    "add_part",
    "configured_parts",
    "load_part",
    "make_library",
    "save_part",
]
