// config/physics.yaml read into values; SI units.
#pragma once

#include <string>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::physics {

struct PhysicsConfig {
  double timestep, gravity;
  int iterations, grip_iterations;
  double contact_erp, linear_slop, coupling_erp;
  double margin, breaking_distance, restitution;
  double sleep_linear, sleep_angular, sleep_time;
  double part_friction, pad_friction, robot_friction, table_friction, tray_friction,
      structure_friction;
  JointVector torque_limits;
  double bandwidth, max_acceleration;
  double max_speed, min_speed, min_force, max_force, position_gain, drive_inertia,
      linkage_inertia, pad_stiffness, pad_damping;
};

PhysicsConfig load_physics_config(const std::string& config_dir);  // Throws Error.

}  // namespace iwgnet_grasp::physics
