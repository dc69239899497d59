"""Trials over the ROS graph: the supervisor's cell behind topics, services and actions."""

from __future__ import annotations

import concurrent.futures
import functools
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import actionlib
import rosgraph
import rospy
import std_srvs.srv

from iwgnet_grasp.msg import (
    FailedGrasps,
    GraspPoses,
    GraspSequence,
    PickPlaceAction,
    PickPlaceGoal,
    PickPlaceResult,
    PushAction,
    PushGoal,
    Scene,
    SceneGrasps,
    Topics,
)
from iwgnet_grasp.perception.merged_depth import crop_window, metres
from iwgnet_grasp.perception.types import GraspRectangle, Look, PerceptionError
from iwgnet_grasp.priority import Ranking
from iwgnet_grasp.ros.action import Goal
from iwgnet_grasp.ros.messages import (
    failed_to_message,
    grasp_from_message,
    image_array,
    object_from_message,
    ranked_from_message,
)
from iwgnet_grasp.srv import (
    Capture,
    CaptureRequest,
    Judge,
    LoadScene,
    LoadSceneRequest,
    Without,
    WithoutRequest,
)
from iwgnet_grasp.supervisor import CellError, Outcome, Target
from iwgnet_grasp.trials.record import Verdict, judged_by

NODES = (
    "/visual_acquisition",
    "/perception",
    "/priority_planner",
    "/spatial_transform",
    "/motion_control",
    "/gripper_control",
)
SIMULATOR = "/simulator"
SCENE_BYTES = 64 * 1024 * 1024  # rospy reads a scene of 11 MB in one piece

_REASONS = {
    getattr(PickPlaceResult, name): name.lower()
    for name in (
        "UNKNOWN_GRASP",
        "INFEASIBLE",
        "UNREACHABLE",
        "NO_PLAN",
        "EXECUTION_FAILED",
        "MISSED",
        "LOST",
    )
}


