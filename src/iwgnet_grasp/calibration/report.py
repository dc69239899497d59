"""A calibration in words, tables and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from iwgnet_grasp.calibration.samples import SampleSet
from iwgnet_grasp.calibration.settings import as_yaml, core, difference, inverse
from iwgnet_grasp.calibration.solve import Calibration, Method

_MM = 1e3


def equation_22(T: np.ndarray, name: str = "T_base_camera") -> list[str]:
    """The transform in the form of the paper's Eq. 22."""
    rows = ["  ".join(f"{value:9.5f}" for value in row) for row in T]
    lead = f"{name} = "
    return [(lead if i == 1 else " " * len(lead)) + f"[ {row} ]" for i, row in enumerate(rows)]


def text(calibration: Calibration, samples: SampleSet) -> list[str]:
    """The result with what tells how far it can be trusted."""
    c = calibration
    d = np.degrees
    images = c.view_rms_px is not None
    lines = [*equation_22(c.T_base_camera), ""]
    lines.append(
        f"from {len(samples.samples)} poses, turned by up to {d(c.largest_rotation):.0f} deg, axes "
        f"spread by {d(c.axis_spread):.0f} deg (45: as much about one axis as about another)"
    )
    lines.append("pair   residual mm   deg" + ("      px" if images else "") + "   weight")
    for i, weight in enumerate(c.weights):
        px = f"   {c.view_rms_px[i]:5.3f}" if images else ""
        lines.append(
            f"{i + 1:4d}   {c.translation_residuals[i] * _MM:11.3f}  "
            f"{d(c.rotation_residuals[i]):5.3f}{px}   {weight:6.2f}"
            + ("   OUTLIER, left out" if weight < 0.1 else "")
        )
    if images:
        lines.append(f"corners: RMS {c.rms_px:.3f} px of one coordinate, over all images")
    lines.append(f"AX = XB: RMS {c.axxb[0] * _MM:.3f} mm, {d(c.axxb[1]):.4f} deg")
    lines.append(
        f"leave-one-out: moves by at most {c.leave_one_out[0] * _MM:.3f} mm, "
        f"{d(c.leave_one_out[1]):.4f} deg"
    )
    lines.append(
        f"standard deviation (worst axis): {c.sigma[0] * _MM:.3f} mm, {d(c.sigma[1]):.4f} deg"
    )
    return lines


def methods_table(
    methods: Sequence[Method], samples: SampleSet, truth: np.ndarray | None
) -> list[str]:
    """The methods on the same samples. truth: the simulator's T_base_camera, judge side only."""
    head = f"{'method':18s} {'AX=XB mm':>9s} {'deg':>7s} {'time ms':>8s}"
    lines = [head + (f" {'error mm':>9s} {'deg':>7s}" if truth is not None else "")]
    for method in methods:
        if method.T_base_camera is None:
            lines.append(f"{method.name:18s} gave no result")
            continue
        move, turn = core().axxb_rms(
            samples.T_base_tool, samples.T_camera_target, method.T_base_camera
        )
        line = f"{method.name:18s} {move * _MM:9.3f} {np.degrees(turn):7.4f}"
        line += f" {method.milliseconds:8.2f}"
        if truth is not None:
            move, turn = difference(method.T_base_camera, truth)
            line += f" {move * _MM:9.3f} {np.degrees(turn):7.4f}"
        lines.append(line)
    return lines


def as_dict(calibration: Calibration) -> dict[str, Any]:
    """Plain values for a file; T_base_color is what camera_pose reads."""
    c = calibration
    return {
        "T_base_color": as_yaml(c.T_base_camera),
        "T_tool_target": as_yaml(c.T_tool_target),
        "method": c.method,
        "residuals": {
            "translation": [round(float(v), 9) for v in c.translation_residuals],
            "rotation": [round(float(v), 9) for v in c.rotation_residuals],
            "weights": [round(float(v), 4) for v in c.weights],
            **(
                {}
                if c.view_rms_px is None
                else {"px": [round(float(v), 5) for v in c.view_rms_px], "rms_px": float(c.rms_px)}
            ),
        },
        "axxb_rms": [float(v) for v in c.axxb],
        "leave_one_out": [float(v) for v in c.leave_one_out],
        "standard_deviation": [float(v) for v in c.sigma],
        "rotation": {"largest": float(c.largest_rotation), "axis_spread": float(c.axis_spread)},
    }


