"""Depth of one object in the empty scene (Step 2 of section 4.2, Fig. 8) and its pixels."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import cv2
import numpy as np

from iwgnet_grasp.perception.types import (
    NOBODY,
    Box,
    Detection,
    GraspRectangle,
    PerceptionError,
    Window,
)

OUTLINE_PX = 9  # twice the width of the strip around a part that tells what lies on it
EDGE_PX = 5  # what is narrower is the edge of an object whose mask ends a little inside it
# From one side of a border to the other, px (down, right): masks of two objects end a little apart.
BORDER_STEPS = ((0, 6), (6, 0), (4, 4), (-4, 4))
MIN_PLANE_PX = 50
PLANE_SCALE = 0.003  # m from an object's plane that leave half of a pixel's weight
LINE_PX = 3.0  # half the width of the band between the jaws that tells whose grasp it is
LINE_SAMPLES = 25  # along it


def metres(depth: np.ndarray, name: str = "depth") -> np.ndarray:
    """Depth image in float32 metres, NaN where invalid (0, negative or not finite).

    Accepts float32/float64 metres and uint16 millimetres, (H, W). Raises PerceptionError.
    """
    depth = np.asarray(depth)
    if depth.ndim != 2 or depth.size == 0:
        raise PerceptionError(f"{name}: shape {depth.shape} is not an image (H, W)")
    if depth.dtype == np.uint16:
        depth = depth.astype(np.float32) * np.float32(1e-3)
    elif depth.dtype in (np.float32, np.float64):
        depth = depth.astype(np.float32)
    else:
        raise PerceptionError(
            f"{name}: type {depth.dtype} is no depth; give 32FC1 metres or 16UC1 millimetres"
        )
    invalid = ~(np.isfinite(depth) & (depth > 0))
    if invalid.all():
        raise PerceptionError(f"{name}: no pixel holds a valid depth; check the depth camera")
    depth[invalid] = np.nan
    return depth


def merge(depth: np.ndarray, empty_depth: np.ndarray, box: Box) -> np.ndarray:
    """The empty scene's depth with the box's part of `depth` pasted in (Fig. 8b), (H, W) m.

    Beyond the paper, what lies outside the box is kept as an obstacle, mirrored at the empty
    scene: a neighbour becomes a pit as deep as it is high. The network sees what bars fingers and
    palm (the 2F-85 reaches 75 mm beyond the grasp) and cannot take it for the object.
    A pixel of the box that was not measured stays NaN: the grasp network fills holes itself, in
    the same way as it did in training. A pixel that only the empty scene lacks stays NaN too;
    outside the box an unmeasured pixel shows the empty scene.
    """
    merged = 2 * empty_depth - depth
    unmeasured = np.isnan(depth)
    merged[unmeasured] = empty_depth[unmeasured]
    merged[box.slices] = depth[box.slices]
    return merged


def crop_window(depth: np.ndarray, empty_depth: np.ndarray, box: Box, size: int) -> Window:
    """The (size, size) window of the merged depth around the box's middle, at native resolution.

    At the border of the image the window is moved inwards, so that it never leaves the image.
    Raises PerceptionError when the image is smaller than the window.
    """
    height, width = depth.shape
    if size > min(height, width):
        raise PerceptionError(
            f"depth: {width}x{height} px is smaller than the grasp network's window of {size} px"
        )
    u, v = box.center
    x = min(max(round(u - (size - 1) / 2), 0), width - size)
    y = min(max(round(v - (size - 1) / 2), 0), height - size)
    window = slice(y, y + size), slice(x, x + size)
    empty = empty_depth[window].copy()
    inside = Box(
        max(box.x - x, 0),
        max(box.y - y, 0),
        min(box.x + box.width - x, size) - max(box.x - x, 0),
        min(box.y + box.height - y, size) - max(box.y - y, 0),
    )
    return Window(x, y, merge(depth[window], empty, inside), empty)


def object_mask(
    depth: np.ndarray, empty_depth: np.ndarray, box: Box, min_height: float
) -> np.ndarray:
    """Valid pixels of Eq. 18-19 in the box, (box.height, box.width) bool.

    Valid are the pixels that were measured and lie more than `min_height` (m) before the empty
    scene; the table seen in the box says nothing about the object. Where the empty scene has no
    depth of its own, its median over the box stands in.
    """
    measured = depth[box.slices]
    empty = empty_depth[box.slices]
    known = np.isfinite(empty)
    if not known.all():
        if not known.any():
            return np.zeros(measured.shape, bool)
        empty = np.where(known, empty, np.median(empty[known]))
    with np.errstate(invalid="ignore"):
        return empty - measured > min_height


def standing(
    heights: np.ndarray, empty_depth: np.ndarray, part: Box, min_height: float
) -> Box | None:
    """The box, in a part of the image, of what is higher over the empty scene than min_height (m)
    or was not measured where the empty scene was; specks apart. None where nothing is.

    heights: (H, W) m (grasp_view.without_gaps); empty_depth: (H, W) m.
    """
    height, empty = heights[part.slices], empty_depth[part.slices]
    there = np.where(np.isnan(height), np.isfinite(empty), height > min_height).astype(np.uint8)
    there = cv2.morphologyEx(there, cv2.MORPH_OPEN, np.ones((EDGE_PX, EDGE_PX), np.uint8))
    x, y, width, height = cv2.boundingRect(there)
    return Box(part.x + x, part.y + y, width, height) if width else None


def distinct_objects(
    logits: np.ndarray,
    windows: Sequence[Window],
    detections: Sequence[Detection],
    seen: np.ndarray,
    sure_score: float,
    min_new_share: float,
    min_new_pixels: int,
) -> list[int]:
    """Indices of the detections that show an object of their own, in the order given (best first).

    Of the pixels that a detection's mask claims at least min_new_share must be claimed by none
    before it, or it is another box of theirs; one below sure_score must claim min_new_pixels new
    ones: it counts for what no other explains. logits: (N, S, S) as for pixel_owners(); seen:
    (H, W) bool, where anything stands on the table.
    """
    claimed = np.zeros(seen.shape, bool)
    distinct = []
    for i, (logit, window, detection) in enumerate(zip(logits, windows, detections, strict=True)):
        region, inside = _in_box(logit, window, detection.box)
        own = (inside > 0) & seen[region]
        new = np.count_nonzero(own & ~claimed[region])
        enough = detection.score >= sure_score or new >= min_new_pixels
        if enough and new >= min_new_share * np.count_nonzero(own):
            distinct.append(i)
            claimed[region] |= own
    return distinct


def pixel_owners(
    logits: np.ndarray, windows: Sequence[Window], boxes: Sequence[Box], shape: tuple[int, int]
) -> np.ndarray:
    """(H, W) int16: index of the object that each pixel shows, NOBODY where none is likely.

    logits: (N, S, S) of each object's window (networks.object_mask). Of objects that claim the same
    pixel the likeliest has it; none has pixels outside its box.
    """
    owners = np.full(shape, NOBODY, np.int16)
    best = np.zeros(shape, np.float32)
    for i, (logit, window, box) in enumerate(zip(logits, windows, boxes, strict=True)):
        region, inside = _in_box(logit, window, box)
        more = inside > best[region]
        best[region][more] = inside[more]
        owners[region][more] = i
    return owners


def unexplained_surfaces(
    seen: np.ndarray, owners: np.ndarray, min_pixels: int
) -> list[tuple[Box, np.ndarray]]:
    """What stands on the table and no object owns, in connected pieces of at least min_pixels: the
    box of each and its pixels in it, (box.height, box.width) bool."""
    left = (seen & (owners == NOBODY)).astype(np.uint8)
    left = cv2.morphologyEx(left, cv2.MORPH_OPEN, np.ones((EDGE_PX, EDGE_PX), np.uint8))
    _, pieces, statistics, _ = cv2.connectedComponentsWithStats(left)
    found = []
    for i, (x, y, width, height, pixels) in enumerate(statistics.tolist()):
        if i and pixels >= min_pixels:  # 0 is the background
            box = Box(x, y, width, height)
            found.append((box, pieces[box.slices] == i))
    return found


def same_parts(alike: np.ndarray, sure: Sequence[bool], least: float) -> list[list[int]]:
    """Pieces of what stands on the table in groups, one a part, by the piece that comes first.

    alike: (K, K), how likely piece j shows the part of piece i, NaN where i was not asked; a pair's
    likelihood is the mean of what is known of it, and likelier pairs are joined first, from `least`
    on. Two pieces that are `sure` to be parts of their own never come into one group.
    """
    group = list(range(len(alike)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pairs that nothing is known of
        pair = np.nanmean([alike, alike.T], axis=0)
    first, second = np.nonzero(np.triu(np.nan_to_num(pair) >= least, 1))
    for i in np.argsort(-pair[first, second], kind="stable"):
        a, b = sorted((group[first[i]], group[second[i]]))
        if a != b and not (_any_sure(group, sure, a) and _any_sure(group, sure, b)):
            group = [a if g == b else g for g in group]
    return [[i for i, g in enumerate(group) if g == k] for k in sorted(set(group))]


def _any_sure(group: Sequence[int], sure: Sequence[bool], which: int) -> bool:
    return any(s for g, s in zip(group, sure, strict=True) if g == which)


def around_all(mask: np.ndarray) -> Box:
    """The box around all pixels of a mask (H, W) bool, which has some."""
    return Box(*cv2.boundingRect(mask.astype(np.uint8)))


def union(boxes: Sequence[Box]) -> Box:
    """The box around boxes."""
    left, top = min(b.x for b in boxes), min(b.y for b in boxes)
    right = max(b.x + b.width for b in boxes)
    return Box(left, top, right - left, max(b.y + b.height for b in boxes) - top)


def _in_box(logit: np.ndarray, window: Window, box: Box) -> tuple[tuple[slice, slice], np.ndarray]:
    """The part of the image that a window and its object's box share, and the logits there."""
    rows = slice(max(box.y, window.y), min(box.y + box.height, window.y + len(logit)))
    columns = slice(max(box.x, window.x), min(box.x + box.width, window.x + len(logit)))
    inside = logit[
        rows.start - window.y : rows.stop - window.y,
        columns.start - window.x : columns.stop - window.x,
    ]
    return (rows, columns), inside


