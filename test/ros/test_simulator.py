"""The simulator speaks the interfaces of the real drivers."""

from __future__ import annotations

import actionlib
import numpy as np
import pytest
import rospy
from control_msgs.msg import (
    FollowJointTrajectoryAction,
    FollowJointTrajectoryGoal,
    FollowJointTrajectoryResult,
    GripperCommandAction,
    GripperCommandGoal,
    JointTolerance,
    JointTrajectoryControllerState,
)
from iwgnet_grasp.msg import Topics
from iwgnet_grasp.srv import Judge, LoadScene, Step
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from iwgnet_grasp.ros.action import Goal

JOINTS = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
]


@pytest.fixture(scope="module")
def arm(graph):
    client = actionlib.ActionClient(Topics.ARM_ACTION, FollowJointTrajectoryAction)
    assert client.wait_for_server(rospy.Duration(60))
    load("", 0)
    return client


@pytest.fixture(scope="module")
def gripper(graph):
    client = actionlib.ActionClient(Topics.GRIPPER_ACTION, GripperCommandAction)
    assert client.wait_for_server(rospy.Duration(60))
    return client


def load(scene: str, seed: int):
    rospy.wait_for_service(Topics.LOAD_SCENE, 60)
    return rospy.ServiceProxy(Topics.LOAD_SCENE, LoadScene)(scene, seed)


def joints() -> np.ndarray:
    """Arm joints (rad) in kinematic order, found by name."""
    while True:
        state = rospy.wait_for_message(Topics.JOINT_STATES, JointState, 10)
        if JOINTS[0] in state.name:
            return np.array([state.position[state.name.index(name)] for name in JOINTS])


def trajectory(target: np.ndarray, seconds: float, names=JOINTS) -> JointTrajectory:
    points = [
        JointTrajectoryPoint(
            positions=list(q), velocities=[0.0] * len(q), time_from_start=rospy.Duration(t)
        )
        for q, t in ((joints()[: len(target)], 0.0), (target, seconds))
    ]
    return JointTrajectory(joint_names=list(names), points=points)


def follow(arm, goal: FollowJointTrajectoryGoal):
    return finished(Goal(arm, goal)).result


def finished(goal: Goal) -> Goal:
    assert goal.done.wait(60), "no result"
    return goal


def test_joint_states_come_at_125_hz_of_simulated_time(arm):
    stamps = []

    def keep(state):
        if JOINTS[0] in state.name:
            stamps.append(state.header.stamp.to_sec())

    subscriber = rospy.Subscriber(Topics.JOINT_STATES, JointState, keep, queue_size=500)
    while len(stamps) < 126:
        rospy.sleep(0.1)
    subscriber.unregister()
    assert (stamps[125] - stamps[0]) / 125 == pytest.approx(1 / 125, rel=0.05)


def test_a_trajectory_is_followed_to_its_end(arm):
    target = joints() + [0.2, -0.1, 0.1, 0.1, 0.0, 0.3]
    result = follow(arm, FollowJointTrajectoryGoal(trajectory=trajectory(target, 2.0)))
    assert result.error_code == FollowJointTrajectoryResult.SUCCESSFUL, result.error_string
    assert joints() == pytest.approx(target, abs=0.01)
    state = rospy.wait_for_message(Topics.ARM_STATE, JointTrajectoryControllerState, 10)
    assert state.joint_names == JOINTS
    assert state.desired.positions == pytest.approx(target, abs=1e-6)


def test_joints_may_come_in_any_order_and_without_velocities(arm):
    target = joints() + [-0.2, 0.1, -0.1, -0.1, 0.0, -0.3]
    moved = trajectory(target, 2.0)
    order = [5, 3, 1, 0, 2, 4]
    moved.joint_names = [JOINTS[i] for i in order]
    for point in moved.points:
        point.positions = [point.positions[i] for i in order]
        point.velocities = []
    result = follow(arm, FollowJointTrajectoryGoal(trajectory=moved))
    assert result.error_code == FollowJointTrajectoryResult.SUCCESSFUL, result.error_string
    assert joints() == pytest.approx(target, abs=0.01)


def test_a_path_tolerance_that_cannot_be_kept_aborts_the_goal(arm):
    goal = FollowJointTrajectoryGoal(trajectory=trajectory(joints() + 0.5, 0.05))  # 10 rad/s
    goal.path_tolerance = [JointTolerance(name=name, position=0.02) for name in JOINTS]
    result = follow(arm, goal)
    assert result.error_code == FollowJointTrajectoryResult.PATH_TOLERANCE_VIOLATED