_ARROW = 100.0  # times larger than the residuals are
_TILE = (640, 400)  # px of an image in the picture
_LARGE = 2  # the first image is that many tiles wide
_SEEN, _GONE, _INK = (40, 220, 60), (255, 60, 40), (255, 255, 255)


def draw(calibration: Calibration, samples: SampleSet, outline: np.ndarray, path: Path) -> None:
    """All images with the board where the calibration puts it, and arrows from there to where its
    corners were seen, _ARROW times enlarged. outline: (n, 3) m of the print. Raises OSError.
    """
    tiles = [
        _tile(calibration, samples, i, outline, 2 if i == 0 else 1)
        for i in range(len(samples.samples))
    ]
    columns = 4
    width, height = _TILE
    # The first image is _LARGE x _LARGE tiles; the others go around it.
    spots = [
        (row, column)
        for row in range(len(tiles) // columns + _LARGE + 1)
        for column in range(columns)
        if row >= _LARGE or column >= _LARGE
    ][: len(tiles) - 1]
    rows = max([_LARGE, *(row + 1 for row, _ in spots)])
    sheet = np.full((rows * height, columns * width, 3), 32, np.uint8)
    sheet[: _LARGE * height, : _LARGE * width] = tiles[0]
    for (row, column), tile in zip(spots, tiles[1:], strict=True):
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
        raise OSError(f"cannot write {path}")


def _tile(
    calibration: Calibration, samples: SampleSet, index: int, outline: np.ndarray, scale: int
) -> np.ndarray:
    sample, view = samples.samples[index], samples.views[index]
    width, height, fx, fy, cx, cy = samples.intrinsics
    size = (_TILE[0] * scale, _TILE[1] * scale)
    factor = size[0] / width
    assert sample.image is not None
    image = cv2.resize(sample.image, size, interpolation=cv2.INTER_AREA)

    def place(pixels: np.ndarray) -> np.ndarray:
        """Fixed-point coordinates for OpenCV's drawing, 1/16 px."""
        return np.rint(((pixels + 0.5) * factor - 0.5) * 16).astype(int)

    T = inverse(calibration.T_base_camera) @ sample.T_base_tool @ calibration.T_tool_target
    points = outline @ T[:3, :3].T + T[:3, 3]
    edge = np.stack([fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy])
    trusted = calibration.weights[index] >= 0.1
    color = _SEEN if trusted else _GONE
    cv2.polylines(image, [place(edge.T)], True, color, scale, cv2.LINE_AA, 4)
    residuals = core().reprojection_residuals(
        view, samples.camera, calibration.T_base_camera, calibration.T_tool_target
    )
    for seen, residual in zip(sample.pixels, np.asarray(residuals), strict=True):
        start, end = place(seen - residual), place(seen + (_ARROW - 1) * residual)
        cv2.circle(image, start, 16 * scale, color, -1, cv2.LINE_AA, 4)
        cv2.line(image, start, end, (255, 120, 0), scale, cv2.LINE_AA, 4)
    label = f"{index + 1}: RMS {calibration.view_rms_px[index]:.3f} px"
    label += "" if trusted else ", outlier"
    if index == 0:
        label += f", arrows {_ARROW:.0f} x the residual"
    for ink, thickness in (((0, 0, 0), 3 * scale), (_INK, scale)):
        cv2.putText(
            image, label, (10 * scale, 22 * scale), cv2.FONT_HERSHEY_SIMPLEX, 0.55 * scale, ink,
            thickness, cv2.LINE_AA,
        )  # fmt: skip
    return image
