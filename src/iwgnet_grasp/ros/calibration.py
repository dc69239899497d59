"""One calibration on a graph of its own: what scripts/start_calibration runs.

Exit status: 0 calibrated, 1 not.
"""

from __future__ import annotations

import argparse
import collections
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from iwgnet_grasp.calibration import report
from iwgnet_grasp.calibration.board import NAMES, Board, DetectionError
from iwgnet_grasp.calibration.poses import PosePlanner
from iwgnet_grasp.calibration.routine import SOURCES, Look, collect
from iwgnet_grasp.calibration.samples import Sample, SampleSet, save
from iwgnet_grasp.calibration.settings import (
    PACKAGE,
    CalibrationError,
    Settings,
    difference,
    load_settings,
)
from iwgnet_grasp.calibration.solve import Calibration, compare, solve
from iwgnet_grasp.progress import interrupt_on
from iwgnet_grasp.ros.session import Session
from iwgnet_grasp.supervisor import CellError

_WAIT = 60.0  # wall s for what should come at once; the machine may be busy
_IMAGE_BYTES = 16 * 1024 * 1024  # rospy reads an image in one piece


class RosCell:
    """routine.Cell on the graph of launch/calibration.launch, inside a rospy node, with the
    calibrator and the simulator's truth. check: raises CellError when the graph is broken."""

    def __init__(self, settings: Settings, simulated: bool, check: Callable[[], None]) -> None:
        import actionlib
        import rospy
        from control_msgs.msg import FollowJointTrajectoryAction
        from sensor_msgs.msg import JointState

        from iwgnet_grasp import _core
        from iwgnet_grasp.msg import CalibrationPair, HandEyeResult, Topics

        self._rospy, self._topics = rospy, Topics
        self._settings, self._simulated, self._check = settings, simulated, check
        self._names = list(_core.JOINT_NAMES)
        self._changed = threading.Condition()
        # (stamp s, q, qd), newest last: two seconds of a driver at 500 Hz
        self._states: collections.deque = collections.deque(maxlen=1000)
        self._result: Any = None
        self._arm = actionlib.ActionClient(Topics.ARM_ACTION, FollowJointTrajectoryAction)
        self._pair = rospy.Publisher(Topics.CALIBRATION_PAIR, CalibrationPair, queue_size=100)
        self._subscribers = [
            rospy.Subscriber(Topics.JOINT_STATES, JointState, self._on_joints, queue_size=100),
            rospy.Subscriber("/calibrator/result", HandEyeResult, self._on_result, queue_size=1),
        ]

    def wait_until_ready(self) -> None:
        """Raises CellError naming what is missing."""

        def missing() -> str:
            if not self._states:
                return f"no joint state of the arm on {self._topics.JOINT_STATES}"
            if not self._arm.wait_for_server(self._rospy.Duration(0.01)):
                return f"no action server on {self._topics.ARM_ACTION}"
            if self._pair.get_num_connections() == 0:
                return "the calibrator is not running"
            return ""

        self._wait(lambda: not missing(), _WAIT, missing)
        from visp_hand2eye_calibration.srv import reset

        self._call("/reset", reset)

    # routine.Cell

    def joints(self) -> np.ndarray:
        return self._state()[1]

    def move(self, trajectory: Any) -> None:
        from control_msgs.msg import FollowJointTrajectoryGoal
        from trajectory_msgs.msg import JointTrajectoryPoint

        from iwgnet_grasp.ros.action import Goal

        message = FollowJointTrajectoryGoal()
        message.trajectory.joint_names = self._names
        message.trajectory.header.frame_id = self._topics.BASE_FRAME
        for at, q, qd in zip(trajectory.times, trajectory.q, trajectory.qd, strict=True):
            message.trajectory.points.append(
                JointTrajectoryPoint(
                    positions=q, velocities=qd, time_from_start=self._rospy.Duration(at)
                )
            )
        goal = Goal(self._arm, message, self._notify)
        try:
            self._wait(goal.done.is_set, 300.0, lambda: f"no result from {self._topics.ARM_ACTION}")
        except BaseException:  # ctrl-C too: the arm must not go on by itself
            goal.cancel()
            raise
        if goal.result is None or goal.result.error_code != 0:
            why = goal.result.error_string if goal.result else f"status {goal.status}"
            raise CellError(f"the arm did not follow its trajectory: {why}")
        self._settle()

    def _settle(self) -> None:
        """Waits until no joint has moved for a while; what does not settle, look() refuses."""
        s = self._settings
        start = self._state()[0]

        def still() -> bool:
            newest = self._state()[0]
            if newest - start > s.settle_give_up:
                return True
            recent = self._states_since(newest - s.settle_time)
            quiet = all(np.abs(qd).max() <= s.settle_speed for _, _, qd in recent)
            return newest - start >= s.settle_time and quiet

        self._wait(still, _WAIT, lambda: "the arm's joint states have stopped")

    def look(self, source: str) -> Look:
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import Image

        before = self._state()
        if np.abs(before[2]).max() > self._settings.settle_speed:
            raise DetectionError("the arm does not come to rest")
        topic, kind = (
            (self._topics.COLOR_IMAGE, Image)
            if source == "images"
            else (self._topics.TARGET_POSE, PoseStamped)
        )
        message = self._next(topic, kind, before[0])
        stamp = message.header.stamp.to_sec()
        self._wait(
            lambda: self._state()[0] >= stamp, _WAIT, lambda: "no joint state after the image"
        )
        states = self._states_since(before[0])
        moved = max(np.abs(q - before[1]).max() for _, q, _ in states)
        if moved > self._settings.max_motion:
            raise DetectionError(f"the arm moved by {moved:.1e} rad while the image was taken")
        # The state at the image's own time.
        joints = min(states, key=lambda state: abs(state[0] - stamp))[1]
        if source == "images":
            from iwgnet_grasp.ros.messages import image_array

            return Look(joints, np.array(image_array(message, topic)))
        return Look(
            joints, T_camera_target=_matrix(message.pose.position, message.pose.orientation)
        )

    def intrinsics(self) -> tuple[int, int, float, float, float, float]:
        from sensor_msgs.msg import CameraInfo

        info = self._next(self._topics.COLOR_INFO, CameraInfo, 0.0)
        if np.any(np.abs(info.D) > 1e-9):
            raise CellError(
                f"{self._topics.COLOR_INFO} has lens distortion; calibrate on rectified images"
            )
        return info.width, info.height, info.K[0], info.K[4], info.K[2], info.K[5]

    # the calibrator

    def add_pair(self, sample: Sample) -> None:
        from iwgnet_grasp.msg import CalibrationPair

        pair = CalibrationPair()
        pair.header.stamp = self._rospy.Time.now()
        _fill(pair.world_effector, sample.T_base_tool)
        _fill(pair.camera_object, sample.T_camera_target)
        self._pair.publish(pair)

    def solve(self, count: int) -> Any:
        """The calibrator's HandEyeResult on all `count` pairs. Raises CalibrationError with its
        reason when it refuses."""
        from visp_hand2eye_calibration.srv import compute_effector_camera

        end = time.monotonic() + _WAIT
        while True:
            self._result = None
            refusal = ""
            try:
                self._call("/compute_effector_camera", compute_effector_camera)
            except CalibrationError as error:
                refusal = str(error)
            else:
                self._wait(
                    lambda: self._result is not None, _WAIT, lambda: "nothing on /calibrator/result"
                )
                if len(self._result.weights) == count:
                    return self._result
            # Topics and services come by different connections: pairs may be on their way still.
            got = re.search(r"only (\d+) pairs", refusal)
            if (refusal and not (got and int(got[1]) < count)) or time.monotonic() > end:
                raise CalibrationError(refusal or f"the calibrator did not get all {count} pairs")
            time.sleep(0.1)

    def publish(self, T_base_camera: np.ndarray) -> None:
        """Has camera_pose publish base_link -> camera_link anew and waits until tf says so."""
        import tf2_ros
        from geometry_msgs.msg import TransformStamped

        buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(buffer)
        self._camera_pose = self._rospy.Publisher(
            self._topics.CAMERA_POSE, TransformStamped, queue_size=1, latch=True
        )
        message = TransformStamped()
        message.header.stamp = self._rospy.Time.now()
        message.header.frame_id = self._topics.BASE_FRAME
        message.child_frame_id = self._topics.COLOR_FRAME
        _fill(message.transform, T_base_camera)
        self._camera_pose.publish(message)

        def told() -> bool:
            try:
                found = buffer.lookup_transform(
                    self._topics.BASE_FRAME, self._topics.COLOR_FRAME, self._rospy.Time(0)
                ).transform
            except tf2_ros.TransformException:
                return False
            move, turn = difference(_matrix(found.translation, found.rotation), T_base_camera)
            return move < 1e-6 and turn < 1e-6

        self._wait(told, _WAIT, lambda: "tf does not show the calibrated camera pose")

    def show(self, calibration: Calibration, samples: SampleSet, outline: np.ndarray) -> None:
        """Boards, tool poses and the camera's view as latched markers for rviz."""
        from visualization_msgs.msg import MarkerArray

        self._markers = self._rospy.Publisher(
            self._topics.CALIBRATION_MARKERS, MarkerArray, queue_size=1, latch=True
        )
        self._markers.publish(MarkerArray(_markers(self._topics, calibration, samples, outline)))

    # the judge's side

    def truth(self) -> np.ndarray:
        """The simulator's T_base_camera."""
        from iwgnet_grasp.srv import CalibrationTruth

        base_camera = self._call(self._topics.CALIBRATION_TRUTH, CalibrationTruth).base_camera
        return _matrix(base_camera.translation, base_camera.rotation)

    # waiting

    def _state(self) -> tuple[float, np.ndarray, np.ndarray]:
        return self._states[-1]

    def _states_since(self, stamp: float) -> list[tuple[float, np.ndarray, np.ndarray]]:
        with self._changed:  # rospy's thread adds to them
            return [state for state in self._states if state[0] >= stamp]

    def _on_joints(self, message: Any) -> None:
        if not set(self._names) <= set(message.name):
            return  # the gripper's
        order = [message.name.index(name) for name in self._names]
        q = np.array([message.position[i] for i in order])
        qd = np.array([message.velocity[i] for i in order])
        with self._changed:
            self._states.append((message.header.stamp.to_sec(), q, qd))
            self._changed.notify_all()

    def _on_result(self, message: Any) -> None:
        self._result = message
        self._notify()

    def _next(self, topic: str, kind: Any, after: float) -> Any:
        """The first message stamped later than `after` s. The camera renders only while somebody
        listens, so nobody listens for longer than that."""
        found: list[Any] = []

        def keep(message: Any) -> None:
            if message.header.stamp.to_sec() > after:
                found.append(message)
                self._notify()

        subscriber = self._rospy.Subscriber(
            topic, kind, keep, queue_size=1, buff_size=_IMAGE_BYTES, tcp_nodelay=True
        )
        try:
            self._wait(lambda: bool(found), _WAIT, lambda: f"nothing new on {topic}")
        finally:
            subscriber.unregister()
        return found[0]

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _wait(self, done: Callable[[], bool], seconds: float, missing: Callable[[], str]) -> None:
        end = time.monotonic() + seconds
        next_check = time.monotonic() + 0.5
        while not done():
            now = time.monotonic()
            if self._rospy.is_shutdown():
                raise CellError("ROS is shutting down")
            if now > end:
                raise CellError(f"{missing()} after {seconds:.0f} s")
            if now > next_check:
                self._check()
                next_check = now + 0.5
            with self._changed:
                self._changed.wait(0.02)

    def _call(self, name: str, kind: Any) -> Any:
        """Raises CalibrationError with the reason that the service gives."""
        rospy = self._rospy
        try:
            rospy.wait_for_service(name, _WAIT)
            return rospy.ServiceProxy(name, kind)()
        except rospy.ServiceException as error:
            self._check()  # a dead node is the better explanation
            said = re.search(r"responded with an error: b'(.*)'$", str(error))
            raise CalibrationError(said[1] if said else f"{name}: {error}") from None
        except rospy.ROSException as error:
            raise CellError(f"{name}: {error}") from None