def own_share(seen: np.ndarray, mask: np.ndarray, box: Box, grasp: GraspRectangle) -> float:
    """Share of the pixels between a grasp's jaws that show the object, of those that show any
    (`seen`: object_mask()); 0 where none does. seen, mask: (box.height, box.width) bool."""
    along = np.linspace(-0.5, 0.5, LINE_SAMPLES) * grasp.width_px
    across = np.array([[-LINE_PX], [0.0], [LINE_PX]])
    c, s = np.cos(grasp.theta_rad), -np.sin(grasp.theta_rad)
    columns = np.rint(grasp.x_px - box.x + along * c - across * s).astype(int)
    rows = np.rint(grasp.y_px - box.y + along * s + across * c).astype(int)
    inside = (rows >= 0) & (rows < box.height) & (columns >= 0) & (columns < box.width)
    at = rows[inside], columns[inside]
    return np.count_nonzero(mask[at]) / max(np.count_nonzero(seen[at]), 1)


def taken_away(
    depth: np.ndarray,
    empty_depth: np.ndarray,
    owners: np.ndarray,
    taken: Sequence[int],
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m) and owners, (H, W) each, as they would be without some objects.

    In place of their pixels and of the strip around them that no other object claims (their edges)
    comes what lies beneath: the rest of an object that is seen beside them, else the empty scene.
    An object goes on in its plane between the pixels of it that border on what was taken, where
    the plane runs more than `step` (m) below that.
    """
    gone = np.isin(owners, list(taken))
    strip = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (OUTLINE_PX, OUTLINE_PX))
    gone |= cv2.dilate(gone.astype(np.uint8), strip).astype(bool) & (owners == NOBODY)
    left = np.where(gone, empty_depth, depth)
    left_owners = np.where(gone, NOBODY, owners).astype(owners.dtype)
    for i in np.unique(left_owners[left_owners != NOBODY]):
        mine = (left_owners == i).astype(np.uint8)
        box = around_all(mine)
        mine, shown = mine[box.slices], depth[box.slices]
        row, column = np.nonzero(_between(mine, gone[box.slices], strip))
        rows, columns = np.nonzero(mine)
        plane = _plane(rows, columns, shown[rows, columns]) if len(row) else None
        if plane is None:
            continue
        found = (plane[0] * row + plane[1] * column + plane[2]).astype(depth.dtype)
        with np.errstate(invalid="ignore"):
            lower = (found > shown[row, column] + step) | np.isnan(shown[row, column])
            lower &= found < left[box.slices][row, column]
        row, column = row[lower], column[lower]
        left[box.slices][row, column] = found[lower]
        left_owners[box.slices][row, column] = i
    return left, left_owners


def _between(mine: np.ndarray, gone: np.ndarray, strip: np.ndarray) -> np.ndarray:
    """(H, W) bool: each piece of `gone` within the convex hull of the pixels of `mine` that border
    on it: where it crosses a bar, the bar's width. mine: uint8; strip: what counts as bordering."""
    between = np.zeros(gone.shape, bool)
    count, pieces = cv2.connectedComponents(gone.astype(np.uint8))
    for k in range(1, count):
        piece = pieces == k
        border = cv2.findNonZero(mine & cv2.dilate(piece.astype(np.uint8), strip))
        if border is not None:
            hull = cv2.fillConvexPoly(np.zeros(gone.shape, np.uint8), cv2.convexHull(border), 1)
            between |= piece & hull.astype(bool)
    return between


