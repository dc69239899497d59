// Grasps from geometry: where two parallel pads can hold a part, and which of these grasps a
// gripper pointing down can carry out in a settled scene. Used to label training data.
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/core/mesh.h"
#include "iwgnet_grasp/grasping/grasp_pose.h"

namespace iwgnet_grasp::grasping {

struct AntipodalConfig {      // config/grasping.yaml, section "labels"
  int surface_samples;        // points drawn on a part's surface
  double friction;            // Coulomb, pad on part
  double grip_force;          // N, the robot's: config/motion.yaml
  double min_width;           // m between the contacts
  double max_tilt;            // rad, of the line between the contacts against the horizontal
  double min_contact_area;    // share of the pad that must touch
  double com_scale;           // m, distance from the centre of mass at which quality has fallen to 1/e
  double load_scale;          // of its own weight, resting on a part, that leaves 1/e of the quality
  double min_quality;         // labels below are left out
  double nms_distance;        // m, two grasps of a part closer than this ...
  double nms_angle;           // rad, ... and than this are one
  int max_per_part;
  std::uint64_t seed;         // of the surface samples
};
AntipodalConfig load_antipodal_config(const std::string& config_dir);  // Throws Error.

// Two opposite contacts in the part's frame (origin at the centre of mass).
struct AntipodalGrasp {
  Eigen::Vector3f a, b;  // m
};

// What labelling needs of a part; made once from its mesh.
struct PartGrasps {
  std::vector<AntipodalGrasp> grasps;
  Eigen::Matrix3Xf points;   // m, spread evenly over the surface
  Eigen::Matrix3Xf normals;  // outward, unit
  double area = 0.0;         // m^2, of the whole surface
  double mass = 0.0;         // kg
};

// Contacts between opposite faces of a closed mesh: a line from each surface sample against its
// normal to the far side, kept when it lies in both friction cones (force closure of two soft
// fingers) and when its length suits the gripper. Throws Error for a mesh without area.
PartGrasps find_antipodal_grasps(const TriangleMesh& mesh, double mass,
                                 const AntipodalConfig& config, double max_width);

struct ScenePart {
  const PartGrasps* grasps;  // not null
  Pose T_base_part = Pose::Identity();
  int instance = -1;         // its value in the instance image
  double load = 0.0;         // N, what other parts rest on it with
};

struct GraspLabel {
  int part;                 // index into the scene's parts
  GraspRectangle rectangle;  // colour image; width_px is the part's width between the pads
  double jaw_px;            // pad width across the closing direction
  double opening_px;        // gap to approach with
  GraspPose pose;           // as grasp_pose() gives it for this rectangle
};

// Executable grasps of every visible part, best first within a part, parts in order.
// depth (CV_32FC1 m, noise-free) and instances (CV_32SC1) show the whole scene from `camera`.
// quality in (0, 1]: distance of the centre of mass from the line between the contacts, how
// squarely and how much the pads touch, clearance from what lies beside the part, whether the part
// is alone between the fingers, and whether others would come up with it.
// Throws Error when the images do not fit the camera.
std::vector<GraspLabel> label_grasps(const std::vector<ScenePart>& parts, const cv::Mat& depth,
                                     const cv::Mat& instances, const PinholeIntrinsics& camera,
                                     const Pose& T_base_camera, const CellConfig& cell,
                                     const GraspPoseConfig& pose_config,
                                     const AntipodalConfig& config);

}  // namespace iwgnet_grasp::grasping
