// Timed joint trajectories.
#pragma once

#include <vector>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::motion {

struct TrajectoryPoint {
  double time;             // s from the start
  JointVector q, qd, qdd;  // rad, rad/s, rad/s^2
};
using Trajectory = std::vector<TrajectoryPoint>;
using JointPath = std::vector<JointVector>;

struct JointLimits {
  JointVector max_velocity;      // rad/s
  JointVector max_acceleration;  // rad/s^2
};

// The fastest trajectory along the path (corners rounded within `deviation` rad) that keeps the
// limits at every sample and rests at both ends; samples every `dt` seconds.
Trajectory time_parametrize(const JointPath& path, const JointLimits& limits,
                            double deviation = 0.05, double dt = 0.008);

// State at time t (cubic Hermite between points; clamped to the ends).
TrajectoryPoint sample(const Trajectory& trajectory, double t);

}  // namespace iwgnet_grasp::motion
