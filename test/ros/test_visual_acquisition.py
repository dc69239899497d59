"""What a look is made of, and what is refused, by a visual_acquisition on a camera of our own."""

from __future__ import annotations

import os
import subprocess

import numpy as np
import pytest
import rospy
from iwgnet_grasp.msg import Scene, Topics
from iwgnet_grasp.srv import Capture
from roslib.packages import find_node
from sensor_msgs.msg import CameraInfo, Image

from iwgnet_grasp.ros.messages import image_array

WIDTH, HEIGHT = 64, 48


class Camera:
    """Publishes the three topics at 20 Hz until closed; `frame` may be changed at any time."""

    def __init__(self, prefix):
        self.publishers = [
            rospy.Publisher(prefix + topic, kind, queue_size=2)
            for topic, kind in (
                (Topics.COLOR_IMAGE, Image),
                (Topics.ALIGNED_DEPTH_IMAGE, Image),
                (Topics.COLOR_INFO, CameraInfo),
            )
        ]
        self.reset()
        self.timer = rospy.Timer(rospy.Duration(0.05), self.publish)

    def reset(self):
        depth = np.full((HEIGHT, WIDTH), 600, np.uint16)
        depth[:4] = 0
        self.color = image(np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8), "rgb8")
        self.depth = image(depth, "16UC1")
        self.info = CameraInfo(width=WIDTH, height=HEIGHT, D=[0.0] * 5)
        self.info.K = [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]
        self.silent = False

    def publish(self, _):
        if self.silent:
            return
        now = rospy.Time.now()
        messages = (self.color, self.depth, self.info)
        for publisher, message in zip(self.publishers, messages, strict=True):
            message.header.stamp = now
            message.header.frame_id = Topics.COLOR_FRAME
            publisher.publish(message)


def image(array: np.ndarray, encoding: str) -> Image:
    height, width = array.shape[:2]
    return Image(
        height=height,
        width=width,
        encoding=encoding,
        step=array.strides[0],
        data=array.tobytes(),
    )


@pytest.fixture(scope="module")
def acquisition(graph):
    """(camera, capture, topic of the scenes) of a node that nobody else uses."""
    prefix = "/other"
    names = [Topics.COLOR_IMAGE, Topics.ALIGNED_DEPTH_IMAGE, Topics.COLOR_INFO, Topics.SCENE]
    names.append(Topics.CAPTURE)
    node = subprocess.Popen(
        find_node("iwgnet_grasp", "visual_acquisition")[:1]
        + ["__name:=other_acquisition", "_timeout:=3"]
        + [f"{name}:={prefix}{name}" for name in names],
        env=dict(os.environ),
    )
    camera = Camera(prefix)
    rospy.wait_for_service(prefix + Topics.CAPTURE, 60)
    yield camera, rospy.ServiceProxy(prefix + Topics.CAPTURE, Capture), prefix + Topics.SCENE
    camera.timer.shutdown()
    assert node.poll() is None, "the node died"
    node.terminate()
    node.wait(10)


@pytest.fixture
def camera(acquisition):
    acquisition[0].reset()
    return acquisition[0]


def test_without_an_empty_scene_a_look_is_refused(acquisition, camera):
    answer = acquisition[1](empty_scene=False)
    assert not answer.success and "empty_scene" in answer.message


def test_millimetres_and_metres_give_the_same_scene(acquisition, camera):
    _, capture, topic = acquisition
    assert capture(empty_scene=True).success
    scenes = []
    metres = np.full((HEIGHT, WIDTH), 0.6, np.float32)
    metres[:4] = np.nan
    for depth in (camera.depth, image(metres, "32FC1")):
        camera.depth = depth
        answer = capture(empty_scene=False)
        assert answer.success, answer.message
        scene = rospy.wait_for_message(topic, Scene, 10)
        assert scene.scene_id == answer.scene_id
        scenes.append(image_array(scene.depth, "depth"))
    assert scenes[0] == pytest.approx(scenes[1], nan_ok=True)
    assert np.isnan(scenes[0][:4]).all()


def test_the_lens_distortion_is_taken_out(acquisition, camera):
    _, capture, topic = acquisition
    depth = np.full((HEIGHT, WIDTH), 600, np.uint16)
    depth[:, :8] = 500
    camera.depth = image(depth, "16UC1")
    camera.info.D = [0.3, 0.0, 0.0, 0.0, 0.0]
    assert capture(empty_scene=True).success
    answer = capture(empty_scene=False)
    assert answer.success, answer.message
    scene = rospy.wait_for_message(topic, Scene, 10)
    assert not any(scene.camera_info.D)
    row = image_array(scene.depth, "depth")[HEIGHT // 2]
    # Column x of the ideal image is read at x_d = x (1 + k1 r^2), here further out.
    x = (np.arange(WIDTH) - 31.5) / 60.0
    read_at = 31.5 + 60.0 * x * (1 + 0.3 * x**2)
    inside = (read_at > 0) & (read_at < WIDTH - 1) & (np.abs(read_at - 7.5) > 1.0)
    assert row[inside] == pytest.approx(np.where(read_at < 7.5, 0.5, 0.6)[inside])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda c: setattr(c.color, "encoding", "mono8"), "mono8"),
        (lambda c: setattr(c.depth, "encoding", "8UC1"), "8UC1"),
        (lambda c: setattr(c.depth, "data", c.depth.data[:100]), "bytes"),
        (lambda c: setattr(c, "depth", image(np.full((20, 30), 600, np.uint16), "16UC1")), "30x20"),
        (lambda c: setattr(c.info, "width", 640), "640x48"),
        (lambda c: setattr(c.info, "K", [0.0] * 9), "calibrated"),
        (
            lambda c: setattr(c, "depth", image(np.zeros((HEIGHT, WIDTH), np.uint16), "16UC1")),
            "no pixel",
        ),
        (lambda c: setattr(c, "silent", True), "driver running"),
    ],
    ids=[
        "colour encoding",
        "depth encoding",
        "short data",
        "depth size",
        "info size",
        "no focal length",
        "no depth at all",
        "no camera",
    ],
)
def test_a_bad_camera_is_refused_in_one_line_and_the_node_goes_on(acquisition, camera, spoil, said):
    _, capture, _ = acquisition
    spoil(camera)
    answer = capture(empty_scene=True)
    assert not answer.success
    assert said in answer.message and "\n" not in answer.message
    camera.reset()
    assert capture(empty_scene=True).success
