#!/usr/bin/env python3
"""Node 2: objects and their grasps (topic 2) for each scene (topic 1)."""

import sys

import rospy
from iwgnet_grasp.msg import Scene, SceneGrasps, Topics

from iwgnet_grasp.perception import PerceptionError, load_perception
from iwgnet_grasp.perception.pipeline import DEFAULT_CONFIG
from iwgnet_grasp.ros.messages import image_array, object_to_message

SCENE_BYTES = 64 * 1024 * 1024  # a scene at 1280x800 px has 11 MB; rospy reads it in one piece


class PerceptionNode:
    def __init__(self) -> None:
        self.perception = load_perception(
            rospy.get_param("~config", str(DEFAULT_CONFIG)), rospy.get_param("~backend", "")
        )
        rospy.set_param("~backends", self.perception.backends)  # for the record of a trial
        self.grasps = rospy.Publisher(Topics.GRASPS, SceneGrasps, queue_size=1, latch=True)
        rospy.Subscriber(
            Topics.SCENE,
            Scene,
            self.on_scene,
            queue_size=1,
            buff_size=SCENE_BYTES,
            tcp_nodelay=True,
        )

    def on_scene(self, scene: Scene) -> None:
        result = SceneGrasps(
            header=scene.header, scene_id=scene.scene_id, camera_info=scene.camera_info
        )
        try:
            look = self.perception.look(
                image_array(scene.color, f"{Topics.SCENE} color"),
                image_array(scene.depth, f"{Topics.SCENE} depth"),
                image_array(scene.empty_depth, f"{Topics.SCENE} empty_depth"),
            )
            result.objects = [object_to_message(o) for o in look.objects]
            result.window_px = self.perception.estimator.input_px
            rospy.loginfo(
                f"scene {scene.scene_id}: {len(look.objects)} objects in "
                f"{look.seconds['total'] * 1e3:.0f} ms"
            )
        except PerceptionError as error:
            result.error = str(error)
            rospy.logerr(f"scene {scene.scene_id}: {error}")
        self.grasps.publish(result)


def main() -> int:
    rospy.init_node("perception")
    try:
        PerceptionNode()
    except Exception as error:  # whatever is wrong with weights or config: one line, no traceback
        rospy.logfatal(" ".join(f"cannot start: {error}".split()))
        return 1
    rospy.spin()
    return 0


if __name__ == "__main__":
    sys.exit(main())
