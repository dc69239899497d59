#include "iwgnet_grasp/kinematics/robotiq_2f85.h"

#include <algorithm>
#include <cmath>

namespace iwgnet_grasp::kinematics {
namespace {

// Linkage of one finger in its plane, (x outward, z along the approach), m. The outer knuckle turns
// by the finger joint about its pivot, the inner finger turns back by as much, so pads stay parallel.
constexpr double kPivotX = 0.0306011, kPivotZ = 0.054904;
constexpr double kLinkX = 0.0315 + 0.0061, kLinkZ = -0.0041 + 0.0471;  // pivot -> inner finger
constexpr double kPadX = -0.0220203, kPadZ = 0.03242;                  // inner finger -> pad centre
constexpr double kPadThickness = 0.00635;
constexpr double kMaxJoint = 0.8;  // rad

const double kLinkLength = std::hypot(kLinkX, kLinkZ);
const double kLinkAngle = std::atan2(kLinkX, kLinkZ);
constexpr double kFaceX = kPivotX + kPadX - kPadThickness / 2;  // pad face when the link is upright

}  // namespace

double gap_from_joint(double finger_joint) {
  return 2 * (kFaceX + kLinkLength * std::sin(kLinkAngle - finger_joint));
}

double joint_from_gap(double gap) {
  const double sine = std::clamp((gap / 2 - kFaceX) / kLinkLength, -1.0, 1.0);
  return std::clamp(kLinkAngle - std::asin(sine), 0.0, kMaxJoint);
}

double pad_center_height(double gap) {
  return kPivotZ + kPadZ + kLinkLength * std::cos(kLinkAngle - joint_from_gap(gap));
}

double finger_tip_height(double gap) { return pad_center_height(gap) + kPadHeight / 2; }

double max_gap() { return gap_from_joint(0.0); }

Pose T_tool0_tcp(double gap) {
  return Pose(Eigen::Translation3d(0.0, 0.0, pad_center_height(gap)));
}

}  // namespace iwgnet_grasp::kinematics