def _plane(rows: np.ndarray, columns: np.ndarray, depth: np.ndarray) -> np.ndarray | None:
    """(a, b, c) of depth = a row + b column + c; None where too little was measured."""
    known = np.isfinite(depth)
    if np.count_nonzero(known) < MIN_PLANE_PX:
        return None
    basis = np.column_stack([rows, columns, np.ones(len(rows))])[known]
    target = depth[known].astype(float)
    weight = np.ones(len(target))
    for _ in range(4):  # its recesses and edges are not of its plane
        plane, *_ = np.linalg.lstsq(basis * weight[:, None], target * weight, rcond=None)
        weight = 1 / (1 + ((target - basis @ plane) / PLANE_SCALE) ** 2)
    return plane


def covered_share(depth: np.ndarray, mask: np.ndarray, box: Box, step: float) -> float:
    """Share of a part's outline at which another surface stands more than `step` (m) higher.

    mask: (box.height, box.width) bool, what is seen of the part. 0 for a part that nothing lies on
    or leans against.
    """
    surface = np.where(mask, depth[box.slices], np.float32(np.inf)).astype(np.float32)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (OUTLINE_PX, OUTLINE_PX))
    near = cv2.erode(surface, around, borderValue=np.inf)  # the part's nearest surface
    outline = np.isfinite(near) & ~mask & np.isfinite(depth[box.slices])
    if not outline.any():
        return 0.0
    return float(np.mean(depth[box.slices][outline] < near[outline] - step))