class RosCell:
    """supervisor.Cell on the graph of launch/grasping.launch, inside a rospy node.

    simulated: a simulator runs whose scenes may be loaded and whose judge may be asked.
    check: raises CellError when the graph is broken; called about twice a second of every wait.
    Limits of waits are wall seconds: simulated time may stand still when something died.
    """

    def __init__(
        self,
        simulated: bool = True,
        check: Callable[[], None] | None = None,
        on_plan: Callable[[Any], None] | None = None,
    ) -> None:
        self._simulated = simulated
        self._check = check or functools.partial(check_nodes, _required(simulated))
        self._check_start = check or (lambda: None)  # nodes register one by one
        self._on_plan = on_plan
        self._changed = threading.Condition()
        self._newest: dict[str, Any] = {}
        self._executor = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="service")
        self._failed = rospy.Publisher(Topics.FAILED_GRASPS, FailedGrasps, queue_size=1, latch=True)
        self._failed_sent: list[GraspRectangle] | None = None
        self._planned = 0, 0  # ids of the look that was planned for last: ours, the nodes'
        self._subscribers = {
            topic: rospy.Subscriber(
                topic,
                kind,
                functools.partial(self._keep, topic),
                queue_size=1,
                buff_size=SCENE_BYTES,
                tcp_nodelay=True,
            )
            for topic, kind in (
                (Topics.GRASPS, SceneGrasps),
                (Topics.SEQUENCE, GraspSequence),
                (Topics.GRASP_POSE, GraspPoses),
            )
            + (((Topics.SCENE, Scene),) if on_plan else ())
        }
        self._pick_place = actionlib.ActionClient(Topics.PICK_PLACE, PickPlaceAction)
        self._push = actionlib.ActionClient(Topics.PUSH, PushAction)

    def wait_until_ready(self, seconds: float = 300.0) -> None:
        """Waits until every node is up and connected. Raises CellError naming what is missing."""
        services = [Topics.CAPTURE, Topics.WITHOUT, Topics.OBSERVE]
        if self._simulated:
            services += [Topics.LOAD_SCENE, Topics.JUDGE]

        def missing() -> str:
            for topic, subscriber in self._subscribers.items():
                if subscriber.get_num_connections() == 0:
                    return f"nobody publishes {topic}"
            if self._failed.get_num_connections() == 0:
                return f"nobody listens to {Topics.FAILED_GRASPS}"
            master = rosgraph.Master(rospy.get_name())
            for service in services:
                try:
                    master.lookupService(service)
                except rosgraph.MasterError:
                    return f"nobody offers {service}"
            for name, client in ((Topics.PICK_PLACE, self._pick_place), (Topics.PUSH, self._push)):
                if not client.wait_for_server(rospy.Duration(0.01)):
                    return f"no action server on {name}"
            if self._simulated and rospy.get_time() == 0.0:
                return "/clock does not tick"
            return ""

        self._wait(lambda: not missing(), seconds, missing, self._check_start)

    def load(self, scene: str, seed: int) -> int:
        """Measures the bare table, then sets up the scene; returns the number of parts."""
        self._load_scene("", seed)
        self.measure_empty_table()
        return self._load_scene(scene, seed)

    def measure_empty_table(self) -> None:
        self._capture(empty_scene=True)

    def _load_scene(self, scene: str, seed: int) -> int:
        request = LoadSceneRequest(scene=scene, seed=seed)
        response = self._call(Topics.LOAD_SCENE, LoadScene, request, 120.0)
        if not response.success:
            raise CellError(response.message)
        return response.parts

    def _capture(self, empty_scene: bool) -> int:
        response = self._call(Topics.CAPTURE, Capture, CaptureRequest(empty_scene), 60.0)
        if not response.success:
            raise CellError(response.message)
        return response.scene_id

    # supervisor.Cell

    def look(self) -> int:
        return self._capture(empty_scene=False)

    def plan(
        self, scene_id: int, failed: Sequence[GraspRectangle], taken: Sequence[int] = ()
    ) -> list[Target]:
        failed = list(failed)
        if failed != self._failed_sent:
            self._failed.publish(failed_to_message(failed, rospy.Header(stamp=rospy.Time.now())))
            self._failed_sent = failed
        if taken:
            request = WithoutRequest(scene_id=scene_id, taken=list(taken))
            response = self._call(Topics.WITHOUT, Without, request, 60.0)
            if not response.success:
                raise CellError(response.message)
        # The nodes know the scene that was thought up by an id of its own.
        self._planned = scene_id, response.scene_id if taken else scene_id

        def of_scene(topic: str) -> Any:
            message = self._newest.get(topic)
            known = message is not None and message.scene_id == self._planned[1]
            return message if known else None

        def complete() -> bool:
            grasps = of_scene(Topics.GRASPS)
            if grasps is not None and grasps.error:
                raise CellError(grasps.error)
            answers = [of_scene(Topics.SEQUENCE), of_scene(Topics.GRASP_POSE)]
            return grasps is not None and all(
                answer is not None and answer.failed_grasps == len(failed) for answer in answers
            )

        def missing() -> str:
            topics = (Topics.GRASPS, Topics.SEQUENCE, Topics.GRASP_POSE)
            late = next((t for t in topics if of_scene(t) is None), Topics.GRASP_POSE)
            return f"nothing for scene {scene_id} on {late}; see the log of its node"

        self._wait(complete, 60.0, missing)
        grasps = of_scene(Topics.GRASPS)
        sequence = of_scene(Topics.SEQUENCE)
        poses = {pose.object_id: pose for pose in of_scene(Topics.GRASP_POSE).grasps}
        ranking = Ranking(
            tuple(ranked_from_message(o) for o in sequence.objects),
            tuple((object_from_message(o.object), o.reason) for o in sequence.left_out),
        )
        targets = []
        for ranked in ranking.objects:
            pose = poses.get(ranked.object.object_id)
            if pose is None:
                raise CellError(
                    f"{Topics.GRASP_POSE} lacks object {ranked.object.object_id} "
                    f"of scene {scene_id}"
                )
            targets.append(
                Target(
                    scene_id,
                    ranked.object.object_id,
                    ranked.object.label,
                    ranked.object.score,
                    ranked.priority,
                    grasp_from_message(pose.grasp),
                    pose.feasible,
                    pose.reason or ranked.reason,
                    pose.quality,
                    ranked.object.covered_px,
                )
            )
        targets += [
            Target(scene_id, o.object_id, o.label, o.score, 0.0, None, False, reason)
            for o, reason in ranking.dropped
        ]
        if self._on_plan is not None and not taken:
            self._wait(lambda: of_scene(Topics.SCENE) is not None, 10.0, lambda: "no scene image")
            self._on_plan(self._plan_for_pictures(of_scene(Topics.SCENE), grasps, ranking, targets))
        return targets

    def _plan_for_pictures(self, scene, grasps, ranking, targets):
        from iwgnet_grasp.trials.in_process import Plan

        try:
            color = image_array(scene.color, Topics.SCENE)
            depth = metres(image_array(scene.depth, Topics.SCENE))
            empty = metres(image_array(scene.empty_depth, Topics.SCENE))
            objects = tuple(object_from_message(o) for o in grasps.objects)
            windows = tuple(crop_window(depth, empty, o.box, grasps.window_px) for o in objects)
        except PerceptionError as error:
            raise CellError(str(error)) from None
        look = Look(color, depth, empty, objects, windows)
        return Plan(scene.scene_id, look, ranking, targets)

    def execute(self, target: Target, tray_slot: int) -> Outcome:
        seen, planned = self._planned
        scene_id = planned if target.scene_id == seen else target.scene_id
        goal = PickPlaceGoal(scene_id=scene_id, object_id=target.object_id, tray_slot=tray_slot)
        result = self._move(self._pick_place, Topics.PICK_PLACE, goal)
        reason = "" if result.success else _REASONS.get(result.reason, str(result.reason))
        return Outcome(result.success, reason, result.message)

    def push(self, scene_id: int) -> Outcome:
        result = self._move(self._push, Topics.PUSH, PushGoal(scene_id=scene_id))
        failed = "execution_failed" if result.moved else "unreachable"
        return Outcome(result.success, "" if result.success else failed, result.message)

    def _move(self, client: Any, name: str, goal: Any) -> Any:
        """The result of a motion, the arm being back at its observing pose."""
        handle = Goal(client, goal, self._notify)
        try:
            self._wait(handle.done.is_set, 600.0, lambda: f"no result from {name}")
        except BaseException:  # ctrl-C too: the arm must not go on by itself
            handle.cancel()
            raise
        if handle.result is None:
            raise CellError(f"{name} ended without a result; see motion_control's log")
        back = self._call(Topics.OBSERVE, std_srvs.srv.Trigger, None, 180.0)
        if not back.success:
            raise CellError(f"the arm cannot return to its observing pose: {back.message}")
        return handle.result

    def time(self) -> float:
        return rospy.get_time()

    def judge(self) -> Verdict:
        """The judge's verdict with its times on this cell's clock."""
        response = self._call(Topics.JUDGE, Judge, None, 30.0)
        verdict = judged_by(lambda: response.verdict_json)()
        for pick in verdict.get("picks", []):
            for key in ("grip_time", "release_time"):
                pick[key] += response.clock_offset
        return verdict

    # waiting

    def _keep(self, topic: str, message: Any) -> None:
        self._newest[topic] = message
        self._notify()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _wait(
        self,
        done: Callable[[], bool],
        seconds: float,
        missing: Callable[[], str],
        check: Callable[[], None] | None = None,
    ) -> None:
        """Until done() is true. Raises CellError after `seconds` or when the graph breaks."""
        check = check or self._check
        end = time.monotonic() + seconds
        next_check = time.monotonic() + 0.5
        while not done():
            now = time.monotonic()
            if rospy.is_shutdown():
                raise CellError("ROS is shutting down")
            if now > end:
                raise CellError(f"{missing()} after {seconds:.0f} s")
            if now > next_check:
                check()
                next_check = time.monotonic() + 0.5
            with self._changed:
                self._changed.wait(0.02)

    def _call(self, name: str, kind: Any, request: Any, seconds: float) -> Any:
        """A service's response. Raises CellError when it fails or does not come."""
        arguments = () if request is None else (request,)
        future = self._executor.submit(rospy.ServiceProxy(name, kind), *arguments)
        future.add_done_callback(lambda _: self._notify())
        self._wait(future.done, seconds, lambda: f"no answer from {name}")
        try:
            return future.result()
        except (rospy.ServiceException, rospy.ROSException, OSError) as error:
            self._check()  # a dead node is the better explanation
            raise CellError(f"{name} failed: {error}") from None


def _required(simulated: bool) -> tuple[str, ...]:
    return NODES + ((SIMULATOR,) if simulated else ())


def check_nodes(names: Sequence[str], timeout: float = 3.0) -> None:
    """Raises CellError naming the first of these nodes that is gone, or the master if that is."""
    master = rosgraph.Master(rospy.get_name())
    for name in names:
        try:
            uri = master.lookupNode(name)
        except rosgraph.MasterError:
            raise CellError(f"node {name} is not running; see its log") from None
        except OSError:
            raise CellError(
                f"the ROS master at {rosgraph.get_master_uri()} does not answer any more"
            ) from None
        host, port = rosgraph.network.parse_http_host_and_port(uri)
        try:
            # A connection is enough: the kernel refuses it once the process is gone.
            socket.create_connection((host, port), timeout).close()
        except OSError:
            raise CellError(f"node {name} died; see its log") from None
