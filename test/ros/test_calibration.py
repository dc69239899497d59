"""The calibrator by visp_hand2eye_calibration's interface; a short calibration over the graph."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from iwgnet_grasp.calibration.samples import simulated
from iwgnet_grasp.calibration.settings import difference, inverse, matrix
from iwgnet_grasp.ros.session import free_master_uri

ROOT = Path(__file__).resolve().parents[2]

# rosmsg md5 / rossrv md5 of visp_hand2eye_calibration (lagadic/vision_visp)
MD5 = {
    "TransformArray": "69339633e969be70367b6ff0fe206328",
    "compute_effector_camera": "e28a9ea34e6e135a6309cbdf6fb0ad0d",
    "compute_effector_camera_quick": "ac7e8b661c5bfedda75b54410a11cf73",
    "reset": "d41d8cd98f00b204e9800998ecf8427e",
}


@pytest.fixture(scope="module")
def calibrator(graph):
    """An eye-to-hand calibrator on the tests' master; its process."""
    process = start("calibrator", "_eye_to_hand:=true")
    import rospy

    rospy.wait_for_service("/reset", 30)
    yield process
    process.terminate()
    process.wait(10)


def start(name: str, *arguments: str) -> subprocess.Popen:
    from iwgnet_grasp import _core

    program = Path(_core.__file__).parents[3] / "iwgnet_grasp" / name
    return subprocess.Popen([program, *arguments], stdout=subprocess.DEVNULL)


def transform(T: np.ndarray):
    from geometry_msgs.msg import Transform

    from iwgnet_grasp.ros.calibration import _fill

    message = Transform()
    _fill(message, T)
    return message


def quick(effector, camera) -> np.ndarray:
    import rospy
    from visp_hand2eye_calibration.msg import TransformArray
    from visp_hand2eye_calibration.srv import compute_effector_camera_quick

    from iwgnet_grasp.ros.calibration import _matrix

    service = rospy.ServiceProxy("/compute_effector_camera_quick", compute_effector_camera_quick)
    answer = service(
        TransformArray(transforms=[transform(T) for T in camera]),
        TransformArray(transforms=[transform(T) for T in effector]),
    ).effector_camera
    return _matrix(answer.translation, answer.rotation)


def test_interface_is_the_originals(calibrator):
    import rosservice
    from visp_hand2eye_calibration import msg, srv

    for name, md5 in MD5.items():
        kind = getattr(msg, name, None) or getattr(srv, name)
        assert kind._md5sum == md5, name
    for name in ("compute_effector_camera", "compute_effector_camera_quick", "reset"):
        assert rosservice.get_service_type(f"/{name}") == f"visp_hand2eye_calibration/{name}"
    import rostopic

    for topic in ("/camera_object", "/world_effector"):
        assert rostopic.get_topic_type(topic)[0] in (None, "geometry_msgs/Transform")


def test_client_recovers_its_known_transform_by_both_services(calibrator):
    client = start("calibration_client", "_eye_to_hand:=true")
    assert client.wait(60) == 0


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda e, c: (e[:3], c[:3]), "only 3 pairs"),
        (lambda e, c: (e, c[:-1]), "7 camera_object but 8 world_effector"),
        (lambda e, c: ([*e, e[2]], [*c, c[2]]), "same robot pose"),
        (lambda e, c: (e, [c[0] @ shift(np.nan), *c[1:]]), "not a number"),
        (lambda e, c: yaw_only(), "one axis"),
        (lambda e, c: in_hand(e), "fit a camera on the effector"),
        (lambda e, c: (e, c[::-1]), "contradict|residual too high|no convergence"),
    ],
    ids=["few", "unequal", "repeated", "nan", "yaw_only", "eye_in_hand", "mixed_up"],
)
def test_bad_pairs_are_refused_with_the_reason_and_the_node_serves_on(spoil, said, calibrator):
    import rospy

    samples, truth = simulated(8, (1e-7, 1e-7), np.random.default_rng(4))
    effector, camera = samples.T_base_tool, samples.T_camera_target
    with pytest.raises(rospy.ServiceException, match=said):
        quick(*spoil(effector, camera))
    found = quick(effector, camera)
    assert difference(found, truth)[0] < 1e-5 and calibrator.poll() is None


def shift(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def turned(axis, rad, move) -> np.ndarray:
    import cv2

    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(axis, float) * rad)[0]
    T[:3, 3] = move
    return T


def yaw_only():
    X, Y = turned([1, 0, 0], np.pi, [0.5, 0, 0.6]), turned([0, 0, 1], 0.3, [0, 0, 0.2])
    effector = [turned([0, 0, 1], 0.2 * i, [0.4 + 0.02 * i, 0.01 * i, 0.2]) for i in range(8)]
    return effector, [inverse(X) @ T @ Y for T in effector]


def in_hand(effector):
    """The same motions with the camera on the tool and the target on the table."""
    X, target = turned([0, 0, 1], 0.4, [0.05, 0, 0.08]), turned([0, 0, 1], 0.0, [0.5, 0, 0])
    return effector, [inverse(T @ X) @ target for T in effector]