def test_a_goal_tolerance_that_cannot_be_kept_aborts_the_goal(arm):
    moved = trajectory(joints() + [0.5, 0, 0, 0, 0, 0], 0.02)  # 25 rad/s
    goal = FollowJointTrajectoryGoal(trajectory=moved)
    goal.path_tolerance = [JointTolerance(name=name, position=-1.0) for name in JOINTS]
    goal.goal_tolerance = [JointTolerance(name=JOINTS[0], position=0.01)]
    goal.goal_time_tolerance = rospy.Duration(0.02)
    result = follow(arm, goal)
    assert result.error_code == FollowJointTrajectoryResult.GOAL_TOLERANCE_VIOLATED


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda t: t.joint_names.__setitem__(0, "wheel"), "INVALID_JOINTS"),
        (lambda t: t.points.clear(), "INVALID_GOAL"),
        (lambda t: t.points[1].positions.pop(), "INVALID_GOAL"),
        (lambda t: t.points[1].positions.__setitem__(2, float("nan")), "INVALID_GOAL"),
        (lambda t: setattr(t.header, "stamp", rospy.Time(0.5)), "OLD_HEADER_TIMESTAMP"),
    ],
    ids=["unknown joint", "no points", "five positions", "not a number", "in the past"],
)
def test_a_malformed_trajectory_is_refused_with_its_code(arm, change, code):
    moved = trajectory(joints() + 0.1, 0.01)
    change(moved)
    result = follow(arm, FollowJointTrajectoryGoal(trajectory=moved))
    assert result.error_code == getattr(FollowJointTrajectoryResult, code)
    assert result.error_string


def test_a_cancelled_trajectory_stops_the_arm(arm):
    start = joints()
    goal = Goal(arm, FollowJointTrajectoryGoal(trajectory=trajectory(start + 0.5, 60.0)))
    rospy.sleep(2.0)
    goal.cancel()
    finished(goal)
    stopped = joints()
    rospy.sleep(1.0)
    assert joints() == pytest.approx(stopped, abs=0.01)
    assert np.abs(stopped - start).max() < 0.4


def test_the_command_topic_moves_the_arm_too(arm):
    publisher = rospy.Publisher(Topics.ARM_COMMAND, JointTrajectory, queue_size=1)
    while publisher.get_num_connections() == 0:
        rospy.sleep(0.1)
    target = joints() + [0.1, 0.0, 0.0, 0.0, 0.0, -0.1]
    publisher.publish(trajectory(target, 1.0))
    rospy.sleep(2.5)
    assert joints() == pytest.approx(target, abs=0.01)


def test_the_gripper_takes_gaps_in_metres(gripper):
    for gap in (0.030, 0.070):
        goal = GripperCommandGoal()
        goal.command.position, goal.command.max_effort = gap, 40.0
        result = finished(Goal(gripper, goal)).result
        assert result.reached_goal and not result.stalled
        assert result.position == pytest.approx(gap, abs=0.002)


def test_a_gripper_command_that_is_no_number_is_refused(gripper):
    goal = GripperCommandGoal()
    goal.command.position = float("nan")
    assert finished(Goal(gripper, goal)).status == actionlib.GoalStatus.REJECTED


@pytest.mark.parametrize(
    ("topic", "size", "encoding", "frame"),
    [
        (Topics.COLOR_IMAGE, (1280, 800), "rgb8", Topics.COLOR_FRAME),
        (Topics.DEPTH_IMAGE, (1280, 720), "16UC1", Topics.DEPTH_FRAME),
        (Topics.ALIGNED_DEPTH_IMAGE, (1280, 800), "16UC1", Topics.COLOR_FRAME),
    ],
)
def test_images_are_those_of_the_realsense_driver(arm, topic, size, encoding, frame):
    image = rospy.wait_for_message(topic, Image, 30)
    assert (image.width, image.height) == size
    assert image.encoding == encoding
    assert image.header.frame_id == frame
    info_topic = topic.rsplit("/", 1)[0] + "/camera_info"
    info = rospy.wait_for_message(info_topic, CameraInfo, 30)
    assert (info.width, info.height) == size
    assert info.header.frame_id == frame
    if encoding == "16UC1":
        depth = np.frombuffer(image.data, np.uint16)
        assert 590 < np.median(depth[depth > 0]) < 610  # mm: the bare table, 0.6 m away


def test_the_point_cloud_is_coloured_and_in_the_depth_frame(arm):
    cloud = rospy.wait_for_message(Topics.POINTS, PointCloud2, 30)
    assert cloud.header.frame_id == Topics.DEPTH_FRAME
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb"]
    points = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)
    assert np.median(points[:, 2]) == pytest.approx(0.6, abs=0.01)


def test_an_unknown_scene_is_refused_and_the_known_ones_are_named(arm):
    answer = load("no_such_scene", 0)
    assert not answer.success
    assert "five_scattered" in answer.message and "\n" not in answer.message
    assert load("", 0).success


def test_stepping_pauses_the_simulation(arm):
    step = rospy.ServiceProxy(Topics.STEP, Step)
    before = step(1).time
    assert step(480).time == pytest.approx(before + 1.0, abs=1e-6)
    assert step(0).time == pytest.approx(before + 1.0, abs=0.05)


def test_loading_a_scene_never_turns_the_clock_back(arm):
    before = rospy.get_time()
    answer = load("five_scattered", 3)
    assert answer.success and answer.parts == 5
    rospy.sleep(0.5)
    assert rospy.get_time() > before
    verdict = rospy.ServiceProxy(Topics.JUDGE, Judge)().verdict_json
    assert '"parts"' in verdict
    load("", 0)
