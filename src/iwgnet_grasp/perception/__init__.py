"""From one look at the table to boxes, merged depth and grasps. Knows no ROS."""

from iwgnet_grasp.perception.pipeline import Perception, PerceptionConfig, load_perception
from iwgnet_grasp.perception.types import (
    Box,
    CameraIntrinsics,
    Detection,
    GraspRectangle,
    Look,
    ObjectGrasps,
    PerceptionError,
    Window,
)

__all__ = [
    "Box",
    "CameraIntrinsics",
    "Detection",
    "GraspRectangle",
    "Look",
    "ObjectGrasps",
    "Perception",
    "PerceptionConfig",
    "PerceptionError",
    "Window",
    "load_perception",
]
