// Eye-to-hand calibration: where a fixed camera stands, from poses of a target held by the robot.
//
// Every pair says  T_base_tool(i) T_tool_target = T_base_camera T_camera_target(i)  with the same two
// unknowns, T_base_camera and T_tool_target. A closed-form solver (ViSP, in the calibrator node) gives
// a start; refine() is the maximum-likelihood estimate from all pairs together.
#pragma once

#include <string>
#include <vector>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::calibration {

struct PosePair {
  Pose T_base_tool;
  Pose T_camera_target;
};

// Standard deviations of the measured T_camera_target, per axis.
struct PoseNoise {
  double translation = 5e-4;  // m
  double rotation = 1.75e-3;  // rad
};

struct Limits {
  int min_pairs = 4;               // three motions, one more than the equations need
  double min_rotation = 0.26;      // rad (15 deg) between the two farthest orientations
  double min_axis_spread = 0.17;   // rad (10 deg) between rotation axes; yaw alone is not enough
  double repeat_translation = 1e-4;  // m, pairs closer than this in both are one pose
  double repeat_rotation = 1e-3;     // rad
  double max_rms_translation = 5e-3;  // m
  double max_rms_rotation = 0.026;    // rad (1.5 deg)
};

// How well the tool's orientations are spread.
struct RotationDiversity {
  double largest = 0.0;      // rad, largest rotation between two poses
  double axis_spread = 0.0;  // rad, how far the rotation axes leave a single line
};
RotationDiversity rotation_diversity(const std::vector<PosePair>& pairs);

// Empty when the pairs can be solved, else one line: which pair or what is wrong and what to do.
std::string refuse_pairs(const std::vector<PosePair>& pairs, const Limits& limits = {});

struct HandEyeResult {
  bool success = false;
  std::string reason;  // why not
  Pose T_base_camera = Pose::Identity();
  Pose T_tool_target = Pose::Identity();
  double rms_translation = 0.0;  // m, over inlier pairs
  double rms_rotation = 0.0;     // rad
  std::vector<double> translation_residuals, rotation_residuals;  // m, rad, one a pair
  std::vector<double> weights;                     // 1 trusted .. 0 outlier, one a pair
  Eigen::Matrix<double, 6, 6> covariance;          // of T_base_camera, right perturbation (m, rad)
  int iterations = 0;
};

// Residuals and their RMS for given transforms, all pairs weighted alike.
HandEyeResult evaluate(const std::vector<PosePair>& pairs, const Pose& T_base_camera,
                       const Pose& T_tool_target);

// The T_tool_target that fits a T_base_camera best (mean over the pairs).
Pose mean_tool_target(const std::vector<PosePair>& pairs, const Pose& T_base_camera);

// Maximum likelihood over all pairs, robust to outliers, from a start near the solution.
// Fails with a reason: see refuse_pairs; no convergence; residual too high; contradicting pairs.
HandEyeResult refine(const std::vector<PosePair>& pairs, const Pose& T_base_camera_start,
                     const PoseNoise& noise = {}, const Limits& limits = {});

// RMS of AX = XB over all motions between two pairs, {m, rad}: with A the motion of the tool in the
// base, B the target's in the camera and X = T_base_camera, what (A X)^-1 X B differs from identity.
std::pair<double, double> axxb_rms(const std::vector<PosePair>& pairs, const Pose& T_base_camera);

// Largest change of T_base_camera when one pair is left out: {m, rad}.
std::pair<double, double> leave_one_out_spread(const std::vector<PosePair>& pairs,
                                               const HandEyeResult& result, const PoseNoise& noise,
                                               const Limits& limits = {});

}  // namespace iwgnet_grasp::calibration