def _matrix(move: Any, turn: Any) -> np.ndarray:
    """(4, 4) of a vector and a quaternion message."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = move.x, move.y, move.z
    return T


def _fill(message: Any, T: np.ndarray) -> None:
    """T into a geometry_msgs/Transform."""
    q, t = message.rotation, message.translation
    q.x, q.y, q.z, q.w = Rotation.from_matrix(T[:3, :3]).as_quat()
    t.x, t.y, t.z = T[:3, 3]


def _markers(topics: Any, calibration: Calibration, samples: SampleSet, outline: np.ndarray):
    from geometry_msgs.msg import Point
    from std_msgs.msg import ColorRGBA
    from visualization_msgs.msg import Marker

    def lines(name: str, points: Sequence[np.ndarray], colors: Sequence[tuple], width: float):
        marker = Marker(ns=name, type=Marker.LINE_LIST)
        marker.header.frame_id = topics.BASE_FRAME
        marker.pose.orientation.w = 1.0
        marker.scale.x = width
        marker.points = [Point(*map(float, p)) for p in points]
        marker.colors = [ColorRGBA(*color, 1.0) for color in colors]
        return marker

    def place(T: np.ndarray, points: np.ndarray) -> np.ndarray:
        return points @ T[:3, :3].T + T[:3, 3]

    boards, board_colors, axes, axis_colors = [], [], [], []
    for sample, weight in zip(samples.samples, calibration.weights, strict=True):
        T = sample.T_base_tool @ calibration.T_tool_target
        edge = place(T, outline)
        for a, b in zip(edge, np.roll(edge, -1, axis=0), strict=True):
            boards += [a, b]
            board_colors += [(0.2, 0.9, 0.3) if weight >= 0.1 else (1.0, 0.2, 0.1)] * 2
        for i, color in enumerate(np.eye(3)):
            axes += [T[:3, 3], T[:3, 3] + 0.04 * T[:3, i]]
            axis_colors += [tuple(color)] * 2
    width, height, fx, fy, cx, cy = samples.intrinsics
    far = 0.25  # m, how much of the camera's view is drawn
    corners = np.array(
        [
            [(u - cx) / fx, (v - cy) / fy, 1.0]
            for u, v in ((0, 0), (width, 0), (width, height), (0, height))
        ]
    )
    corners = place(calibration.T_base_camera, far * corners)
    view = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        view += [calibration.T_base_camera[:3, 3], a, a, b]
    return [
        lines("boards", boards, board_colors, 0.002),
        lines("board_axes", axes, axis_colors, 0.003),
        lines("camera_view", view, [(1.0, 0.8, 0.1)] * len(view), 0.002),
    ]


def run(options: argparse.Namespace, settings: Settings) -> None:
    """The whole calibration. Raises CalibrationError or CellError with the reason."""
    simulated = options.driver == "simulation"
    board = Board(options.board, settings)
    print_file = options.out.with_suffix(".board.png")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(print_file), board.print())
    noise = settings.noise if options.source == "images" else settings.simulated_noise
    launch = [
        f"driver:={options.driver}",
        f"seed:={options.seed}",
        f"camera_offset_seed:={options.camera_offset_seed}",
        f"board_print:={print_file.resolve()}",
        f"noise_translation:={noise[0]}",
        f"noise_rotation:={noise[1]}",
    ]
    log_dir = options.out.with_suffix(".log")
    with Session("calibration.launch", launch, log_dir) as session:
        _on_graph(session, board, simulated, options, settings)


def _on_graph(
    session: Session, board: Board, simulated: bool, options: argparse.Namespace, settings: Settings
) -> None:
    import rospy  # reads the session's environment

    os.environ["ROS_LOG_DIR"] = str(session.log.parent)
    rospy.init_node("calibration", disable_signals=True)
    try:
        cell = RosCell(settings, simulated, session.check)
        cell.wait_until_ready()
        started = rospy.get_time()
        planner = PosePlanner(settings, options.seed)
        origin = {"board": options.board, "seed": options.seed, "transport": "ros"}
        samples = collect(
            cell, planner, board, settings, options.poses, options.source, origin, _say
        )
        for sample in samples.samples:
            cell.add_pair(sample)
        visp = cell.solve(len(samples.samples)).visp
        calibration = solve(samples, _matrix(visp.translation, visp.rotation))
        cell.publish(calibration.T_base_camera)
        outline = _outline(settings)
        cell.show(calibration, samples, outline)
        _say("")
        for line in report.text(calibration, samples):
            _say(line)
        truth = cell.truth() if simulated else None
        _say("")
        for line in report.methods_table(compare(samples), samples, truth):
            _say(line)
        save(options.out, samples, report.as_dict(calibration))
        _say("")
        _say(f"{rospy.get_time() - started:.0f} s on the cell's clock; wrote {options.out}")
        if samples.has_images:
            picture = options.out.with_suffix(".png")
            report.draw(calibration, samples, outline, picture)
            _say(f"residuals in the images: {picture}")
        if truth is not None:  # what only the simulator's judge can know
            move, turn = difference(calibration.T_base_camera, truth)
            _say(f"judge: {move * 1e3:.3f} mm and {np.degrees(turn):.4f} deg from the true pose")
        if options.rviz_picture:
            subprocess.run(
                [PACKAGE / "scripts/start_rviz", "--off-screen", options.rviz_picture], check=True
            )
    finally:
        rospy.signal_shutdown("the calibration is over")


def _outline(settings: Settings) -> np.ndarray:
    """(4, 3) m, the print's corners in the board frame."""
    x, y = settings.print_size / 2
    return np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])


def _say(line: str) -> None:
    print(line, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="start_calibration")
    parser.add_argument("--poses", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--board", choices=NAMES, required=True)
    parser.add_argument("--source", choices=SOURCES, required=True)
    parser.add_argument("--driver", choices=("simulation", "real"), required=True)
    parser.add_argument("--camera-offset-seed", type=int, required=True)
    parser.add_argument("--rviz-picture", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    interrupt_on(signal.SIGTERM)
    try:
        run(options, load_settings())
    except KeyboardInterrupt:
        print("start_calibration: interrupted; everything is stopped", file=sys.stderr)
        return 1
    except (CalibrationError, CellError, OSError, subprocess.CalledProcessError) as error:
        print(f"start_calibration: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
