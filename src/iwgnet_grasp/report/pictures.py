"""Pictures of one look: the paper's Figures 6 to 9."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from iwgnet_grasp.perception.types import GraspRectangle, Look, ObjectGrasps
from iwgnet_grasp.priority import Ranking

JAW_PX = 22  # drawn extent of the jaws across the closing direction: the pad's 22 mm at 0.6 m
INK = (28, 30, 34)
PAPER = (250, 250, 248)
FAINT = (120, 124, 130)
INVALID = (40, 40, 44)  # a pixel without depth
# Distinct on metal and wood, light enough for dark letters.
PALETTE = (
    (86, 180, 233),
    (240, 228, 66),
    (0, 190, 140),
    (255, 140, 90),
    (214, 134, 200),
    (140, 220, 90),
    (255, 190, 60),
    (120, 160, 255),
    (90, 220, 220),
    (245, 150, 160),
)


def write_pictures(
    folder: str | Path,
    look: Look,
    ranking: Ranking,
    chosen: Mapping[int, GraspRectangle] | None = None,
    prefix: str = "",
) -> list[Path]:
    """Writes PREFIXscene.png, boxes.png, merged_depth.png and grasps.png; returns their paths.

    chosen: the grasp that is to be executed of an object (by object_id) where it is not the best
    candidate. The folder is made if need be. Raises OSError when a file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "scene": scene_picture(look),
        "boxes": boxes_picture(look),
        "merged_depth": merged_depth_picture(look),
        "grasps": grasps_picture(look, ranking, chosen),
    }
    return [write_png(folder / f"{prefix}{name}.png", image) for name, image in pictures.items()]


def write_png(path: Path, image: np.ndarray) -> Path:
    """Writes an (H, W, 3) uint8 RGB image. Raises OSError."""
    done, code = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"{path}: image {image.shape} cannot be encoded as PNG")
    path.write_bytes(code.tobytes())
    return path


def scene_picture(look: Look, panel_width: int = 800) -> np.ndarray:
    """Figure 6: depth of the empty scene, colour image, depth of the scene."""
    near, far = depth_range(look)
    panels = [
        (colored_depth(look.empty_depth, near, far), "(a) depth, empty scene"),
        (look.color, "(b) colour"),
        (colored_depth(look.depth, near, far), "(c) depth, scene"),
    ]
    shown = [titled(fitted(image, panel_width), title) for image, title in panels]
    bar = depth_bar(shown[0].shape[0], near, far)
    return beside([*shown, bar])


def boxes_picture(look: Look) -> np.ndarray:
    """Figure 7: detections with label and score, on the part of the image that holds them; where it
    is known which pixels are whose they are tinted."""
    view = View.around(look)
    color = look.color
    if look.owners is not None:
        tint = color.copy()
        for o in look.objects:
            tint[look.owners == o.object_id] = color_of(o.object_id)
        color = cv2.addWeighted(color, 0.6, tint, 0.4, 0)
    image = view.image(color)
    for o in look.objects:
        outline(image, view.points(box_corners(o)), color_of(o.object_id), 2)
    labels = [
        Label(
            f"{o.object_id}  {o.label.replace('_', ' ')}  {o.score:.2f}",
            view.points(box_corners(o))[0],
            color_of(o.object_id),
        )
        for o in look.objects
    ]
    image = with_labels(image, labels, [view.points(box_corners(o)) for o in look.objects])
    return titled(image, f"{len(look.objects)} objects detected")


def merged_depth_picture(look: Look, columns: int = 5, cell: int = 224) -> np.ndarray:
    """Figure 8: of each object the depth in its box and, below it, that depth in the empty scene,
    which is what the grasp network sees."""
    if not look.objects:
        return titled(np.full((cell, 3 * cell, 3), PAPER, np.uint8), "no object detected")
    near, far = depth_range(look)
    tiles = []
    for o, window in zip(look.objects, look.windows, strict=True):
        size = window.depth.shape[0]
        cropped = np.full((size, size, 3), PAPER, np.uint8)
        merged = colored_depth(window.depth, near, far)
        rows = slice(max(o.box.y - window.y, 0), min(o.box.y + o.box.height - window.y, size))
        cols = slice(max(o.box.x - window.x, 0), min(o.box.x + o.box.width - window.x, size))
        cropped[rows, cols] = merged[rows, cols]
        pair = np.vstack(
            [fitted(cropped, cell), np.full((4, cell, 3), PAPER, np.uint8), fitted(merged, cell)]
        )
        tiles.append(titled(pair, f"object {o.object_id}", 16))
    blank = np.full_like(tiles[0], PAPER)
    columns = min(columns, len(tiles))
    lines = []
    for i in range(0, len(tiles), columns):
        line = tiles[i : i + columns]
        lines.append(beside(line + [blank] * (columns - len(line))))
    grid = np.vstack(lines)
    return titled(
        beside([grid, depth_bar(grid.shape[0], near, far)]),
        "cropped depth (above) and merged with the empty scene (below)",
    )


