#!/usr/bin/env python3
"""Node 2: objects and their grasps (topic 2) for each scene (topic 1).

On /perception/without it thinks objects of its newest look away: the scene without them travels the
same way as a look, so that the other nodes plan for it as for any other.
"""

import sys
import threading

import rospy
from iwgnet_grasp.msg import Scene, SceneGrasps, Topics
from iwgnet_grasp.srv import Without, WithoutResponse

from iwgnet_grasp.perception import PerceptionError, load_perception
from iwgnet_grasp.perception.pipeline import DEFAULT_CONFIG
from iwgnet_grasp.perception.types import Look
from iwgnet_grasp.ros.messages import depth_to_message, image_array, object_to_message

THOUGHT_UP = 1 << 24  # the scenes of a look have its id and a multiple of this
SCENE_BYTES = 64 * 1024 * 1024  # a scene at 1280x800 px has 11 MB; rospy reads it in one piece


class PerceptionNode:
    def __init__(self) -> None:
        self.perception = load_perception(
            rospy.get_param("~config", str(DEFAULT_CONFIG)), rospy.get_param("~backend", "")
        )
        rospy.set_param("~backends", self.perception.backends)  # for the record of a trial
        self.lock = threading.Lock()
        self.seen: tuple[Scene, Look] | None = None
        self.thought_up = 0  # scenes, of the newest look
        self.scenes = rospy.Publisher(Topics.SCENE, Scene, queue_size=1)
        self.grasps = rospy.Publisher(Topics.GRASPS, SceneGrasps, queue_size=1, latch=True)
        rospy.Subscriber(
            Topics.SCENE,
            Scene,
            self.on_scene,
            queue_size=1,
            buff_size=SCENE_BYTES,
            tcp_nodelay=True,
        )
        rospy.Service(Topics.WITHOUT, Without, self.on_without)

    def on_scene(self, scene: Scene) -> None:
        if scene.seen_in:
            return  # our own
        with self.lock:
            self.seen, self.thought_up = None, 0
            try:
                look = self.perception.look(
                    image_array(scene.color, f"{Topics.SCENE} color"),
                    image_array(scene.depth, f"{Topics.SCENE} depth"),
                    image_array(scene.empty_depth, f"{Topics.SCENE} empty_depth"),
                )
            except PerceptionError as error:
                rospy.logerr(f"scene {scene.scene_id}: {error}")
                self.publish(scene, error=str(error))
                return
            self.seen = scene, look
            self.publish(scene, look)
            rospy.loginfo(
                f"scene {scene.scene_id}: {len(look.objects)} objects in "
                f"{look.seconds['total'] * 1e3:.0f} ms"
            )

    def on_without(self, request) -> WithoutResponse:
        with self.lock:
            if self.seen is None or self.seen[0].scene_id != request.scene_id:
                return WithoutResponse(
                    False, 0, f"scene {request.scene_id} is not the newest that was seen"
                )
            seen, look = self.seen
            known = [o.object_id for o in look.objects]
            unknown = sorted(set(request.taken) - set(known))
            if unknown:
                return WithoutResponse(
                    False, 0, f"scene {seen.scene_id} has no object {unknown[0]}, only {known}"
                )
            self.thought_up += 1
            left = self.perception.without(look, request.taken)
            scene = Scene(
                header=seen.header,
                scene_id=seen.scene_id + self.thought_up * THOUGHT_UP,
                camera_info=seen.camera_info,
                color=seen.color,
                depth=depth_to_message(left.depth, seen.depth.header),
                empty_depth=seen.empty_depth,
                seen_in=seen.scene_id,
            )
            self.scenes.publish(scene)
            self.publish(scene, left)
            return WithoutResponse(True, scene.scene_id, "")

    def publish(self, scene: Scene, look: Look | None = None, error: str = "") -> None:
        self.grasps.publish(
            SceneGrasps(
                header=scene.header,
                scene_id=scene.scene_id,
                camera_info=scene.camera_info,
                objects=[object_to_message(o) for o in look.objects] if look else [],
                window_px=self.perception.estimator.input_px,
                error=error,
            )
        )


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
