"""Messages of the package <-> the values of perception and priority."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from iwgnet_grasp import msg
from iwgnet_grasp.perception.types import (
    Box,
    CameraIntrinsics,
    GraspRectangle,
    ObjectGrasps,
    PerceptionError,
)
from iwgnet_grasp.priority import RankedObject

_IMAGE_TYPES = {  # encoding: (numpy type, channels)
    "rgb8": (np.uint8, 3),
    "16UC1": (np.uint16, 1),
    "32FC1": (np.float32, 1),
}


# Fields that a message and its value have in common, by the same names.
_GRASP = {f.name for f in fields(GraspRectangle)}
_OBJECT = {f.name for f in fields(ObjectGrasps)} - {"box", "grasps"}
_RANKED = {f.name for f in fields(RankedObject)} - {"object"}


def image_array(image, name: str) -> np.ndarray:
    """sensor_msgs/Image -> (H, W, 3) uint8 or (H, W) uint16 / float32, without a copy.

    Raises PerceptionError for other encodings and for images whose data do not fit their size.
    """
    if image.encoding not in _IMAGE_TYPES:
        raise PerceptionError(
            f"{name}: encoding '{image.encoding}' is not one of {', '.join(_IMAGE_TYPES)}"
        )
    dtype, channels = _IMAGE_TYPES[image.encoding]
    row = image.width * channels * np.dtype(dtype).itemsize
    if (
        image.width == 0
        or image.height == 0
        or image.step < row
        or (len(image.data) != image.step * image.height)
    ):
        raise PerceptionError(
            f"{name}: an image of {image.width}x{image.height} px {image.encoding} cannot have "
            f"{len(image.data)} bytes"
        )
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    pixels = np.ascontiguousarray(rows[:, :row]).view(dtype)
    if image.is_bigendian and np.dtype(dtype).itemsize > 1:
        pixels = pixels.byteswap()
    shape = (image.height, image.width) + ((channels,) if channels > 1 else ())
    return pixels.reshape(shape)


def depth_to_message(depth: np.ndarray, header) -> Image:
    """(H, W) float32 m, NaN invalid -> sensor_msgs/Image 32FC1."""
    height, width = depth.shape
    data = np.ascontiguousarray(depth, "<f4").tobytes()
    return Image(header, height, width, "32FC1", False, 4 * width, data)


def camera_intrinsics(info) -> CameraIntrinsics:
    """Raises PerceptionError for a camera that is not calibrated."""
    if not (info.K[0] > 0 and info.K[4] > 0):
        raise PerceptionError("camera info: no positive focal length; is the camera calibrated?")
    return CameraIntrinsics(fx=info.K[0], fy=info.K[4], cx=info.K[2], cy=info.K[5])


def grasp_to_message(grasp: GraspRectangle) -> msg.GraspRectangle:
    return msg.GraspRectangle(**_named(grasp, _GRASP))


def grasp_from_message(message: msg.GraspRectangle) -> GraspRectangle:
    return GraspRectangle(**_named(message, _GRASP))


def failed_to_message(failed: Iterable[GraspRectangle], header) -> msg.FailedGrasps:
    return msg.FailedGrasps(header=header, grasps=[grasp_to_message(g) for g in failed])


def object_to_message(value: ObjectGrasps) -> msg.ObjectGrasps:
    message = msg.ObjectGrasps(
        grasps=[grasp_to_message(g) for g in value.grasps], **_named(value, _OBJECT)
    )
    box = message.box
    box.x_offset, box.y_offset = value.box.x, value.box.y
    box.width, box.height = value.box.width, value.box.height
    return message


def object_from_message(message: msg.ObjectGrasps) -> ObjectGrasps:
    box = message.box
    return ObjectGrasps(
        box=Box(box.x_offset, box.y_offset, box.width, box.height),
        grasps=tuple(grasp_from_message(g) for g in message.grasps),
        **_named(message, _OBJECT),
    )


def ranked_to_message(value: RankedObject) -> msg.RankedObject:
    return msg.RankedObject(object=object_to_message(value.object), **_named(value, _RANKED))


def ranked_from_message(message: msg.RankedObject) -> RankedObject:
    return RankedObject(object=object_from_message(message.object), **_named(message, _RANKED))


def _named(source, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}
