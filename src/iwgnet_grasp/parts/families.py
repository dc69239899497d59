"""Other parts than rods, for learning: each gives its solid and its exact convex pieces. Metres."""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold

from iwgnet_grasp.parts.solids import along_x, disc, plate, polygon, ring_sectors

ROUND = 24  # corners of a round bar; it is convex, so its piece is the bar itself


@dataclass(frozen=True)
class HexBolt:
    """Head at x < 0, plain shank along x."""

    diameter: float
    length: float
    head_width: float  # across flats
    head_height: float

    def pieces(self, tolerance: float) -> list[Manifold]:
        across_corners = self.head_width / np.cos(np.pi / 6)
        head = along_x(disc(across_corners, segments=6).extrude(self.head_height))
        shank = along_x(disc(self.diameter, segments=ROUND).extrude(self.length))
        return [head.translate((-self.head_height, 0.0, 0.0)), shank]

    def solid(self) -> Manifold:
        return sum_of(self.pieces(0.0))


@dataclass(frozen=True)
class Bracket:
    """Two plates at a right angle (along x and y), a gusset between them; width along z."""

    legs: tuple[float, float]
    width: float
    plate: float
    gusset: float

    def pieces(self, tolerance: float) -> list[Manifold]:
        (a, b), t = self.legs, self.plate
        reach = 0.6 * min(a, b)
        return [
            plate(polygon([(0, 0), (a, 0), (a, t), (0, t)]), self.width),
            plate(polygon([(0, 0), (t, 0), (t, b), (0, b)]), self.width),
            plate(
                polygon([(t / 2, t / 2), (reach, t / 2), (reach, t), (t, reach), (t / 2, reach)]),
                self.gusset,
            ),
        ]

    def solid(self) -> Manifold:
        return sum_of(self.pieces(0.0))


@dataclass(frozen=True)
class Flange:
    """A disc with a hub on it and one bore through both, along z."""

    diameter: float
    bore: float
    disc: float  # thickness
    hub_diameter: float
    hub_height: float  # above the disc

    def solid(self) -> Manifold:
        body = plate(disc(self.diameter, segments=64), self.disc, bottom=0.0)
        body += plate(disc(self.hub_diameter), self.disc + self.hub_height, bottom=0.0)
        return body - plate(disc(self.bore), 1.0)

    def pieces(self, tolerance: float) -> list[Manifold]:
        height = self.disc + self.hub_height
        rim = ring_sectors(self.bore, self.diameter, tolerance)
        hub = ring_sectors(self.bore, self.hub_diameter, tolerance)
        return [plate(s, self.disc, bottom=0.0) for s in rim] + [
            plate(s, height, bottom=0.0) for s in hub
        ]


@dataclass(frozen=True)
class Tee:
    """A round bar along x with a round stem along y."""

    bar_diameter: float
    bar_length: float
    stem_diameter: float
    stem_length: float  # from the bar's axis

    def pieces(self, tolerance: float) -> list[Manifold]:
        bar = along_x(disc(self.bar_diameter, segments=ROUND).extrude(self.bar_length))
        stem = disc(self.stem_diameter, segments=ROUND).extrude(self.stem_length)
        return [
            bar.translate((-self.bar_length / 2, 0.0, 0.0)),
            stem.rotate((-90.0, 0.0, 0.0)),
        ]

    def solid(self) -> Manifold:
        return sum_of(self.pieces(0.0))


@dataclass(frozen=True)
class Prism:
    """A bar of regular cross section along x."""

    sides: int
    across: float  # diameter of the circumscribed circle
    length: float

    def pieces(self, tolerance: float) -> list[Manifold]:
        return [along_x(disc(self.across, segments=self.sides).extrude(self.length))]

    def solid(self) -> Manifold:
        return self.pieces(0.0)[0]


@dataclass(frozen=True)
class TurnedPart:
    """Coaxial cylinders, one on the other along z, with a bore through all of them."""

    steps: tuple[tuple[float, float], ...]  # diameter, length; from below
    bore: float  # 0: none

    def solid(self) -> Manifold:
        body = sum_of(self._stacked([[disc(d)] for d, _ in self.steps]))
        return body - plate(disc(self.bore), 1.0) if self.bore else body

    def pieces(self, tolerance: float) -> list[Manifold]:
        if not self.bore:
            return self._stacked([[disc(d, segments=ROUND)] for d, _ in self.steps])
        return self._stacked([ring_sectors(self.bore, d, tolerance) for d, _ in self.steps])

    def _stacked(self, outlines: list[list[CrossSection]]) -> list[Manifold]:
        bottom, solids = 0.0, []
        for step, (_, length) in zip(outlines, self.steps, strict=True):
            solids += [plate(outline, length, bottom) for outline in step]
            bottom += length
        return solids


@dataclass(frozen=True)
class Elbow:
    """Two round bars that meet at the origin: one along x, one turned from it about z."""

    diameter: float
    legs: tuple[float, float]
    angle: float  # deg between them

    def pieces(self, tolerance: float) -> list[Manifold]:
        first, second = (
            along_x(disc(self.diameter, segments=ROUND).extrude(length + self.diameter / 2))
            for length in self.legs
        )
        inwards = (-self.diameter / 2, 0.0, 0.0)  # so that the corner is filled
        return [first.translate(inwards), second.translate(inwards).rotate((0.0, 0.0, self.angle))]

    def solid(self) -> Manifold:
        return sum_of(self.pieces(0.0))


def sum_of(solids: list[Manifold]) -> Manifold:
    """The union."""
    body = solids[0]
    for solid in solids[1:]:
        body += solid
    return body
