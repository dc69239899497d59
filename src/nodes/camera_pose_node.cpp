// Publishes base_link -> camera_link, the one transform that calibration finds: from ~calibration
// when that file is given, else the nominal pose of config/camera.yaml.
#include <iwgnet_grasp/Topics.h>
#include <tf2_eigen/tf2_eigen.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <tf2_ros/transform_listener.h>

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

void publish() {
  const ros::NodeHandle node;  // keeps ROS up
  ros::AsyncSpinner spinner(1);
  spinner.start();
  const std::string file = ros::param::param<std::string>("~calibration", "");
  const Pose T_base_color = file.empty()
                                ? load_cell_config(config_dir()).camera.T_base_color
                                : load_camera_pose(file);
  const std::optional<Pose> T_camera_link_color = find_color_imager();
  if (!T_camera_link_color) return;
  const Pose T_base_camera_link = T_base_color * T_camera_link_color->inverse();

  geometry_msgs::TransformStamped transform;
  transform.header.stamp = ros::Time::now();
  transform.header.frame_id = Topics::BASE_FRAME;
  transform.child_frame_id = Topics::CAMERA_FRAME;
  transform.transform = to_transform_message(T_base_camera_link);
  tf2_ros::StaticTransformBroadcaster broadcaster;
  broadcaster.sendTransform(transform);
  const Eigen::Vector3d p = T_base_color.translation();
  ROS_INFO("camera_pose: colour camera at (%.4f, %.4f, %.4f) m, %s", p.x(), p.y(), p.z(),
           file.empty() ? "nominal pose" : file.c_str());
  ros::waitForShutdown();
}

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "camera_pose", iwgnet_grasp::nodes::publish);
}
