"""Piston connecting rods: two bored ends, an I-beam shank, bolted lugs at the big end."""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold

from iwgnet_grasp.parts.solids import along_x, disc, filled_corners, plate, polygon, ring_sectors

BOLT_HEAD = 0.009  # m across corners: M6, as in engines of this size
BOLT_HEAD_HEIGHT = 0.004  # m
FILLET = 0.006  # m, where the shank meets the ends; half of it at the lugs
TANGENT_GAP = 0.0004  # m


@dataclass(frozen=True)
class ConnectingRod:
    """Sizes as in config/parts.yaml, m. Big bore's axis at the origin, small bore's at
    x = centre_distance, both along z."""

    centre_distance: float
    big_bore: float
    big_wall: float
    small_bore: float
    small_wall: float
    big_thickness: float
    small_thickness: float
    shank_thickness: float
    shank_width: tuple[float, float]  # small end, big end
    web: float
    rib: float
    lug: tuple[float, float]  # reach, length

    @property
    def big_diameter(self) -> float:
        return self.big_bore + 2 * self.big_wall

    @property
    def small_diameter(self) -> float:
        return self.small_bore + 2 * self.small_wall

    def _width(self, x: float) -> float:
        small, big = self.shank_width
        return big + (small - big) * x / self.centre_distance

    def _shank(self, x0: float, x1: float, inset: float = 0.0) -> CrossSection:
        a, b = self._width(x0) / 2 - inset, self._width(x1) / 2 - inset
        return polygon([(x0, -a), (x0, a), (x1, b), (x1, -b)])

    def _recess(self) -> tuple[float, float]:
        """Where the pockets of the I-beam begin and end along x."""
        return (
            self.big_diameter / 2 + 0.006,
            self.centre_distance - self.small_diameter / 2 - 0.004,
        )

    def _lugs(self) -> list[CrossSection]:
        reach, length = self.lug
        bore, end = self.big_bore / 2, self.big_diameter / 2 + reach
        x = length / 2
        return [
            polygon([(-x, s * bore), (x, s * bore), (x, s * end), (-x, s * end)]) for s in (1, -1)
        ]

    def _bolt_heads(self) -> list[Manifold]:
        reach, length = self.lug
        y = self.big_diameter / 2 + reach - BOLT_HEAD / 2 - 0.0005
        head = along_x(disc(BOLT_HEAD, segments=6).extrude(BOLT_HEAD_HEIGHT + 0.001))
        return [head.translate((-length / 2 - BOLT_HEAD_HEIGHT, s * y, 0.0)) for s in (1, -1)]

    def solid(self) -> Manifold:
        small_centre = (self.centre_distance, 0.0)
        big = disc(self.big_diameter, segments=64)
        small = disc(self.small_diameter, small_centre)
        # Fillets are rolled on slightly smaller discs: outlines that touch in a tangent would
        # leave slivers of triangles.
        big_core = disc(self.big_diameter - TANGENT_GAP, segments=64)
        small_core = disc(self.small_diameter - TANGENT_GAP, small_centre)
        shank = filled_corners(
            big_core + small_core + self._shank(0.0, self.centre_distance), FILLET
        )
        lugs = self._lugs()
        ends = big + filled_corners(big_core + lugs[0] + lugs[1], FILLET / 2)
        x0, x1 = self._recess()
        pocket = self._shank(x0, x1, self.rib)
        # Round its ends as the milling cutter leaves them.
        radius = 0.6 * min(self._width(x0), self._width(x1)) / 2 - 0.6 * self.rib
        pocket = pocket.offset(-radius).offset(radius, circular_segments=24)
        depth = (self.shank_thickness - self.web) / 2
        body = (
            plate(shank, self.shank_thickness)
            + plate(ends, self.big_thickness)
            + plate(small, self.small_thickness)
        )
        for head in self._bolt_heads():
            body += head
        body -= plate(disc(self.big_bore, segments=64), 1.0)
        body -= plate(disc(self.small_bore, small_centre), 1.0)
        body -= plate(pocket, depth, bottom=self.web / 2)
        body -= plate(pocket, depth, bottom=-self.web / 2 - depth)
        return body

    def pieces(self, tolerance: float) -> list[Manifold]:
        """Convex pieces that leave bores and recesses open."""
        small_centre = (self.centre_distance, 0.0)
        pieces = [
            plate(s, self.big_thickness)
            for s in ring_sectors(self.big_bore, self.big_diameter, tolerance)
        ]
        pieces += [
            plate(s, self.small_thickness)
            for s in ring_sectors(self.small_bore, self.small_diameter, tolerance, small_centre)
        ]
        # Lugs begin at the height where the ring's material begins beside the bore.
        pieces += [plate(lug, self.big_thickness) for lug in self._lugs()]
        pieces += self._bolt_heads()

        # The shank: whole beside the ends, two ribs and a web between.
        x0, x1 = self._recess()
        begin = self.big_bore / 2 + self.big_wall / 2
        end = self.centre_distance - self.small_bore / 2 - self.small_wall / 2
        pieces.append(plate(self._shank(x0, x1), self.web))
        for s in (1, -1):
            a, b = s * self._width(begin) / 2, s * self._width(end) / 2
            rib = polygon(
                [(begin, a), (end, b), (begin, a - s * self.rib), (end, b - s * self.rib)]
            )
            pieces.append(plate(rib, self.shank_thickness))
        # Roots with the fillets that widen them.
        flare = 0.0015
        a = self._width(begin) / 2
        pieces.append(
            plate(
                polygon([(begin, a + flare), (begin, -a - flare), (x0, a), (x0, -a)]),
                self.shank_thickness,
            )
        )
        b = self._width(end) / 2
        reach = np.sqrt((self.small_diameter / 2) ** 2 - (self.centre_distance - end) ** 2)
        b_end = min(b + 0.002, reach)
        pieces.append(
            plate(polygon([(end, b_end), (end, -b_end), (x1, b), (x1, -b)]), self.shank_thickness)
        )
        return pieces
