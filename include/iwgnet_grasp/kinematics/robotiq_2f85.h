// Geometry of the Robotiq 2F-85 linkage (ros-industrial-attic/robotiq, arg2f_85 model).
#pragma once

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::kinematics {

inline constexpr double kPadWidth = 0.022;    // m, across the closing direction
inline constexpr double kPadHeight = 0.0375;  // m, along the approach
inline constexpr double kMaxFingerJoint = 0.8;  // rad

double gap_from_joint(double finger_joint);  // m between the pads
double joint_from_gap(double gap);           // rad, clamped to [0, 0.8]
double pad_center_height(double gap);        // m from tool0 along its z to the pads' centres
double finger_tip_height(double gap);        // m from tool0 to the lowest point of the fingers
double max_gap();                            // m

// Tool centre point (midpoint between the pads' centres; x = closing direction) in tool0.
Pose T_tool0_tcp(double gap);

}  // namespace iwgnet_grasp::kinematics
