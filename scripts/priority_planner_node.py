#!/usr/bin/env python3
"""Orders the objects of a scene by Eq. 17-21, leaving out the grasps that have failed."""

import sys
import threading

import rospy
from iwgnet_grasp.msg import FailedGrasps, GraspSequence, SceneGrasps, Topics

from iwgnet_grasp.perception import PerceptionError
from iwgnet_grasp.priority import DEFAULT_CONFIG, PriorityConfig, RankedObject, rank
from iwgnet_grasp.ros.messages import (
    camera_intrinsics,
    grasp_from_message,
    object_from_message,
    ranked_to_message,
)

NAN = float("nan")


class PriorityPlanner:
    def __init__(self) -> None:
        self.config = PriorityConfig.load(rospy.get_param("~config", str(DEFAULT_CONFIG)))
        self.lock = threading.Lock()
        self.failed: list = []
        self.grasps: SceneGrasps | None = None
        self.sequence = rospy.Publisher(Topics.SEQUENCE, GraspSequence, queue_size=1, latch=True)
        rospy.Subscriber(
            Topics.FAILED_GRASPS, FailedGrasps, self.on_failed, queue_size=1, tcp_nodelay=True
        )
        rospy.Subscriber(Topics.GRASPS, SceneGrasps, self.on_grasps, queue_size=1, tcp_nodelay=True)

    def on_failed(self, message: FailedGrasps) -> None:
        with self.lock:
            self.failed = [grasp_from_message(g) for g in message.grasps]
            self.publish()

    def on_grasps(self, message: SceneGrasps) -> None:
        with self.lock:
            self.grasps = message
            self.publish()

    def publish(self) -> None:
        grasps = self.grasps
        if grasps is None or grasps.error:
            return
        try:
            ranking = rank(
                [object_from_message(o) for o in grasps.objects],
                camera_intrinsics(grasps.camera_info),
                self.config,
                self.failed,
                (grasps.scene_id,),
            )
        except PerceptionError as error:
            rospy.logerr(f"scene {grasps.scene_id}: {error}")
            return
        left_out = [RankedObject(o, NAN, NAN, NAN, 0.0, reason) for o, reason in ranking.dropped]
        self.sequence.publish(
            GraspSequence(
                header=grasps.header,
                scene_id=grasps.scene_id,
                failed_grasps=len(self.failed),
                camera_info=grasps.camera_info,
                objects=[ranked_to_message(o) for o in ranking.objects],
                left_out=[ranked_to_message(o) for o in left_out],
            )
        )


def main() -> int:
    rospy.init_node("priority_planner")
    try:
        PriorityPlanner()
    except PerceptionError as error:
        rospy.logfatal(f"cannot start: {error}")
        return 1
    rospy.spin()
    return 0


if __name__ == "__main__":
    sys.exit(main())
