// The calibration rig of the simulated cell: a plate with a printed target, bolted to the gripper,
// and what rig and camera are off by from their nominal poses. config/calibration.yaml
#pragma once

#include <cstdint>
#include <string>

#include "iwgnet_grasp/core/cell_config.h"

namespace iwgnet_grasp::physics {

struct Offset {  // along and about each axis, at most
  double translation;  // m
  double rotation;     // rad
};

struct CalibrationRig {
  Eigen::Vector2d print_size;            // m
  Box plate;                             // in the board frame
  Pose T_tool_board;                     // nominal: board -> tool0
  Offset board_offset, camera_offset;
  Offset pose_noise;                     // standard deviations of simulated target poses
  JointVector start_joints;              // rad
};

CalibrationRig load_calibration_rig(const std::string& config_dir);  // Throws Error.

// Uniform within +-offset along and about each axis.
Pose draw_offset(const Offset& offset, std::uint64_t seed);
// Normal with these standard deviations; each (seed, index) is a draw of its own.
Pose draw_noise(const Offset& sigma, std::uint64_t seed, std::uint64_t index);

}  // namespace iwgnet_grasp::physics
