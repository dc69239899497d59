// Node 3: turns each ranked object's grasps into a pose of the gripper in the base frame (topic 3)
// and a width in metres (topic 4).
#include <iwgnet_grasp/GraspPoses.h>
#include <iwgnet_grasp/GraspSequence.h>
#include <iwgnet_grasp/GripperWidths.h>
#include <iwgnet_grasp/Scene.h>
#include <iwgnet_grasp/Topics.h>
#include <tf2_ros/transform_listener.h>
#include <visualization_msgs/MarkerArray.h>

#include <limits>

#include "camera_transform.h"
#include "conversions.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/motion/pick_and_place.h"
#include "iwgnet_grasp/sensing/pinhole.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

std_msgs::ColorRGBA color_of(bool feasible, float quality) {
  std_msgs::ColorRGBA color;  // red (poor) to green (good); grey when it cannot be done
  color.r = feasible ? 1.0f - quality : 0.5f;
  color.g = feasible ? quality : 0.5f;
  color.b = feasible ? 0.1f : 0.5f;
  color.a = 0.9f;
  return color;
}

// Fingers, the line between them, and the object's place in the order.
void add_markers(const GraspPose& grasp, int order, const std_msgs::Header& header,
                 visualization_msgs::MarkerArray& markers) {
  const Pose T_base_tcp = from_message(grasp.pose);
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.color = color_of(grasp.feasible, grasp.quality);
  marker.pose.orientation.w = 1.0;
  marker.id = 3 * order;
  for (const double side : {-1.0, 1.0}) {
    marker.ns = "fingers";
    marker.type = visualization_msgs::Marker::CUBE;
    marker.id += 1;
    marker.pose = to_message(
        Pose(T_base_tcp * Eigen::Translation3d(side * (grasp.opening / 2 + 0.004), 0, 0)));
    marker.scale.x = 0.008;
    marker.scale.y = kinematics::kPadWidth;
    marker.scale.z = kinematics::kPadHeight;
    markers.markers.push_back(marker);
  }
  marker.ns = "closing";
  marker.type = visualization_msgs::Marker::LINE_LIST;
  marker.pose = to_message(T_base_tcp);
  marker.scale.x = 0.002;
  marker.points = {to_message(Eigen::Vector3d(-grasp.opening / 2, 0, 0)),
                   to_message(Eigen::Vector3d(grasp.opening / 2, 0, 0))};
  markers.markers.push_back(marker);

  marker.ns = "order";
  marker.type = visualization_msgs::Marker::TEXT_VIEW_FACING;
  marker.points.clear();
  marker.pose = visualization_msgs::Marker().pose;
  marker.pose.orientation.w = 1.0;
  marker.pose.position = to_message(Eigen::Vector3d(T_base_tcp.translation() +
                                                    Eigen::Vector3d(0, 0, 0.05)));
  marker.scale.z = 0.03;
  marker.color.r = marker.color.g = marker.color.b = marker.color.a = 1.0f;
  marker.text = std::to_string(order + 1) + (grasp.feasible ? "" : " -");
  markers.markers.push_back(marker);
}

class SpatialTransform {
 public:
  SpatialTransform()
      : cell_(load_cell_config(config_dir())),
        config_(grasping::load_grasp_pose_config(config_dir())),
        grip_force_(motion::load_pick_place_config(config_dir()).grip_force),
        transforms_(buffer_) {
    poses_ = node_.advertise<GraspPoses>(Topics::GRASP_POSE, 1, true);
    widths_ = node_.advertise<GripperWidths>(Topics::GRIPPER_WIDTH, 1, true);
    markers_ = node_.advertise<visualization_msgs::MarkerArray>(Topics::GRASP_MARKERS, 1, true);
    scene_subscriber_ = node_.subscribe(Topics::SCENE, 1, &SpatialTransform::on_scene, this);
    sequence_subscriber_ =
        node_.subscribe(Topics::SEQUENCE, 2, &SpatialTransform::on_sequence, this);
  }

