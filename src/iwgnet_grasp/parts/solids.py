"""Exact solids from manifold3d and the convex pieces that stand for them in physics. Metres."""

from collections.abc import Sequence

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

Point = Sequence[float]

DETAIL = 1e-5  # m


def polygon(points: Sequence[Point]) -> CrossSection:
    """A convex polygon, corners in any order."""
    return CrossSection.hull_points([tuple(map(float, p)) for p in points])


def disc(diameter: float, centre: Point = (0.0, 0.0), segments: int = 48) -> CrossSection:
    """A circle; its corners lie on the circle."""
    return CrossSection.circle(diameter / 2, segments).translate(tuple(centre))


def plate(outline: CrossSection, thickness: float, bottom: float | None = None) -> Manifold:
    """The outline extruded along z, about z = 0 unless `bottom` is given."""
    bottom = -thickness / 2 if bottom is None else bottom
    return outline.extrude(thickness).translate((0.0, 0.0, bottom))


def along_x(solid: Manifold) -> Manifold:
    """Turns z to x (and x to y, y to z)."""
    return solid.transform([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])


def filled_corners(outline: CrossSection, radius: float) -> CrossSection:
    """Rounds the concave corners."""
    return outline.offset(radius, circular_segments=48).offset(-radius, circular_segments=48)


def sectors(radius: float, tolerance: float) -> int:
    """Into how many convex pieces a ring is cut so that their inner faces stray from the bore by
    at most `tolerance` (m), see ring_sectors."""
    n = 6
    while radius * np.tan(np.pi / n / 2) ** 2 > tolerance:
        n += 1
    return n


def ring_sectors(
    bore: float, diameter: float, tolerance: float, centre: Point = (0.0, 0.0)
) -> list[CrossSection]:
    """Convex sectors of a ring; the bore stays open.

    The inner face of a convex sector is a chord. Its corners lie as far outside the bore's circle
    as its middle lies inside: by r (1 - c) / (1 + c) = r tan^2(pi / 2n), with c = cos(pi / n)."""
    inner, outer = bore / 2, diameter / 2
    n = sectors(inner, tolerance)
    inner *= 2 / (1 + np.cos(np.pi / n))
    pieces = []
    for i in range(n):
        arc = 2 * np.pi * (i + np.linspace(0, 1, 4)) / n
        rim = [(outer * np.cos(a), outer * np.sin(a)) for a in arc]
        ends = [(inner * np.cos(a), inner * np.sin(a)) for a in (arc[0], arc[-1])]
        pieces.append(polygon(rim + ends).translate(tuple(centre)))
    return pieces


def to_trimesh(solid: Manifold) -> trimesh.Trimesh:
    """Faces counter-clockwise seen from outside. Features below DETAIL are dropped, so that the
    mesh stays closed when its vertices are rounded to float32 and merged."""
    mesh = solid.simplify(DETAIL).to_mesh64()
    return trimesh.Trimesh(
        vertices=np.asarray(mesh.vert_properties)[:, :3], faces=np.asarray(mesh.tri_verts)
    )


def to_manifold(mesh: trimesh.Trimesh) -> Manifold:
    """The solid of a closed mesh."""
    from manifold3d import Mesh64

    return Manifold(
        Mesh64(
            vert_properties=np.ascontiguousarray(mesh.vertices, dtype=np.float64),
            tri_verts=np.ascontiguousarray(mesh.faces, dtype=np.uint64),
        )
    )
