"""From one look to a part in the tray, over the numbered topics. Stands in for perception alone:
topic 2 is made here from the depth of topic 1."""

from __future__ import annotations

import json
import threading

import actionlib
import numpy as np
import pytest
import rospy
from iwgnet_grasp.msg import (
    FailedGrasps,
    GraspPoses,
    GraspRectangle,
    GraspSequence,
    GripAction,
    GripGoal,
    GripperWidths,
    ObjectGrasps,
    PickPlaceAction,
    PickPlaceGoal,
    PickPlaceResult,
    PushAction,
    PushGoal,
    PushResult,
    Scene,
    SceneGrasps,
    Topics,
)
from iwgnet_grasp.srv import Capture, Judge, LoadScene
from scipy import ndimage
from std_srvs.srv import Trigger

from iwgnet_grasp.ros.action import Goal
from iwgnet_grasp.ros.messages import image_array


class Newest:
    """The newest message of a topic, and a wait for one that fits."""

    def __init__(self, topic, kind):
        self.topic, self.message, self.changed = topic, None, threading.Condition()
        rospy.Subscriber(topic, kind, self.keep, queue_size=1, buff_size=2**26)

    def keep(self, message):
        with self.changed:
            self.message = message
            self.changed.notify_all()

    def wait(self, fits, seconds=30.0):
        with self.changed:
            good = self.changed.wait_for(
                lambda: self.message is not None and fits(self.message), seconds
            )
        assert good, f"nothing that fits on {self.topic}"
        return self.message


class Graph:
    def __init__(self):
        self.scene = Newest(Topics.SCENE, Scene)
        self.sequence = Newest(Topics.SEQUENCE, GraspSequence)
        self.poses = Newest(Topics.GRASP_POSE, GraspPoses)
        self.widths = Newest(Topics.GRIPPER_WIDTH, GripperWidths)
        self.grasps = rospy.Publisher(Topics.GRASPS, SceneGrasps, queue_size=1, latch=True)
        self.failed = rospy.Publisher(Topics.FAILED_GRASPS, FailedGrasps, queue_size=1, latch=True)
        self.pick_place = actionlib.ActionClient(Topics.PICK_PLACE, PickPlaceAction)
        self.pushing = actionlib.ActionClient(Topics.PUSH, PushAction)
        assert self.pick_place.wait_for_server(rospy.Duration(60))
        assert self.pushing.wait_for_server(rospy.Duration(60))
        for service in (Topics.CAPTURE, Topics.LOAD_SCENE, Topics.OBSERVE):
            rospy.wait_for_service(service, 60)
        self.capture = rospy.ServiceProxy(Topics.CAPTURE, Capture)
        self.load_scene = rospy.ServiceProxy(Topics.LOAD_SCENE, LoadScene)
        self.observe = rospy.ServiceProxy(Topics.OBSERVE, Trigger)

    def look(self, scene="five_scattered", seed=0) -> Scene:
        assert self.load_scene("", seed).success
        assert self.capture(empty_scene=True).success
        assert self.load_scene(scene, seed).success
        answer = self.capture(empty_scene=False)
        assert answer.success, answer.message
        return self.scene.wait(lambda m: m.scene_id == answer.scene_id)

    def pick(self, scene_id, object_id, slot=0) -> PickPlaceResult:
        goal = Goal(self.pick_place, PickPlaceGoal(scene_id, object_id, slot))
        assert goal.done.wait(60), "no result"
        return goal.result

    def push(self, scene_id) -> PushResult:
        goal = Goal(self.pushing, PushGoal(scene_id))
        assert goal.done.wait(60), "no result"
        return goal.result


@pytest.fixture(scope="module")
def nodes(graph):
    return Graph()


