#include "conversions.h"

#include <cv_bridge/cv_bridge.h>
#include <sensor_msgs/distortion_models.h>
#include <sensor_msgs/image_encodings.h>

#include <algorithm>

#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::nodes {

geometry_msgs::Point to_message(const Eigen::Vector3d& p) {
  geometry_msgs::Point point;
  point.x = p.x(), point.y = p.y(), point.z = p.z();
  return point;
}

geometry_msgs::Transform to_transform_message(const Pose& T) {
  geometry_msgs::Transform transform;
  const Eigen::Quaterniond q(T.linear());
  transform.translation.x = T.translation().x();
  transform.translation.y = T.translation().y();
  transform.translation.z = T.translation().z();
  transform.rotation.x = q.x(), transform.rotation.y = q.y();
  transform.rotation.z = q.z(), transform.rotation.w = q.w();
  return transform;
}

geometry_msgs::Pose to_message(const Pose& T) {
  geometry_msgs::Pose pose;
  pose.position = to_message(Eigen::Vector3d(T.translation()));
  pose.orientation = to_transform_message(T).rotation;
  return pose;
}

Eigen::Vector3d from_message(const geometry_msgs::Point& point) {
  return {point.x, point.y, point.z};
}

Pose from_message(const geometry_msgs::Pose& pose) {
  Pose T = Pose::Identity();
  T.linear() = Eigen::Quaterniond(pose.orientation.w, pose.orientation.x, pose.orientation.y,
                                  pose.orientation.z)
                   .normalized()
                   .toRotationMatrix();
  T.translation() = from_message(pose.position);
  return T;
}

sensor_msgs::CameraInfo to_message(const PinholeIntrinsics& camera,
                                   const std_msgs::Header& header) {
  sensor_msgs::CameraInfo info;
  info.header = header;
  info.width = camera.width;
  info.height = camera.height;
  info.distortion_model = sensor_msgs::distortion_models::PLUMB_BOB;
  info.D.assign(5, 0.0);
  info.K = {camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1};
  info.R = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.P = {camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0};
  return info;
}

PinholeIntrinsics from_message(const sensor_msgs::CameraInfo& info) {
  PinholeIntrinsics camera;
  camera.width = info.width;
  camera.height = info.height;
  camera.fx = info.K[0], camera.cx = info.K[2];
  camera.fy = info.K[4], camera.cy = info.K[5];
  if (camera.width <= 0 || camera.height <= 0 || !(camera.fx > 0) || !(camera.fy > 0))
    throw Error("camera info has no positive size and focal length: is the camera calibrated?");
  return camera;
}

grasping::GraspRectangle from_message(const GraspRectangle& grasp) {
  return {grasp.x_px, grasp.y_px, grasp.theta_rad, grasp.width_px, grasp.quality, grasp.depth_m};
}

GraspPose to_message(const grasping::GraspPose& pose) {
  GraspPose message;
  message.pose = to_message(pose.T_base_tcp);
  message.width = pose.width;
  message.opening = pose.opening;
  message.tip_height = pose.tip_height;
  message.engagement = pose.engagement;
  message.quality = static_cast<float>(pose.quality);
  message.feasible = pose.feasible;
  message.reason = pose.reason;
  return message;
}

grasping::GraspPose from_message(const GraspPose& message) {
  grasping::GraspPose pose;
  pose.T_base_tcp = from_message(message.pose);
  pose.width = message.width;
  pose.opening = message.opening;
  pose.tip_height = message.tip_height;
  pose.engagement = message.engagement;
  pose.quality = message.quality;
  pose.feasible = message.feasible;
  pose.reason = message.reason;
  return pose;
}

trajectory_msgs::JointTrajectory to_message(const motion::Trajectory& trajectory) {
  trajectory_msgs::JointTrajectory message;
  message.joint_names.assign(std::begin(kJointNames), std::end(kJointNames));
  for (const motion::TrajectoryPoint& point : trajectory) {
    trajectory_msgs::JointTrajectoryPoint out;
    out.positions.assign(point.q.data(), point.q.data() + kJoints);
    out.velocities.assign(point.qd.data(), point.qd.data() + kJoints);
    out.accelerations.assign(point.qdd.data(), point.qdd.data() + kJoints);
    out.time_from_start.fromSec(point.time);
    message.points.push_back(std::move(out));
  }
  return message;
}

