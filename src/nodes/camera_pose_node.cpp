// Publishes base_link -> camera_link, the one transform that calibration finds: from ~calibration
// when that file is given, else the nominal pose of config/camera.yaml; and anew whenever a
// calibration says on topic CAMERA_POSE where the colour camera is.
#include <iwgnet_grasp/Topics.h>
#include <tf2_eigen/tf2_eigen.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <tf2_ros/transform_listener.h>

#include <cmath>
#include <optional>

#include "conversions.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

// The pose of the colour camera is what is calibrated; the camera's driver knows where the colour
// imager sits in its body. Throws Error when it does not say so within 30 s; nullopt when the node
// is stopped before.
std::optional<Pose> find_color_imager() {
  tf2_ros::Buffer buffer;
  const tf2_ros::TransformListener listener(buffer);
  const ros::WallTime start = ros::WallTime::now();
  while (ros::ok()) {
    try {
      return tf2::transformToEigen(
          buffer.lookupTransform(Topics::CAMERA_FRAME, Topics::COLOR_FRAME, ros::Time(0)));
    } catch (const tf2::TransformException&) {
      if (ros::WallTime::now() - start > ros::WallDuration(30.0))
        throw Error("tf holds no " + Topics::CAMERA_FRAME + " -> " + Topics::COLOR_FRAME +
                    " after 30 s: is the camera's driver running with publish_tf?");
    }
    ros::WallDuration(0.02).sleep();
  }
  return std::nullopt;
}

class CameraPose {
 public:
  explicit CameraPose(const Pose& T_camera_link_color)
      : T_color_camera_link_(T_camera_link_color.inverse()),
        subscriber_(node_.subscribe(Topics::CAMERA_POSE, 1, &CameraPose::on_pose, this)) {}

  void publish(const Pose& T_base_color, const std::string& source) {
    geometry_msgs::TransformStamped transform;
    transform.header.stamp = ros::Time::now();
    transform.header.frame_id = Topics::BASE_FRAME;
    transform.child_frame_id = Topics::CAMERA_FRAME;
    transform.transform = to_transform_message(T_base_color * T_color_camera_link_);
    broadcaster_.sendTransform(transform);
    const Eigen::Vector3d p = T_base_color.translation();
    ROS_INFO("camera_pose: colour camera at (%.4f, %.4f, %.4f) m, %s", p.x(), p.y(), p.z(),
             source.c_str());
  }

 private:
  void on_pose(const geometry_msgs::TransformStamped::ConstPtr& message) {
    const auto& q = message->transform.rotation;
    const Pose T = tf2::transformToEigen(*message);
    const double norm = Eigen::Quaterniond(q.w, q.x, q.y, q.z).norm();
    if (message->header.frame_id != Topics::BASE_FRAME ||
        message->child_frame_id != Topics::COLOR_FRAME)
      ROS_ERROR("camera_pose: %s holds %s -> %s, expected %s -> %s; ignored",
                Topics::CAMERA_POSE.c_str(), message->header.frame_id.c_str(),
                message->child_frame_id.c_str(), Topics::BASE_FRAME.c_str(),
                Topics::COLOR_FRAME.c_str());
    else if (!T.matrix().allFinite() || !(std::abs(norm - 1.0) < 1e-3))
      ROS_ERROR("camera_pose: %s holds no rigid transform; ignored", Topics::CAMERA_POSE.c_str());
    else
      publish(T, "by " + Topics::CAMERA_POSE);
  }

  const Pose T_color_camera_link_;
  ros::NodeHandle node_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  ros::Subscriber subscriber_;
};

void run() {
  const ros::NodeHandle node;  // keeps ROS up
  ros::AsyncSpinner spinner(1);
  spinner.start();
  const std::string file = ros::param::param<std::string>("~calibration", "");
  const Pose T_base_color = file.empty()
                                ? load_cell_config(config_dir()).camera.T_base_color
                                : load_camera_pose(file);
  const std::optional<Pose> T_camera_link_color = find_color_imager();
  if (!T_camera_link_color) return;
  CameraPose camera(*T_camera_link_color);
  camera.publish(T_base_color, file.empty() ? "nominal pose" : file);
  ros::waitForShutdown();
}

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "camera_pose", iwgnet_grasp::nodes::run);
}