def objects_by_depth(scene: Scene) -> SceneGrasps:
    """Each blob above the table with a grasp across its longest axis at its centroid."""
    depth = image_array(scene.depth, "depth")
    empty = image_array(scene.empty_depth, "empty depth")
    with np.errstate(invalid="ignore"):
        above = empty - depth > 0.005
    solid = ndimage.binary_opening(ndimage.binary_closing(above, iterations=3), iterations=2)
    labels, _ = ndimage.label(solid)
    message = SceneGrasps(
        header=scene.header, scene_id=scene.scene_id, camera_info=scene.camera_info
    )
    for index, (rows, columns) in enumerate(ndimage.find_objects(labels)):
        v, u = np.nonzero((labels == index + 1) & above)
        if len(u) < 500:
            continue
        axis = np.linalg.eigh(np.cov(np.stack([u, v])))[1][:, 0]  # the shortest
        blob = ObjectGrasps(object_id=index, label="connecting_rod", score=0.9, valid_pixels=len(u))
        blob.box.x_offset, blob.box.y_offset = columns.start, rows.start
        blob.box.width, blob.box.height = columns.stop - columns.start, rows.stop - rows.start
        blob.centroid_u_px, blob.centroid_v_px = u.mean(), v.mean()
        blob.centroid_depth_m = float(np.median(depth[v, u]))
        near = np.hypot(u - u.mean(), v - v.mean()) < 6
        if not near.any():
            continue
        blob.grasps = [
            GraspRectangle(
                x_px=u.mean(),
                y_px=v.mean(),
                theta_rad=np.arctan(-axis[1] / axis[0]) if axis[0] else np.pi / 2,
                width_px=26.0,
                quality=0.8,
                depth_m=float(np.median(depth[v[near], u[near]])),
            )
        ]
        message.objects.append(blob)
    return message


def test_a_look_travels_through_the_numbered_topics_under_one_scene_id(nodes):
    scene = nodes.look()
    assert scene.header.frame_id == Topics.COLOR_FRAME
    assert (scene.color.encoding, scene.depth.encoding) == ("rgb8", "32FC1")
    assert scene.empty_depth.encoding == "32FC1"
    assert (scene.depth.width, scene.depth.height) == (scene.color.width, scene.color.height)
    depth = image_array(scene.depth, "depth")
    assert np.isfinite(depth).mean() > 0.5 and 0.5 < np.nanmedian(depth) < 0.62  # m

    grasps = objects_by_depth(scene)
    assert len(grasps.objects) == 5
    nodes.grasps.publish(grasps)
    sequence = nodes.sequence.wait(lambda m: m.scene_id == scene.scene_id)
    priorities = [o.priority for o in sequence.objects]
    assert len(priorities) == 5 and priorities == sorted(priorities, reverse=True)
    poses = nodes.poses.wait(lambda m: m.scene_id == scene.scene_id)
    widths = nodes.widths.wait(lambda m: m.scene_id == scene.scene_id)
    assert poses.header.frame_id == Topics.BASE_FRAME
    order = [o.object.object_id for o in sequence.objects]
    assert [g.object_id for g in poses.grasps] == order
    assert [w.object_id for w in widths.widths] == order
    for pose, width in zip(poses.grasps, widths.widths, strict=True):
        assert 0.3 < pose.pose.position.x < 0.7 and -0.25 < pose.pose.position.y < 0.25
        assert 0.0 < pose.pose.position.z < 0.06
        assert (width.opening, width.width) == (pose.opening, pose.width)


def test_a_ranked_grasp_is_picked_into_the_tray(nodes):
    scene = nodes.look()
    nodes.grasps.publish(objects_by_depth(scene))
    poses = nodes.poses.wait(lambda m: m.scene_id == scene.scene_id)
    nodes.widths.wait(lambda m: m.scene_id == scene.scene_id)
    target = next(g for g in poses.grasps if g.feasible)
    result = nodes.pick(scene.scene_id, target.object_id)
    assert result.success, result.message
    verdict = json.loads(rospy.ServiceProxy(Topics.JUDGE, Judge)().verdict_json)
    assert verdict["in_tray"] == 1
    assert [p["success"] for p in verdict["picks"]] == [True]
    assert nodes.observe().success


