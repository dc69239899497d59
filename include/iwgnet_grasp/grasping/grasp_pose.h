// From a grasp in the image to a grasp pose of the gripper (three stages of section 2.2, Eq. 5).
#pragma once

#include <optional>
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
  // TCP once the gap is `width`: T_base_tool0 = T_base_tcp * T_tool0_tcp(width).inverse(), also
  // while the gripper is open (its tips are higher then). x = closing direction, z = approach (down).
  Pose T_base_tcp = Pose::Identity();
  double width = 0.0;                  // m, expected gap on the object (Eq. 5)
  double opening = 0.0;                // m, gap to approach with
  double contact = 0.0;                // m, least gap at which the measured surface lets both fingers in
  double quality = 0.0;
  double touch = 0.0;                  // [0, 1], how much of the pads will touch the measured object
  double tip_height = 0.0;             // m, finger tips over base_link's z = 0 once closed
  double engagement = 0.0;             // m, overlap of finger and object along the approach
  int candidate = 0;                   // which of best_grasp_pose()'s candidates this is
  bool feasible = false;
  std::string reason;                  // one line, when not feasible
};

// What of the fingers hangs over a rectangle around the approach axis; it spreads with the opening.
struct FingerBody {
  double along, spread;          // m along the closing direction: half extent along + spread * opening
  double across;                 // m across it, half extent
  double above_tips;             // m, its lowest point above the tips
};

struct Palm {
  Eigen::Vector2d half;          // m, along and across the closing direction
  double reach;                  // m, its lowest point below tool0
};

struct GraspPoseConfig {  // config/grasping.yaml, section "pose"
  double opening_margin;     // m, added to the width for the approach
  double side_clearance;     // m, least play a side when a neighbour leaves no room for the margin
  double max_opening;        // m
  double insertion_depth;    // m, finger tips below the surface at the grasp point
  double min_engagement;     // m, least overlap of finger and object
  double floor_clearance;    // m, finger tips above whatever lies under them
  double border;             // m, how far outside the workspace a grasp may lie
  double max_roll, max_pitch;  // rad, of the approach against the vertical, in the closing direction and
                               // across it
  double min_tilt;           // rad, a surface that slopes less is taken for level
  double misalignment_scale; // rad, between pads and object, at which quality has fallen to 1/e
  double spread_scale;       // m that `contact` exceeds the width, likewise
  double shallow_scale;      // m above insertion_depth that cost as much in the choice of the depth
  std::vector<double> shifts;  // m across the closing direction, other places that are tried
  double shift_scale;        // m of such a shift, likewise
  double lever_scale;        // m from the centroid along the pads, likewise
  double hang_scale;         // m of the centroid beyond the pads along the approach, likewise
  double overhang_scale;     // times the engagement that the centroid lies beside the pads along the
                             // closing direction, likewise
  double width_scale;        // m of the width beyond a shank's, likewise
  double finger_thickness;   // m, of a finger along the closing direction, outside the pad face
  // Outer side of a finger above its tip: (m outwards from the pad face, m above the tip).
  std::vector<Eigen::Vector2d> finger_outline;
  std::vector<FingerBody> fingers;
  Palm palm;
};
GraspPoseConfig load_grasp_pose_config(const std::string& config_dir);  // Throws Error.

// Rise of a surface for each metre along and across the closing direction.
struct Slope {
  double along = 0.0, across = 0.0;
};

// Slope of an object's upper side: of the plane that holds most of what is seen between the jaws,
// `width` apart along the unit vector `along`, and is not far below `surface` (m). Level when there
// is none, or none with slopes up to max_along and max_across.
Slope surface_slope(const HeightMap& heights, const Eigen::Vector2d& center,
                    const Eigen::Vector2d& along, double surface, double width, double max_along,
                    double max_across);

// Eq. 5: pixels to metres at depth z.
double width_in_metres(double width_px, double depth_m, double fx_px);

// Pixel -> camera -> base -> pose. The object's surface is the highest that `heights` shows along
// the closing line, so that a centre over a bore or without a measurement still finds the object.
// Where its upper side slopes, the gripper leans with it as far as what lies around it permits, so
// that both pads meet the object flat: a part that is gripped by its edges turns between the pads as
// soon as it leaves the table. The tips go as deep as the insertion depth allows and what lies under
// their sweep from the opening to the object permits; where a neighbour is close, the opening
// shrinks. quality is the network's, less what is measured: the angle left between pads and object,
// what the fingers would take along (alone_share), pads that touch by their edge only, and how wide
// the object is: what is round slides out of wide open fingers. Never throws for a bad grasp:
// feasible is false and reason says why (no depth, outside the workspace, wider than the gripper,
// fingers collide).
GraspPose grasp_pose(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
                     const Pose& T_base_camera, const HeightMap& heights,
                     const CellConfig& cell, const GraspPoseConfig& config);

// What is left of a grasp's quality, in [0, 1], where the fingers have to stand `pose.contact` apart
// for an object that is `width` (m) wide: what else lies between them comes along.
double alone_share(const GraspPose& pose, double width, const GraspPoseConfig& config);

// grasp_pose() at the grasp's place and beside it along the pads, whichever is best: quality also
// falls with the distance from the network's place and from the object's centroid (base_link) where
// that is known, along the pads, along the approach and beside the pads, each as
// exp(-(amount / scale)^2). A rim, which has its object beside it, is gripped nowhere else.
GraspPose aligned_grasp_pose(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
                             const Pose& T_base_camera, const HeightMap& heights,
                             const CellConfig& cell, const GraspPoseConfig& config,
                             const std::optional<Eigen::Vector3d>& centroid = {});

// The feasible aligned pose of the highest quality, else the first with its reason.
GraspPose best_grasp_pose(const std::vector<GraspRectangle>& candidates,
                          const PinholeIntrinsics& camera, const Pose& T_base_camera,
                          const HeightMap& heights, const CellConfig& cell,
                          const GraspPoseConfig& config,
                          const std::optional<Eigen::Vector3d>& centroid = {});

}  // namespace iwgnet_grasp::grasping