def grasps_picture(
    look: Look, ranking: Ranking, chosen: Mapping[int, GraspRectangle] | None = None
) -> np.ndarray:
    """Figure 9: grasps with S* and their order in the image, the terms of Eq. 17-21 beside it."""
    chosen = chosen or {}
    view = View.around(look)
    image = view.image(look.color)
    labels, occupied = [], []
    for order, entry in enumerate(ranking.objects, 1):
        o = entry.object
        color = color_of(o.object_id)
        corners = view.points(grasp_corners(chosen.get(o.object_id, o.grasps[0])))
        outline(image, view.points(box_corners(o)), color, 1)
        if o.valid_pixels:
            draw_centroid(image, view.points([[o.centroid_u_px, o.centroid_v_px]])[0], color)
        draw_grasp(image, corners, color, 4 if order == 1 else 3)
        labels.append(Label(f"{order}:  S* {entry.priority:.2f}", corners.mean(0), color))
        occupied.append(corners)
    image = with_labels(image, labels, occupied)
    picture = titled(image, "grasps in the order of S*  (dot: centroid, cross: grasp point)")
    return beside([picture, score_table(ranking, picture.shape[0])])


def score_table(ranking: Ranking, height: int, width: int = 520) -> np.ndarray:
    """Figure 9a: order, object, D and G in millimetres, S, S* and quality."""
    canvas = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    columns = (16, 76, 166, 246, 316, 396, 466)
    heads = ("order", "object", "D mm", "G mm", "S", "S*", "Q")
    row = 12
    for x, head in zip(columns, heads, strict=True):
        draw.text((x, row), head, FAINT, font(16))
    row += 34
    for order, entry in enumerate(ranking.objects, 1):
        color = color_of(entry.object.object_id)
        badge(draw, (columns[0] + 14, row + 9), str(order), color)
        cells = (
            str(entry.object.object_id),
            _number(entry.depth_distance_m * 1e3, 1),
            _number(entry.centroid_distance_m * 1e3, 1),
            _number(entry.score, 4),
            _number(entry.priority, 2),
            _number(entry.object.grasps[0].quality, 2),
        )
        for x, text in zip(columns[1:], cells, strict=True):
            draw.text((x, row), text, INK, font(17))
        row += 30
        if entry.reason:
            draw.text((columns[1], row - 6), entry.reason, FAINT, font(14))
            row += 22
    for o, reason in ranking.dropped:
        draw.text((columns[0], row), "left out", FAINT, font(14))
        draw.text((columns[1] + 14, row - 1), f"{o.object_id}", INK, font(17))
        draw.text((columns[2], row), reason, FAINT, font(14))
        row += 30
    if not ranking.objects and not ranking.dropped:
        draw.text((columns[0], row), "nothing to grasp", FAINT, font(16))
    return np.asarray(canvas)


# Elements -----------------------------------------------------------------------------------------


def depth_range(look: Look) -> tuple[float, float]:
    """(nearest, farthest) depth (m) of the pictures' colours: objects to just behind the table."""
    depth = look.depth[np.isfinite(look.depth)]
    empty = look.empty_depth[np.isfinite(look.empty_depth)]
    far = float(np.median(empty)) + 0.005
    near = min(float(np.percentile(depth, 0.5)), far - 0.03)
    return near, far


def colored_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """(H, W, 3) uint8 RGB: near is warm, far is cold, no depth is dark grey."""
    level = np.clip((far - depth) / (far - near), 0, 1)
    valid = np.isfinite(level)
    grey = np.where(valid, level * 235 + 10, 0).astype(np.uint8)
    image = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    image[~valid] = INVALID
    return image


