// Eye-to-hand calibration from the target's corners in the images themselves: the estimate that
// makes them fall where they were seen. A corner in the image has the same noise whatever the
// target's pose; the poses that are found from it have not, which is why this beats refine() on
// pairs where the images are at hand.
#pragma once

#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"

namespace iwgnet_grasp::calibration {

// One image of the target: corners in the target frame (m) and where they were seen (px).
struct TargetView {
  Pose T_base_tool;
  std::vector<Eigen::Vector3d> corners;
  std::vector<Eigen::Vector2d> pixels;
};

struct ReprojectionResult {
  bool success = false;
  std::string reason;  // why not
  Pose T_base_camera = Pose::Identity();
  Pose T_tool_target = Pose::Identity();
  double rms_px = 0.0;                     // over the corners of trusted views
  std::vector<double> view_rms_px;         // one a view
  std::vector<double> weights;             // 1 trusted .. 0 outlier, one a view
  Eigen::Matrix<double, 6, 6> covariance;  // of T_base_camera, steps in its own axes (m, rad)
  int iterations = 0;
};

// The distance in px of each corner from where the transforms put it: seen minus predicted.
std::vector<Eigen::Vector2d> reprojection_residuals(const TargetView& view,
                                                    const PinholeIntrinsics& camera,
                                                    const Pose& T_base_camera,
                                                    const Pose& T_tool_target);

// Maximum likelihood over all corners of all views, robust to wrong corners and to wrong views,
// from a start near the solution. Fails with a reason: fewer than 4 views, a view without 4
// corners, no convergence, most views contradict each other.
ReprojectionResult refine_reprojection(const std::vector<TargetView>& views,
                                       const PinholeIntrinsics& camera, const Pose& T_base_camera,
                                       const Pose& T_tool_target);

// Largest change of T_base_camera when one view is left out: {m, rad}.
std::pair<double, double> leave_one_out_spread(const std::vector<TargetView>& views,
                                               const PinholeIntrinsics& camera,
                                               const ReprojectionResult& result);

}  // namespace iwgnet_grasp::calibration
