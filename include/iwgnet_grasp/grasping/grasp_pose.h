// From a grasp in the image to a grasp pose of the gripper (three stages of section 2.2, Eq. 5).
#pragma once

#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/grasping/height_map.h"

namespace iwgnet_grasp::grasping {

struct GraspRectangle {
  double x_px, y_px;   // centre
  double theta_rad;    // closing direction, counter-clockwise as seen: atan2(-dy, dx)
  double width_px;     // jaw opening
  double quality;      // [0, 1]
  double depth_m;      // measured depth at the centre
};

struct GraspPose {
  Pose T_base_tcp = Pose::Identity();  // x = closing direction, z = approach (down)
  double width = 0.0;                  // m, expected gap on the object (Eq. 5)
  double opening = 0.0;                // m, gap to approach with
  double quality = 0.0;
  bool feasible = false;
  std::string reason;                  // one line, when not feasible
};

struct GraspPoseConfig {  // config/grasping.yaml
  double opening_margin;     // m, added to the width for the approach
  double max_opening;        // m
  double insertion_depth;    // m, finger tips below the surface at the grasp point
  double min_engagement;     // m, least overlap of finger and object
  double floor_clearance;    // m, finger tips above whatever lies under them
  double finger_thickness;   // m, of a finger along the closing direction, outside the pad face
};
GraspPoseConfig load_grasp_pose_config(const std::string& config_dir);  // Throws Error.

// Eq. 5: pixels to metres at depth z.
double width_in_metres(double width_px, double depth_m, double fx_px);

// Pixel -> camera -> base -> pose; opening and depth are chosen so that the fingers clear what
// lies beside the object in `heights`. Never throws for a bad grasp: feasible is false and
// reason says why (no depth, outside the workspace, wider than the gripper, fingers collide).
GraspPose grasp_pose(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
                     const Pose& T_base_camera, const HeightMap& heights,
                     const CellConfig& cell, const GraspPoseConfig& config);

// The first feasible pose of the candidates (best first), else the first with its reason.
GraspPose best_grasp_pose(const std::vector<GraspRectangle>& candidates,
                          const PinholeIntrinsics& camera, const Pose& T_base_camera,
                          const HeightMap& heights, const CellConfig& cell,
                          const GraspPoseConfig& config);

}  // namespace iwgnet_grasp::grasping