def test_a_call_while_pairs_come_in_is_refused_and_the_rest_is_not_lost(calibrator):
    import rospy
    from geometry_msgs.msg import Transform
    from visp_hand2eye_calibration.srv import compute_effector_camera, reset

    from iwgnet_grasp.ros.calibration import _matrix

    samples, truth = simulated(6, (1e-7, 1e-7), np.random.default_rng(5))
    camera = rospy.Publisher("/camera_object", Transform, queue_size=100)
    effector = rospy.Publisher("/world_effector", Transform, queue_size=100)
    compute = rospy.ServiceProxy("/compute_effector_camera", compute_effector_camera)
    rospy.ServiceProxy("/reset", reset)()
    end = time.monotonic() + 20
    while not (camera.get_num_connections() and effector.get_num_connections()):
        assert time.monotonic() < end
        time.sleep(0.02)
    for T in samples.T_base_tool:
        effector.publish(transform(T))
    for T in samples.T_camera_target[:-1]:
        camera.publish(transform(T))
    said = eventually(lambda: refusal(compute), "5 camera_object but 6 world_effector")
    assert "then call again" in said
    camera.publish(transform(samples.T_camera_target[-1]))
    eventually(lambda: refusal(compute), "^$")
    answer = compute().effector_camera
    assert difference(_matrix(answer.translation, answer.rotation), truth)[0] < 1e-5
    rospy.ServiceProxy("/reset", reset)()
    assert "only 0 pairs" in refusal(compute)


def refusal(compute) -> str:
    import rospy

    try:
        compute()
    except rospy.ServiceException as error:
        return str(error)
    return ""


def eventually(ask, pattern: str, seconds: float = 20.0) -> str:
    """Messages and calls take different ways."""
    import re

    end = time.monotonic() + seconds
    while not re.search(pattern, said := ask()):
        assert time.monotonic() < end, said
        time.sleep(0.05)
    return said


def test_stamped_pairs_and_a_result_with_residuals(calibrator):
    import rospy
    from iwgnet_grasp.msg import CalibrationPair, HandEyeResult, Topics
    from visp_hand2eye_calibration.srv import compute_effector_camera, reset

    samples, _ = simulated(7, (2e-4, 5e-4), np.random.default_rng(6))
    results = []
    rospy.Subscriber("/calibrator/result", HandEyeResult, results.append, queue_size=5)
    pairs = rospy.Publisher(Topics.CALIBRATION_PAIR, CalibrationPair, queue_size=100)
    compute = rospy.ServiceProxy("/compute_effector_camera", compute_effector_camera)
    rospy.ServiceProxy("/reset", reset)()
    eventually(lambda: "yes" if pairs.get_num_connections() else "", "yes")
    for sample in samples.samples:
        pair = CalibrationPair()
        pair.world_effector = transform(sample.T_base_tool)
        pair.camera_object = transform(sample.T_camera_target)
        pairs.publish(pair)
    eventually(lambda: refusal(compute), "^$")
    eventually(lambda: str([len(r.weights) for r in results]), "7")
    result = results[-1]
    assert result.eye_to_hand and len(result.translation_residuals) == 7
    assert 0 < result.rms_translation < 2e-3 and result.leave_one_out_translation > 0
    assert result.largest_rotation > 0.3 and result.axis_spread > 0.1
    rospy.ServiceProxy("/reset", reset)()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("poses:=3", "4 to 60"),
        ("poses:=many", "whole number"),
        ("board:=chess", "charuco"),
        ("source:=guess", "images"),
        ("out:=result.txt", ".yaml"),
        ("scene:=five_scattered", "known:"),
    ],
)
def test_a_bad_argument_ends_with_status_2_and_one_line(argument, said):
    done = subprocess.run(
        [ROOT / "scripts/start_calibration", argument], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert said in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_short_calibration_over_the_graph(graph, tmp_path):
    out = tmp_path / "camera.yaml"
    done = subprocess.run(
        [sys.executable, "-m", "iwgnet_grasp.ros.calibration", "--poses", "6", "--seed", "3"]
        + ["--board", "charuco", "--source", "images", "--driver", "simulation"]
        + ["--camera-offset-seed", "3", "--out", str(out)],
        env={**os.environ, "ROS_MASTER_URI": free_master_uri()},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "T_base_camera = [" in done.stdout and "OpenCV Daniilidis" in done.stdout
    verdict = next(line for line in done.stdout.splitlines() if line.startswith("judge:"))
    words = verdict.split()
    assert float(words[1]) < 0.8 and float(words[4]) < 0.1  # mm, deg
    nominal = matrix(yaml.safe_load((ROOT / "config/camera.yaml").read_text())["T_base_color"])
    result = yaml.safe_load(out.read_text())
    assert difference(matrix(result["T_base_color"]), nominal)[0] > 1e-3
    assert len(result["samples"]) == 6
    for picture in (out.with_suffix(".png"), out.with_suffix(".board.png")):
        assert picture.stat().st_size > 10_000
