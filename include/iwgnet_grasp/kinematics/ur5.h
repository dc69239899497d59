// UR5: Denavit-Hartenberg model (Eq. 1) and closed-form inverse kinematics (Eq. 2).
// Poses are T_base_tool0: tool0 -> base_link as in the URDF, which is the DH base turned by pi about z.
//
// The sign of Eq. 2. Let (X, Y) = (px - d6 ax, py - d6 ay) be the wrist centre in the DH base frame.
// Forward kinematics demands X sin q1 - Y cos q1 = d4, so
//   q1 = atan2(Y, X) + atan2(d4, +-sqrt(X^2 + Y^2 - d4^2)).
// Eq. 2 as printed starts with atan2(d6 ay - py, px - d6 ax) = atan2(-Y, X) and gives exactly -q1,
// for both roots. With its second argument negated, atan2(d6 ay - py, d6 ax - px) - atan2(d4, ...),
// it gives q1. test_kinematics_ur5 shows both; inverse() uses the first form.
#pragma once

#include <array>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::kinematics {

struct DhRow {
  double d, a, alpha;  // m, m, rad
};

// ros-industrial/universal_robot, ur_description/config/ur5.
extern const std::array<DhRow, kJoints> kUr5Dh;

// Eq. 1: the transform from frame i to frame i-1 of one joint at angle theta.
Eigen::Matrix4d dh_transform(const DhRow& row, double theta);

// T_base_tool0 at q.
Pose forward(const JointVector& q);

// Frames of all links at q, index 0 = after joint 1 ... 5 = tool0; in base_link.
std::array<Pose, kJoints> link_frames(const JointVector& q);

struct IkSolutions {
  std::array<JointVector, 8> q;  // rad, each in (-pi, pi]
  int count = 0;
};

// All solutions (at most 8) for T_base_tool0; at the wrist singularity joint 6 takes `q6_singular`.
IkSolutions inverse(const Pose& T_base_tool0, double q6_singular = 0.0);

// The solution turned by multiples of 2 pi to lie nearest to `reference` within +-2 pi.
JointVector nearest_turn(const JointVector& q, const JointVector& reference);

// 6x6 geometric Jacobian of tool0 in base_link at q: rows 0-2 linear, 3-5 angular.
Eigen::Matrix<double, 6, 6> jacobian(const JointVector& q);

}  // namespace iwgnet_grasp::kinematics