 private:
  void on_scene(const Scene::ConstPtr& scene) {
    scene_ = scene;
    have_heights_ = false;
    transform();
  }

  void on_sequence(const GraspSequence::ConstPtr& sequence) {
    sequence_ = sequence;
    transform();
  }

  // Waits, in effect, for both halves of a look: a scene and the sequence that was made of it.
  void transform() {
    if (!scene_ || !sequence_ || scene_->scene_id != sequence_->scene_id) return;
    try {
      const PinholeIntrinsics camera = from_message(sequence_->camera_info);
      const Pose T_base_camera = camera_transform(buffer_, sequence_->header.frame_id);
      if (!have_heights_) {
        heights_ = grasping::HeightMap(depth_image(scene_->depth, Topics::SCENE), camera,
                                       T_base_camera, cell_);
        have_heights_ = true;
      }
      publish(camera, T_base_camera);
    } catch (const Error& error) {
      ROS_ERROR("spatial_transform: scene %u: %s", sequence_->scene_id, error.what());
    }
  }

  void publish(const PinholeIntrinsics& camera, const Pose& T_base_camera) {
    GraspPoses poses;
    poses.header.stamp = sequence_->header.stamp;
    poses.header.frame_id = Topics::BASE_FRAME;
    poses.scene_id = sequence_->scene_id;
    poses.failed_grasps = sequence_->failed_grasps;
    GripperWidths widths;
    widths.header = poses.header;
    widths.scene_id = poses.scene_id;
    visualization_msgs::MarkerArray markers;
    markers.markers.emplace_back();
    markers.markers.back().action = visualization_msgs::Marker::DELETEALL;

    for (const RankedObject& ranked : sequence_->objects) {
      const ObjectGrasps& object = ranked.object;
      if (object.grasps.empty()) continue;
      std::vector<grasping::GraspRectangle> candidates;
      for (const GraspRectangle& grasp : object.grasps) candidates.push_back(from_message(grasp));
      std::optional<Eigen::Vector3d> centroid;
      if (object.valid_pixels > 0)
        centroid = T_base_camera * sensing::deproject(camera, object.centroid_u_px,
                                                      object.centroid_v_px, object.centroid_depth_m);
      const grasping::GraspPose pose = grasping::best_grasp_pose(
          candidates, camera, T_base_camera, heights_, cell_, config_, centroid);

      GraspPose message = to_message(pose);
      if (object.valid_pixels == 0) {
        message.feasible = false;
        message.reason = "no valid depth on the object";
      }
      message.object_id = object.object_id;
      message.grasp = object.grasps.at(pose.candidate);
      message.centroid = to_message(
          centroid.value_or(Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN())));
      GripperWidth width;
      width.object_id = object.object_id;
      width.opening = pose.opening;
      width.width = pose.width;
      width.force = grip_force_;
      add_markers(message, static_cast<int>(poses.grasps.size()), poses.header, markers);
      poses.grasps.push_back(std::move(message));
      widths.widths.push_back(width);
    }
    widths_.publish(widths);  // before the poses: who has a pose finds its width
    poses_.publish(poses);
    markers_.publish(markers);
  }

  const CellConfig cell_;
  const grasping::GraspPoseConfig config_;
  const double grip_force_;
  ros::NodeHandle node_;
  tf2_ros::Buffer buffer_;
  tf2_ros::TransformListener transforms_;
  Scene::ConstPtr scene_;
  GraspSequence::ConstPtr sequence_;
  grasping::HeightMap heights_;
  bool have_heights_ = false;
  ros::Publisher poses_, widths_, markers_;
  ros::Subscriber scene_subscriber_, sequence_subscriber_;
};

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "spatial_transform", [] {
    iwgnet_grasp::nodes::SpatialTransform node;
    ros::spin();
  });
}
