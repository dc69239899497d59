"""What surrounds a grasp, turned so that the jaws close along the rows."""

from __future__ import annotations

import cv2
import numpy as np

from iwgnet_grasp.perception.types import NOBODY, GraspRectangle

VIEW_CELLS = 96  # side of a view
CELL_PX = 2.0  # of the image: a view is 180 mm wide at 0.6 m, a rod 150 mm long
CHANNELS = 6
HEIGHT_UNIT = 0.05  # m
HEIGHT_CLIP = (-0.5, 3.0)  # units
PAD_PX = (7.0, 23.0)  # thickness and width of a finger's pad at 0.6 m (grasping.yaml)
_LEAST_CONTRAST = 8.0  # grey levels


def without_gaps(heights: np.ndarray) -> np.ndarray:
    """(H, W) float32 with the lines of unmeasured pixels filled that aligning leaves: the mean of
    what was measured in the 3x3 around them. Larger holes stay NaN."""
    known = np.isfinite(heights)
    total = cv2.boxFilter(np.where(known, heights, np.float32(0)), -1, (3, 3))
    share = cv2.boxFilter(known.astype(np.float32), -1, (3, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        around = np.where(share > 0.1, total / share, np.float32(np.nan))
    return np.where(known, heights, around)


def grasp_view(
    heights: np.ndarray,
    grey: np.ndarray,
    owners: np.ndarray,
    object_id: int,
    grasp: GraspRectangle,
) -> np.ndarray:
    """[CHANNELS, VIEW_CELLS, VIEW_CELLS] float32 around a grasp of an object.

    heights: (H, W) float32 m over the empty scene (without_gaps), NaN where not measured; grey:
    (H, W) uint8; owners: (H, W) int16 (merged_depth.pixel_owners). Channels: height in HEIGHT_UNIT;
    measured; the object's own pixels; other objects'; brightness of mean 0 and deviation 1; the
    pads' places. Outside the image lies the empty scene.
    """
    cells = np.arange(VIEW_CELLS) - (VIEW_CELLS - 1) / 2
    along = CELL_PX * np.array([np.cos(grasp.theta_rad), -np.sin(grasp.theta_rad)])
    across = np.array([-along[1], along[0]])
    corner = np.array([grasp.x_px, grasp.y_px]) + cells[0] * (along + across)
    affine = np.column_stack([along, across, corner])

    def seen(image: np.ndarray, border: float, interpolation: int) -> np.ndarray:
        return cv2.warpAffine(
            image,
            affine,
            (VIEW_CELLS, VIEW_CELLS),
            flags=interpolation | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=border,
        )

    height = seen(heights, 0.0, cv2.INTER_NEAREST)
    measured = np.isfinite(height)
    owner = seen(owners, NOBODY, cv2.INTER_NEAREST)
    brightness = seen(grey, 0.0, cv2.INTER_LINEAR).astype(np.float32)
    brightness -= brightness.mean()
    brightness /= max(float(brightness.std()), _LEAST_CONTRAST)
    thickness, width = PAD_PX
    outwards = np.abs(cells) * CELL_PX - grasp.width_px / 2
    pads = np.outer(np.abs(cells) * CELL_PX <= width / 2, (outwards >= 0) & (outwards <= thickness))
    own = owner == object_id
    return np.stack(
        [
            np.clip(np.where(measured, height, 0) / HEIGHT_UNIT, *HEIGHT_CLIP),
            measured,
            own,
            (owner != NOBODY) & ~own,
            brightness,
            pads,
        ]
    ).astype(np.float32)