namespace {

// Index of each of our joints in `names`; -1 where missing.
std::array<int, kJoints> joint_indices(const std::vector<std::string>& names) {
  std::array<int, kJoints> indices;
  for (int j = 0; j < kJoints; ++j) {
    const auto found = std::find(names.begin(), names.end(), kJointNames[j]);
    indices[j] = found == names.end() ? -1 : static_cast<int>(found - names.begin());
  }
  return indices;
}

JointVector pick(const std::vector<double>& values, const std::array<int, kJoints>& indices) {
  JointVector result;
  for (int j = 0; j < kJoints; ++j) result[j] = values[indices[j]];
  return result;
}

}  // namespace

motion::Trajectory from_message(const trajectory_msgs::JointTrajectory& message,
                                const JointVector& start, const ros::Time& now) {
  const auto indices = joint_indices(message.joint_names);
  if (message.joint_names.size() != kJoints ||
      std::find(indices.begin(), indices.end(), -1) != indices.end())
    throw JointsError("the trajectory must name the six joints of the arm, shoulder_pan_joint to "
                      "wrist_3_joint, once each");
  const double delay = message.header.stamp.isZero() ? 0.0 : (message.header.stamp - now).toSec();

  motion::Trajectory trajectory;
  bool velocities = true;
  for (std::size_t i = 0; i < message.points.size(); ++i) {
    const auto& in = message.points[i];
    const auto wrong = [](const std::vector<double>& values, bool optional) {
      return values.size() != kJoints && !(optional && values.empty());
    };
    if (wrong(in.positions, false) || wrong(in.velocities, true) || wrong(in.accelerations, true))
      throw Error("point " + std::to_string(i) + " does not hold six values a field");
    motion::TrajectoryPoint point;
    point.time = in.time_from_start.toSec() + delay;
    point.q = pick(in.positions, indices);
    velocities = velocities && !in.velocities.empty();
    point.qd = in.velocities.empty() ? JointVector::Zero() : pick(in.velocities, indices);
    point.qdd = in.accelerations.empty() ? JointVector::Zero() : pick(in.accelerations, indices);
    if (point.time >= 0.0) trajectory.push_back(point);  // the rest is past already
  }
  if (!trajectory.empty() && trajectory.front().time > 0.0)
    trajectory.insert(trajectory.begin(), {0.0, start, JointVector::Zero(), JointVector::Zero()});
  if (!velocities)  // positions only: slopes of the neighbours, at rest at both ends
    for (std::size_t i = 0; i < trajectory.size(); ++i) {
      const bool inside = i > 0 && i + 1 < trajectory.size();
      trajectory[i].qd = JointVector::Zero();
      if (inside)
        trajectory[i].qd = (trajectory[i + 1].q - trajectory[i - 1].q) /
                           std::max(trajectory[i + 1].time - trajectory[i - 1].time, 1e-6);
    }
  return trajectory;
}

std::optional<JointVector> arm_joints(const sensor_msgs::JointState& state) {
  const auto indices = joint_indices(state.name);
  if (std::find(indices.begin(), indices.end(), -1) != indices.end() ||
      state.position.size() != state.name.size())
    return std::nullopt;
  return pick(state.position, indices);
}

cv::Mat depth_image(const sensor_msgs::Image& image, const std::string& topic) {
  if (image.encoding != sensor_msgs::image_encodings::TYPE_32FC1 &&
      image.encoding != sensor_msgs::image_encodings::TYPE_16UC1)
    throw Error(topic + ": depth has encoding '" + image.encoding +
                "', expected 16UC1 (millimetres) or 32FC1 (metres)");
  if (image.width == 0 || image.height == 0 ||
      image.data.size() != static_cast<std::size_t>(image.step) * image.height)
    throw Error(topic + ": depth image of " + std::to_string(image.width) + "x" +
                std::to_string(image.height) + " px carries " + std::to_string(image.data.size()) +
                " bytes");
  return sensing::depth_in_metres(cv_bridge::toCvCopy(image)->image);
}

}  // namespace iwgnet_grasp::nodes