def lies_on(owners: np.ndarray, heights: np.ndarray, least: float) -> np.ndarray:
    """[K, K] int32: along the border that objects i and j share, the pixels at which j stands
    higher by `least` (m) less those at which i does. Above 0: j lies on i, or across it.

    owners: (H, W) int, ids of 0 to K - 1, NOBODY for none; heights: (H, W) m, NaN where not
    measured.
    """
    count = int(owners.max(initial=NOBODY)) + 1
    higher = np.zeros((count, count), np.int32)
    if count == 0:
        return higher
    rows, columns = np.nonzero(owners != NOBODY)
    part = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    owners, heights = owners[part], heights[part]
    for down, right in BORDER_STEPS:
        here = np.s_[max(-down, 0) : len(owners) - max(down, 0), : owners.shape[1] - right]
        there = np.s_[max(down, 0) : len(owners) + min(down, 0), right:]
        first, second = owners[here], owners[there]
        border = (first != second) & (first != NOBODY) & (second != NOBODY)
        first, second = first[border], second[border]
        with np.errstate(invalid="ignore"):
            step = heights[there][border] - heights[here][border]
            sign = (step > least).astype(np.int32) - (step < -least)
        np.add.at(higher, (first, second), sign)
    return higher - higher.T


def centroid(mask: np.ndarray, box: Box) -> tuple[float, float, int]:
    """(u, v, N): Eq. 18-19 over the mask's pixels, in full-image px; NaN, NaN, 0 if none."""
    rows, columns = np.nonzero(mask)
    if rows.size == 0:
        return float("nan"), float("nan"), 0
    return box.x + float(columns.mean()), box.y + float(rows.mean()), int(rows.size)


def grasp_depth(
    depth: np.ndarray, mask: np.ndarray, box: Box, grasp: GraspRectangle, radius_px: float
) -> float:
    """Depth (m) of the surface that is to be gripped at a grasp, NaN if none was measured.

    The median of the object's pixels (`mask`, of the box) within radius_px of the grasp point;
    where the point lies over a bore or a hole in the depth, of those between the jaws.
    """
    rows, columns = np.nonzero(mask)
    dx = columns + box.x - grasp.x_px
    dy = rows + box.y - grasp.y_px
    near = dx * dx + dy * dy <= radius_px * radius_px
    if not near.any():
        closing = np.cos(grasp.theta_rad), -np.sin(grasp.theta_rad)
        along = np.abs(dx * closing[0] + dy * closing[1])
        across = np.abs(-dx * closing[1] + dy * closing[0])
        near = (along <= grasp.width_px / 2) & (across <= radius_px)
    if not near.any():
        return float("nan")
    return float(np.median(depth[box.slices][rows[near], columns[near]]))
