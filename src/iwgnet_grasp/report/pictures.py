"""Pictures of one look: the paper's Figures 6 to 9."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
    """Figure 7: detections with label and score."""
    image = look.color.copy()
    for o in look.objects:
        color = color_of(o.object_id)
        outline(image, box_corners(o), color, 2)
    canvas = Image.fromarray(image)
    draw = ImageDraw.Draw(canvas)
    for o in look.objects:
        text = f"{o.object_id}  {o.label.replace('_', ' ')}  {o.score:.2f}"
        tag(draw, (o.box.x - 1, o.box.y - 1), text, color_of(o.object_id), 15, above=True)
    return titled(np.asarray(canvas), f"{len(look.objects)} objects detected")


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
    image = look.color.copy()
    first = [(entry, chosen.get(entry.object.object_id)) for entry in ranking.objects]
    for order, (entry, grasp) in enumerate(first, 1):
        grasp = grasp or entry.object.grasps[0]
        color = color_of(entry.object.object_id)
        outline(image, box_corners(entry.object), color, 1)
        draw_centroid(image, entry.object, color)
        draw_grasp(image, grasp, color, 3 if order == 1 else 2)
    canvas = Image.fromarray(image)
    draw = ImageDraw.Draw(canvas)
    for order, (entry, grasp) in enumerate(first, 1):
        grasp = grasp or entry.object.grasps[0]
        color = color_of(entry.object.object_id)
        corner = grasp_corners(grasp).max(axis=0)
        badge(draw, (corner[0] + 12, corner[1] + 2), str(order), color)
        tag(draw, (corner[0] + 26, corner[1] - 8), f"S* {entry.priority:.2f}", color, 15)
    picture = titled(np.asarray(canvas), "grasps in the order of S*  (dot: centroid)")
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
    image: np.ndarray, grasp: GraspRectangle, color: Sequence[int], thickness: int = 2
) -> None:
    """Jaw plates thick and in colour, the opening between them thin."""
    corners = grasp_corners(grasp)
    for width, ink in ((thickness + 3, INK), (thickness + 1, color)):
        line(image, corners[0], corners[1], ink, width)
        line(image, corners[2], corners[3], ink, width)
    line(image, corners[1], corners[2], color, 1)
    line(image, corners[3], corners[0], color, 1)
    line(image, corners[:2].mean(0), corners[2:].mean(0), color, 1)
    center = corners.mean(0)
    arm = np.array([4.0, 0.0]), np.array([0.0, 4.0])
    for a in arm:
        line(image, center - a, center + a, (255, 255, 255), 2)


def draw_centroid(image: np.ndarray, target: ObjectGrasps, color: Sequence[int]) -> None:
    if target.valid_pixels:
        at = _fixed((target.centroid_u_px, target.centroid_v_px))
        cv2.circle(image, at, 5 * 16, INK, -1, cv2.LINE_AA, 4)
        cv2.circle(image, at, 4 * 16, tuple(color), -1, cv2.LINE_AA, 4)


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


def tag(
    draw: ImageDraw.ImageDraw,
    at: tuple[float, float],
    text: str,
    color: Sequence[int],
    size: int,
    above: bool = False,
) -> None:
    """Dark letters on a coloured plate whose upper (or lower) left corner is `at`."""
    left, top, right, bottom = draw.textbbox((0, 0), text, font(size))
    height = bottom - top + 6
    y = at[1] - height if above and at[1] >= height else at[1]
    draw.rectangle((at[0], y, at[0] + right - left + 8, y + height), tuple(color))
    draw.text((at[0] + 4 - left, y + 3 - top), text, INK, font(size))


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
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"
