"""What perception gives away: plain values that mirror the messages of the package (msg/)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

NOBODY = -1  # the owner of a pixel that shows no object


class PerceptionError(ValueError):
    """An input that perception cannot use: one line saying what, where and what to do."""


@dataclass(frozen=True)
class CameraIntrinsics:
    """Pinhole model of the colour camera; all in pixels (sensor_msgs/CameraInfo.K)."""

    fx: float
    fy: float
    cx: float
    cy: float

    def deproject(self, u_px: float, v_px: float, z: float) -> np.ndarray:
        """Point (m) in the optical frame of pixel (u, v) at depth z (m)."""
        return np.array([(u_px - self.cx) * z / self.fx, (v_px - self.cy) * z / self.fy, z])


@dataclass(frozen=True)
class Box:
    """Whole pixels of the colour image: columns [x, x + width), rows [y, y + height)."""

    x: int
    y: int
    width: int
    height: int

    @property
    def center(self) -> tuple[float, float]:
        """(u, v) of the middle, px; a pixel's own centre has whole coordinates."""
        return self.x + (self.width - 1) / 2, self.y + (self.height - 1) / 2

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image array: image[box.slices]."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    def contains(self, u_px: float, v_px: float) -> bool:
        return (
            self.x - 0.5 <= u_px < self.x + self.width - 0.5
            and self.y - 0.5 <= v_px < self.y + self.height - 0.5
        )


@dataclass(frozen=True)
class Detection:
    """One box of the object detector."""

    label: str
    score: float
    box: Box


@dataclass(frozen=True)
class GraspRectangle:
    """A grasp in the image plane, (x, y, theta, w) of the paper; see msg/GraspRectangle.msg.

    theta_rad is the closing direction, counter-clockwise as seen: atan2(-dy, dx), (-pi/2, pi/2].
    depth_m is NaN where nothing was measured.
    """

    x_px: float
    y_px: float
    theta_rad: float
    width_px: float
    quality: float
    depth_m: float = float("nan")


@dataclass(frozen=True)
class ObjectGrasps:
    """One detected object and its candidate grasps, best first; see msg/ObjectGrasps.msg."""

    object_id: int
    label: str
    score: float
    box: Box
    centroid_u_px: float  # Eq. 18; NaN without valid pixels, as are the next two
    centroid_v_px: float  # Eq. 19
    centroid_depth_m: float  # median depth of the object's pixels
    valid_pixels: int  # N of Eq. 18-19
    grasps: tuple[GraspRectangle, ...] = ()
    covered_px: int = 0  # of the border with the object that lies on it (merged_depth.lies_on)


@dataclass(frozen=True)
class Window:
    """The square of the image that the grasp network sees for one object.

    (x, y) is the upper left pixel in the full image, depth and empty are (size, size) float32 in
    metres, NaN where invalid. depth is the merged depth (Fig. 8b): the box's depth in the
    empty-scene depth.
    """

    x: int
    y: int
    depth: np.ndarray
    empty: np.ndarray


@dataclass(frozen=True)
class Look:
    """One look at the table with all that was made of it; windows[i] belongs to objects[i]."""

    color: np.ndarray  # (H, W, 3) uint8 RGB
    depth: np.ndarray  # (H, W) float32 m, NaN invalid
    empty_depth: np.ndarray  # (H, W) float32 m, NaN invalid
    objects: tuple[ObjectGrasps, ...]
    windows: tuple[Window, ...]
    # (H, W) int16, id of the object that each pixel shows, NOBODY for none; None where a look has
    # travelled over the graph
    owners: np.ndarray | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # wall time of each step
