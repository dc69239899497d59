"""A trial as a film: the simulated cell seen from beside it, drawn by the camera's ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import Image, ImageDraw

from iwgnet_grasp.report.pictures import INK, PAPER, font

EYE = np.array([1.12, -0.70, 0.92])  # m, base_link: opposite the arm, looking over the table at it
TARGET = np.array([0.32, 0.20, 0.16])  # m, between the workspace and the tray
FIELD_OF_VIEW = np.radians(54)  # across the picture
# Lamp over the table: m, linear RGB, and much of it without shadow, for a clear picture.
LIGHT = ([0.6, -0.8, 1.8], [1.0, 1.0, 1.0], 0.5)
CAPTION_PX = 26


@dataclass(frozen=True)
class Frame:
    time_s: float  # on the cell's clock
    image: np.ndarray  # (H, W, 3) uint8 RGB


class FilmCamera:
    """Takes a frame of a core.SimulatedCell every `period` seconds of its time, in a `with` block.

    It changes nothing in the cell: the trial goes as it goes without it.
    """

    def __init__(self, cell: Any, period: float = 0.25, size: tuple[int, int] = (400, 300)) -> None:
        from iwgnet_grasp import _core

        width, height = size
        focal = width / 2 / np.tan(FIELD_OF_VIEW / 2)
        self._camera = _core.PinholeIntrinsics(
            width, height, focal, focal, (width - 1) / 2, (height - 1) / 2
        )
        self._light = _core.Light(*LIGHT)
        self._T_base_eye = looking_at(EYE, TARGET)
        self._cell, self._period = cell, period
        self.frames: list[Frame] = []

    def __enter__(self) -> FilmCamera:
        self._cell.watch(self._period, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        self._cell.watch(self._period, None)

    def _take(self) -> None:
        image = self._cell.picture(self._camera, self._T_base_eye, self._light)
        self.frames.append(Frame(self._cell.time, image))


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) pose of a camera (z forward, y down) at `eye` that sees `target` in its middle,
    upright."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :4] = np.column_stack([x, np.cross(z, x), z, eye])
    return T


def write_gif(
    file: Path | BinaryIO,
    frames: Sequence[Frame],
    captions: Sequence[str],
    frame_ms: int = 70,
    hold_ms: int = 2000,
    colors: int = 64,
) -> None:
    """An endless GIF of the frames, each over its caption; the last one stays for hold_ms.

    One palette for all and no dithering, so that what stands still costs nothing. Raises
    ValueError without frames, OSError.
    """
    if not frames:
        raise ValueError("a film of no frames")
    images = [
        Image.fromarray(captioned(frame.image, text))
        for frame, text in zip(frames, captions, strict=True)
    ]
    # The palette of frames from all over the film, so that none of its colours is missing.
    sample = images[:: max(1, len(images) // 6)]
    sheet = Image.new("RGB", (sample[0].width, sample[0].height * len(sample)))
    for i, image in enumerate(sample):
        sheet.paste(image, (0, i * image.height))
    palette = sheet.quantize(colors, Image.Quantize.MEDIANCUT)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    indexed[0].save(
        file,
        "GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=[frame_ms] * (len(indexed) - 1) + [hold_ms],
        loop=0,
        optimize=False,
    )


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """The image with a line of text below it."""
    foot = Image.new("RGB", (image.shape[1], CAPTION_PX), PAPER)
    ImageDraw.Draw(foot).text((8, CAPTION_PX / 2), text, INK, font(14), anchor="lm")
    return np.vstack([image, np.asarray(foot)])
