"""Grasps of a ring's wall: one finger stands in the hole, the other outside.

They come from the object's pixels alone. The wall is gripped along the radius, away from the rest
of the part: the outer finger lies on a line of the round outside, the inner one's two edges on the
hole, and the weight has no lever about the closing direction. The paper has none of these: its
networks learn of grasps from outside, which a part between others often has no room for, while its
holes are free.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from iwgnet_grasp.data.grasp_rectangle import wrap_theta
from iwgnet_grasp.perception.types import Box, GraspRectangle

DIRECTIONS = 24  # around a hole
HALF_PAD_PX = 12.0  # half the width of a pad (22 mm), at 1 mm a pixel
MIN_RADIUS_PX = 15.0  # of a hole that a finger fits into: half a pad and its thickness
MAX_RADIUS_PX = 30.0
MAX_WALL_PX = 16.0
ROUNDNESS = 0.6  # least share of its enclosing circle that a hole fills; leaning ones are narrower
MAX_ASIDE = 0.7  # tangent, 35 deg, between a wall's radius and where the rest of the part lies
MIN_OFFSET_PX = 8.0  # of that from the hole: a ring alone does not tell what is hidden of its part
UPPER_PX = 15  # size of the neighbourhood whose highest place ...
UPPER_STEP = 0.005  # m, ... the upper side is less than this below


def rim_grasps(
    mask: np.ndarray, heights: np.ndarray, box: Box, quality: float
) -> list[GraspRectangle]:
    """Grasps, in px of the image, of the walls around the round holes of an object.

    mask: (box.height, box.width) bool, the object's pixels. heights: the same of float32 m over
    the empty scene, NaN unknown. quality: what each is given.
    """
    if mask.size == 0:
        return []
    upper = _upper_side(mask, heights)
    rows, columns = np.nonzero(mask)
    grasps = []
    for x, y in _round_holes(upper):
        # Where the rest of the part lies: beside a closing direction it would turn about that.
        rest = np.array([columns.mean() - x, rows.mean() - y])
        if np.hypot(*rest) < MIN_OFFSET_PX:
            continue
        for k in range(DIRECTIONS):
            angle = 2 * math.pi * k / DIRECTIONS
            c, s = math.cos(angle), math.sin(angle)
            wall = _wall(upper, x, y, c, s)
            if wall is None or abs(rest @ (-s, c)) > -MAX_ASIDE * (rest @ (c, s)):
                continue
            inner, outer = wall
            # The pad's edges meet the hole before its middle does.
            chord = math.sqrt(max(inner**2 - HALF_PAD_PX**2, 0.0))
            middle, width = (outer + chord) / 2, outer - chord
            theta = float(wrap_theta(-angle))  # y points down
            grasps.append(
                GraspRectangle(
                    box.x + x + middle * c, box.y + y + middle * s, theta, width, quality
                )
            )
    return grasps


def _upper_side(mask: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """The object's pixels but those of its walls, which the camera sees beside its axis: they
    would shift a hole's middle by several millimetres."""
    known = np.where(mask & np.isfinite(heights), heights, 0.0).astype(np.float32)
    highest = cv2.dilate(cv2.medianBlur(known, 5), np.ones((UPPER_PX, UPPER_PX), np.uint8))
    return mask & (known > highest - UPPER_STEP)


def _round_holes(mask: np.ndarray) -> list[tuple[float, float]]:
    """Centres (x, y) of the holes of a mask that a finger fits into."""
    closed = cv2.morphologyEx(
        np.pad(mask.astype(np.uint8), 1), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)
    )
    outlines, tree = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    centres = []
    for outline, (_, _, _, parent) in zip(
        outlines, tree[0] if tree is not None else [], strict=True
    ):
        if parent < 0 or len(outline) < 5:  # the outside of a piece
            continue
        (x, y), radius = cv2.minEnclosingCircle(outline)
        area = cv2.contourArea(outline)
        if MIN_RADIUS_PX <= radius <= MAX_RADIUS_PX and area >= ROUNDNESS * math.pi * radius**2:
            centres.append((x - 1, y - 1))
    return centres


def _wall(mask: np.ndarray, x: float, y: float, c: float, s: float) -> tuple[float, float] | None:
    """Where the wall begins and ends, px from a hole's centre (x, y) in the direction (c, s); None
    where there is none or it is too thick to be a wall."""
    steps = np.arange(0.0, MAX_RADIUS_PX + MAX_WALL_PX + 1, 0.5)
    columns, rows = np.rint(x + steps * c).astype(int), np.rint(y + steps * s).astype(int)
    inside = (rows >= 0) & (rows < mask.shape[0]) & (columns >= 0) & (columns < mask.shape[1])
    own = np.zeros(len(steps), bool)
    own[inside] = mask[rows[inside], columns[inside]]
    if not own.any():
        return None
    first = int(np.argmax(own))
    left = np.flatnonzero(~own[first:])
    if not left.size:
        return None
    inner, outer = steps[first], steps[first + int(left[0])]
    fits = inner >= MIN_RADIUS_PX - 2 and 2 <= outer - inner <= MAX_WALL_PX
    return (float(inner), float(outer)) if fits else None
