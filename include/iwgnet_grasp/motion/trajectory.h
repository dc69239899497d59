// Timed joint trajectories: the fastest run along a path inside limits of joints and tool.
#pragma once

#include <limits>
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

// A stretch of a path with limits of its own.
struct PathLeg {
  JointPath path;  // waypoints; the first continues the leg before
  JointLimits limits;
  double max_tool_speed = std::numeric_limits<double>::infinity();         // m/s, tool0
  double max_tool_acceleration = std::numeric_limits<double>::infinity();  // m/s^2 along each axis
  double deviation = 0.05;  // rad, how far corners may be cut; 0 stops at them. Where two legs
                            // join, the smaller one counts.
};

// The fastest trajectory along the legs that keeps the limits at every sample and rests at both
// ends; samples every `dt` seconds. Corners are parabolas; speed comes from a backward and a forward
// pass over the phase plane (s, s'^2) (Pham and Pham, TOPP-RA, IEEE T-RO 2018).
// Throws Error when there is no waypoint or a limit is not positive.
Trajectory time_parametrize(const std::vector<PathLeg>& legs, double dt = 0.008);

// The same for one path.
Trajectory time_parametrize(const JointPath& path, const JointLimits& limits,
                            double deviation = 0.05, double dt = 0.008);

// State at time t (cubic Hermite between points; clamped to the ends). Throws Error when empty.
TrajectoryPoint sample(const Trajectory& trajectory, double t);

}  // namespace iwgnet_grasp::motion
