// T_base_camera from tf.
#pragma once

#include <tf2_ros/buffer.h>

#include <string>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::nodes {

// Newest transform optical frame -> base_link; waits up to 5 wall seconds for the first. Throws Error.
Pose camera_transform(const tf2_ros::Buffer& buffer, const std::string& optical_frame);

}  // namespace iwgnet_grasp::nodes