def test_a_failed_grasp_is_left_out_when_the_scene_is_ranked_again(nodes):
    scene = nodes.look()
    grasps = objects_by_depth(scene)
    nodes.grasps.publish(grasps)
    nodes.sequence.wait(lambda m: m.scene_id == scene.scene_id and m.failed_grasps == 0)
    failed = grasps.objects[0]
    nodes.failed.publish(FailedGrasps(grasps=failed.grasps))
    sequence = nodes.sequence.wait(lambda m: m.scene_id == scene.scene_id and m.failed_grasps == 1)
    assert failed.object_id not in [o.object.object_id for o in sequence.objects]
    assert [o.object.object_id for o in sequence.left_out] == [failed.object_id]
    assert sequence.left_out[0].reason
    nodes.failed.publish(FailedGrasps())
    nodes.poses.wait(lambda m: m.scene_id == scene.scene_id and m.failed_grasps == 0)


def test_a_goal_of_another_scene_is_refused(nodes):
    result = nodes.pick(scene_id=10_000, object_id=0)
    assert (result.success, result.reason) == (False, PickPlaceResult.UNKNOWN_GRASP)
    assert "10000" in result.message


def test_an_object_is_pushed_aside_and_not_gripped(nodes):
    refused = nodes.push(scene_id=10_000)
    assert not refused.success and "10000" in refused.message
    before = nodes.look()
    nodes.grasps.publish(objects_by_depth(before))
    nodes.poses.wait(lambda m: m.scene_id == before.scene_id)
    result = nodes.push(before.scene_id)
    assert result.success, result.message
    verdict = json.loads(rospy.ServiceProxy(Topics.JUDGE, Judge)().verdict_json)
    assert verdict["picks"] == [] and verdict["collisions"] == [] and verdict["on_table"] == 5
    answer = nodes.capture(empty_scene=False)
    after = nodes.scene.wait(lambda m: m.scene_id == answer.scene_id)
    depths = [image_array(m.depth, "depth") for m in (before, after)]
    with np.errstate(invalid="ignore"):
        moved = np.abs(depths[0] - depths[1]) > 0.01
    assert np.count_nonzero(moved) > 1500  # where a rod lay, and where it lies now
    nodes.failed.publish(FailedGrasps())


def test_unreachable_and_infeasible_grasps_are_refused_and_the_node_goes_on(nodes):
    scene = nodes.look()
    grasps = objects_by_depth(scene)
    rod = grasps.objects[0].grasps[0]
    rod.width_px = 400.0  # 375 mm at the table: no gripper opens that far
    rod.depth_m = float("nan")
    nodes.grasps.publish(grasps)
    poses = nodes.poses.wait(lambda m: m.scene_id == scene.scene_id)
    bad = next(g for g in poses.grasps if g.object_id == grasps.objects[0].object_id)
    assert not bad.feasible and bad.reason
    result = nodes.pick(scene.scene_id, bad.object_id)
    assert result.reason == PickPlaceResult.INFEASIBLE and bad.reason in result.message

    publisher = rospy.Publisher(Topics.GRASP_POSE, GraspPoses, queue_size=1)
    while publisher.get_num_connections() < 2:  # motion_control's, and this test's own
        rospy.sleep(0.05)
    far = next(g for g in poses.grasps if g.feasible)
    far.pose.position.x = 1.6  # the UR5 reaches 0.85 m
    poses.grasps = [far]
    publisher.publish(poses)
    rospy.sleep(0.5)
    result = nodes.pick(scene.scene_id, far.object_id)
    assert result.reason == PickPlaceResult.UNREACHABLE
    assert result.message and "\n" not in result.message
    publisher.unregister()
    assert nodes.observe().success


def test_the_gripper_refuses_objects_and_gaps_it_does_not_know(nodes):
    client = actionlib.ActionClient(Topics.GRIP, GripAction)
    assert client.wait_for_server(rospy.Duration(30))
    for goal in (
        GripGoal(command=GripGoal.CLOSE, scene_id=10_000, object_id=1),
        GripGoal(command=GripGoal.RELEASE, gap=0.5),
        GripGoal(command=17),
    ):
        refused = Goal(client, goal)
        assert refused.done.wait(20)
        assert refused.status == actionlib.GoalStatus.ABORTED
        assert refused.result.message
    opened = Goal(client, GripGoal(command=GripGoal.RELEASE, gap=0.05))
    assert opened.done.wait(20)
    assert opened.result.gap == pytest.approx(0.05, abs=0.002)
    assert not opened.result.holding