def depth_bar(height: int, near: float, far: float, width: int = 92) -> np.ndarray:
    """Scale of colored_depth in millimetres."""
    bar = np.full((height, width, 3), PAPER, np.uint8)
    top, bottom = 44, height - 24
    ramp = np.linspace(near, far, bottom - top, dtype=np.float32)[:, None]
    bar[top:bottom, 10:30] = colored_depth(np.repeat(ramp, 20, 1), near, far)
    canvas = Image.fromarray(bar)
    draw = ImageDraw.Draw(canvas)
    draw.text((10, 12), "mm", FAINT, font(15))
    for part in np.linspace(0, 1, 5):
        y = top + part * (bottom - top - 1)
        draw.text((36, y), f"{(near + part * (far - near)) * 1e3:.0f}", INK, font(15), anchor="lm")
    return np.asarray(canvas)


def grasp_corners(grasp: GraspRectangle) -> np.ndarray:
    """(4, 2) px; corners 0-1 and 2-3 span the jaw plates, 1-2 and 3-0 the opening."""
    along = np.array([math.cos(grasp.theta_rad), -math.sin(grasp.theta_rad)]) * grasp.width_px / 2
    across = np.array([math.sin(grasp.theta_rad), math.cos(grasp.theta_rad)]) * JAW_PX / 2
    center = np.array([grasp.x_px, grasp.y_px])
    return np.array(
        [
            center - along - across,
            center - along + across,
            center + along + across,
            center + along - across,
        ]
    )


def draw_grasp(
    image: np.ndarray, corners: np.ndarray, color: Sequence[int], thickness: int = 3
) -> None:
    """Jaw plates thick and in colour, the opening between them thin; corners: grasp_corners."""
    for width, ink in ((thickness + 3, INK), (thickness + 1, color)):
        line(image, corners[0], corners[1], ink, width)
        line(image, corners[2], corners[3], ink, width)
    line(image, corners[1], corners[2], color, 1)
    line(image, corners[3], corners[0], color, 1)
    line(image, corners[:2].mean(0), corners[2:].mean(0), color, 1)
    center = corners.mean(0)
    for arm in (np.array([6.0, 0.0]), np.array([0.0, 6.0])):
        line(image, center - arm, center + arm, (255, 255, 255), 2)


def draw_centroid(image: np.ndarray, at: np.ndarray, color: Sequence[int]) -> None:
    cv2.circle(image, _fixed(at), 6 * 16, INK, -1, cv2.LINE_AA, 4)
    cv2.circle(image, _fixed(at), 4 * 16, tuple(color), -1, cv2.LINE_AA, 4)


def box_corners(target: ObjectGrasps) -> np.ndarray:
    b = target.box
    right, bottom = b.x + b.width - 1, b.y + b.height - 1
    return np.array([[b.x, b.y], [right, b.y], [right, bottom], [b.x, bottom]], float)


def outline(image: np.ndarray, corners: np.ndarray, color: Sequence[int], thickness: int) -> None:
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        line(image, a, b, color, thickness)


def line(
    image: np.ndarray, a: Sequence[float], b: Sequence[float], color: Sequence[int], width: int
) -> None:
    cv2.line(image, _fixed(a), _fixed(b), tuple(int(c) for c in color), width, cv2.LINE_AA, 4)


