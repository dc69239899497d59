// ROS messages <-> values of the core.
#pragma once

#include <control_msgs/FollowJointTrajectoryGoal.h>
#include <geometry_msgs/Point.h>
#include <geometry_msgs/Pose.h>
#include <geometry_msgs/Transform.h>
#include <iwgnet_grasp/GraspPose.h>
#include <iwgnet_grasp/GraspRectangle.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/JointState.h>
#include <trajectory_msgs/JointTrajectory.h>

#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/grasping/grasp_pose.h"
#include "iwgnet_grasp/motion/trajectory.h"

namespace iwgnet_grasp::nodes {

geometry_msgs::Point to_message(const Eigen::Vector3d& p);
geometry_msgs::Pose to_message(const Pose& T);
geometry_msgs::Transform to_transform_message(const Pose& T);
Pose from_message(const geometry_msgs::Pose& pose);
Eigen::Vector3d from_message(const geometry_msgs::Point& point);

// Undistorted camera of these intrinsics.
sensor_msgs::CameraInfo to_message(const PinholeIntrinsics& camera, const std_msgs::Header& header);
// Throws Error when the focal length or the size is not positive. Distortion is left out.
PinholeIntrinsics from_message(const sensor_msgs::CameraInfo& info);

grasping::GraspRectangle from_message(const GraspRectangle& grasp);
// Without object_id, grasp and centroid.
GraspPose to_message(const grasping::GraspPose& pose);
grasping::GraspPose from_message(const GraspPose& message);

// A trajectory for the arm's controller, to be started at once.
trajectory_msgs::JointTrajectory to_message(const motion::Trajectory& trajectory);
// Joints in any order, velocities and accelerations optional. `start`: state the arm has when the
// trajectory begins, put before a first point that lies later; `now` and a stamp in the header
// shift the times. Throws Error, with what() fit for error_string, when joints or sizes are wrong.
struct JointsError : Error {
  using Error::Error;
};
motion::Trajectory from_message(const trajectory_msgs::JointTrajectory& message,
                                const JointVector& start, const ros::Time& now);

// The arm's joints of a joint state, by name; nullopt when one is missing (a gripper's message).
std::optional<JointVector> arm_joints(const sensor_msgs::JointState& state);

// 32FC1 depth of a message of the project's own nodes, sharing no memory. Throws Error.
cv::Mat depth_image(const sensor_msgs::Image& image, const std::string& topic);

}  // namespace iwgnet_grasp::nodes
