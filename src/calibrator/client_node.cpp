// The workflow of visp_hand2eye_calibration's client on the calibrator: reset until it answers, make
// pairs from a known transform, publish them, solve them by the quick service and by the stream one.
// Needs nothing but the calibrator; shows that both speak the same interface.
#include <geometry_msgs/Transform.h>
#include <ros/ros.h>
#include <visp_hand2eye_calibration/TransformArray.h>
#include <visp_hand2eye_calibration/compute_effector_camera.h>
#include <visp_hand2eye_calibration/compute_effector_camera_quick.h>
#include <visp_hand2eye_calibration/reset.h>

#include <cmath>

#include "iwgnet_grasp/core/types.h"

namespace visp = visp_hand2eye_calibration;
using iwgnet_grasp::Pose;

namespace {

constexpr int kPairs = 6;

Pose pose(double x, double y, double z, double rx, double ry, double rz) {
  return Eigen::Translation3d(x, y, z) * Eigen::AngleAxisd(rz, Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(ry, Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(rx, Eigen::Vector3d::UnitX());
}

geometry_msgs::Transform to_message(const Pose& T) {
  geometry_msgs::Transform message;
  const Eigen::Quaterniond q(T.linear());
  message.rotation.x = q.x(), message.rotation.y = q.y();
  message.rotation.z = q.z(), message.rotation.w = q.w();
  message.translation.x = T.translation().x();
  message.translation.y = T.translation().y();
  message.translation.z = T.translation().z();
  return message;
}

Pose from_message(const geometry_msgs::Transform& message) {
  const auto& t = message.translation;
  const auto& q = message.rotation;
  return Eigen::Translation3d(t.x, t.y, t.z) * Eigen::Quaterniond(q.w, q.x, q.y, q.z).normalized();
}

// Whether the answer is the known transform; says so.
bool report(const char* service, bool answered, const geometry_msgs::Transform& answer,
            const Pose& known) {
  if (!answered) {
    ROS_ERROR("client: %s failed; the calibrator's log says why", service);
    return false;
  }
  const Pose error = known.inverse() * from_message(answer);
  const double far = error.translation().norm();
  const double turn = Eigen::AngleAxisd(error.linear()).angle();
  ROS_INFO("client: %s: translation (%.4f, %.4f, %.4f), %.2g m and %.2g rad from the truth", service,
           answer.translation.x, answer.translation.y, answer.translation.z, far, turn);
  return far < 1e-6 && turn < 1e-6;
}

int run() {
  ros::NodeHandle node;
  // As the calibrator's ~eye_to_hand: the camera stands in the room and the target is held, or the
  // camera is held and the target stands in the room.
  const bool eye_to_hand = ros::param::param("~eye_to_hand", false);
  auto camera = node.advertise<geometry_msgs::Transform>("camera_object", 1000);
  auto effector = node.advertise<geometry_msgs::Transform>("world_effector", 1000);
  auto reset = node.serviceClient<visp::reset>("reset");
  auto quick = node.serviceClient<visp::compute_effector_camera_quick>("compute_effector_camera_quick");
  auto stream = node.serviceClient<visp::compute_effector_camera>("compute_effector_camera");

  visp::reset nothing;
  while (!reset.call(nothing)) {
    if (!ros::ok()) return 1;
    ROS_INFO_THROTTLE(5.0, "client: waiting for the calibrator's reset service");
    ros::WallDuration(0.1).sleep();
  }
  while (ros::ok() && (camera.getNumSubscribers() == 0 || effector.getNumSubscribers() == 0))
    ros::WallDuration(0.02).sleep();

  const Pose known = eye_to_hand ? pose(0.50, 0.01, 0.60, M_PI, 0.02, -0.03)
                                 : pose(0.10, 0.20, 0.30, 0.10, 0.20, 0.30);
  const Pose target = pose(0.01, -0.02, 0.26, 0.05, -0.04, 0.50);  // on the tool or in the world
  visp::compute_effector_camera_quick request;
  for (int i = 0; i < kPairs; ++i) {
    const Pose T_world_effector =
        pose(0.45 + 0.02 * i, 0.05 * (i % 3 - 1), 0.25 + 0.01 * i, 0.4 * std::sin(1.0 + 2.0 * i),
             0.4 * std::cos(2.0 + 1.3 * i), 0.5 * std::sin(0.7 * i));
    const Pose T_camera_object = eye_to_hand
                                     ? Pose(known.inverse() * T_world_effector * target)
                                     : Pose((T_world_effector * known).inverse() * target);
    request.request.camera_object.transforms.push_back(to_message(T_camera_object));
    request.request.world_effector.transforms.push_back(to_message(T_world_effector));
    camera.publish(request.request.camera_object.transforms.back());
    effector.publish(request.request.world_effector.transforms.back());
  }
  const bool quick_right = report("compute_effector_camera_quick", quick.call(request),
                                  request.response.effector_camera, known);

  // Topics and services come by different connections: the pairs may be on their way still.
  visp::compute_effector_camera answer;
  bool answered = false;
  for (int attempt = 0; attempt < 20 && !answered && ros::ok(); ++attempt) {
    ros::WallDuration(0.1).sleep();
    answered = stream.call(answer);
  }
  const bool stream_right =
      report("compute_effector_camera", answered, answer.response.effector_camera, known);
  return quick_right && stream_right ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "client");
  return run();
}