@dataclass(frozen=True)
class View:
    """A magnified part of the image: shown px = scale * (image px - (x, y))."""

    x: int
    y: int
    width: int
    height: int
    scale: float

    @staticmethod
    def around(look: Look, margin: int = 70, least: tuple[int, int] = (560, 420)) -> View:
        """The boxes of a look with a margin, at least `least` (width, height) px; all of the
        image when there are none."""
        rows, columns = look.color.shape[:2]
        if not look.objects:
            return View(0, 0, columns, rows, 1.0)
        corners = np.concatenate([box_corners(o) for o in look.objects])
        low, high = corners.min(0) - margin, corners.max(0) + margin
        spare = np.maximum(np.array(least) - (high - low), 0) / 2
        low = np.clip(np.floor(low - spare), 0, [columns, rows]).astype(int)
        high = np.clip(np.ceil(high + spare), 0, [columns, rows]).astype(int)
        width, height = (int(v) for v in high - low)
        scale = min(1280 / width, 960 / height, 2.0)
        return View(int(low[0]), int(low[1]), width, height, scale)

    def image(self, image: np.ndarray) -> np.ndarray:
        part = image[self.y : self.y + self.height, self.x : self.x + self.width]
        size = round(self.width * self.scale), round(self.height * self.scale)
        return cv2.resize(part, size, interpolation=cv2.INTER_CUBIC)

    def points(self, points: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
        """(N, 2) image px -> shown px, both counted from the middle of the first pixel."""
        return (np.asarray(points, float) - [self.x, self.y] + 0.5) * self.scale - 0.5


@dataclass(frozen=True)
class Label:
    text: str
    at: np.ndarray  # (2,) the point it belongs to
    color: tuple[int, int, int]


def with_labels(
    image: np.ndarray, labels: Sequence[Label], occupied: Sequence[np.ndarray], size: int = 18
) -> np.ndarray:
    """The image with each label near its point, joined to it by a line where it had to move.

    A label keeps off the others and, as far as it can, off the `occupied` outlines (corners).
    """
    canvas = Image.fromarray(image)
    draw = ImageDraw.Draw(canvas)
    bounds = image.shape[1], image.shape[0]
    busy = [(*c.min(0), *c.max(0)) for c in occupied]
    placed: list[tuple[float, float, float, float]] = []
    plates = []
    for label in labels:
        left, top, right, bottom = draw.textbbox((0, 0), label.text, font(size), anchor="ls")
        extent = np.array([right - left + 14, size + 8])
        plate = _free_plate(label.at, extent, bounds, placed, busy)
        placed.append(plate)
        plates.append((label, plate))
    for label, plate in plates:
        nearest = np.clip(label.at, plate[:2], plate[2:])
        if np.hypot(*(nearest - label.at)) > 4:
            draw.line([*label.at, *nearest], INK, 4)
            draw.line([*label.at, *nearest], label.color, 2)
    for label, plate in plates:
        draw.rounded_rectangle(plate, 5, label.color, INK, 1)
        middle = (plate[0] + plate[2]) / 2, (plate[1] + plate[3]) / 2
        draw.text(middle, label.text, INK, font(size), anchor="mm")
    return np.asarray(canvas)


def _free_plate(
    at: np.ndarray,
    extent: np.ndarray,
    bounds: tuple[int, int],
    placed: Sequence[tuple[float, float, float, float]],
    busy: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float]:
    """x1, y1, x2, y2 of the best place around a point: least covered, then nearest."""
    best, least = None, math.inf
    for radius in (0.0, 24.0, 48.0, 80.0, 120.0, 170.0, 230.0):
        for step in range(16):
            angle = -math.pi / 2 + step * math.pi / 8
            direction = np.array([math.cos(angle), math.sin(angle)])
            middle = at + direction * (radius + np.abs(direction) @ extent / 2)
            low = np.clip(middle - extent / 2, 2, np.array(bounds) - extent - 2)
            plate = (*low, *(low + extent))
            cost = radius + sum(200.0 + _overlap(plate, p) for p in placed if _overlap(plate, p))
            cost += sum(0.06 * _overlap(plate, b) for b in busy)
            if cost < least:
                best, least = plate, cost
    return best


def _overlap(a: Sequence[float], b: Sequence[float]) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)


def badge(
    draw: ImageDraw.ImageDraw, center: tuple[float, float], text: str, color: Sequence[int]
) -> None:
    """A number in a disc."""
    x, y = center
    draw.ellipse((x - 13, y - 13, x + 13, y + 13), tuple(color), INK, 2)
    draw.text((x, y), text, INK, font(16), anchor="mm")


def titled(image: np.ndarray, title: str, size: int = 20) -> np.ndarray:
    """The image with a title line above it."""
    head = Image.new("RGB", (image.shape[1], size + 18), PAPER)
    ImageDraw.Draw(head).text((10, size / 2 + 9), title, INK, font(size), anchor="lm")
    return np.vstack([np.asarray(head), image])


def fitted(image: np.ndarray, width: int) -> np.ndarray:
    """The image scaled to a width."""
    height = round(image.shape[0] * width / image.shape[1])
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)


def beside(images: Sequence[np.ndarray], gap: int = 8) -> np.ndarray:
    """Images in a row, top edges aligned."""
    height = max(image.shape[0] for image in images)
    parts = []
    for i, image in enumerate(images):
        if i:
            parts.append(np.full((height, gap, 3), PAPER, np.uint8))
        below = np.full((height - image.shape[0], image.shape[1], 3), PAPER, np.uint8)
        parts.append(np.vstack([image, below]))
    return np.hstack(parts)


def color_of(object_id: int) -> tuple[int, int, int]:
    return PALETTE[object_id % len(PALETTE)]


def font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)


def _fixed(point: Sequence[float]) -> tuple[int, int]:
    """cv2's fixed-point coordinates with 4 fractional bits."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
