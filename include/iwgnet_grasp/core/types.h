// Types shared by all rooms. SI units; T_to_from maps coordinates of `from` to `to`.
#pragma once

#include <Eigen/Geometry>
#include <stdexcept>
#include <string>

namespace iwgnet_grasp {

using Pose = Eigen::Isometry3d;
using JointVector = Eigen::Matrix<double, 6, 1>;  // rad, in the order of kJointNames

inline constexpr int kJoints = 6;
inline constexpr const char* kJointNames[kJoints] = {
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
    "wrist_1_joint",      "wrist_2_joint",       "wrist_3_joint"};

// What every function of the core throws: one line saying what is wrong, where, and what to do.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

}  // namespace iwgnet_grasp
