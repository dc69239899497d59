// Collision-free joint paths by OMPL.
#pragma once

#include <cstdint>
#include <string>

#include "iwgnet_grasp/motion/collision_world.h"
#include "iwgnet_grasp/motion/trajectory.h"

namespace iwgnet_grasp::motion {

struct PlannerConfig {  // config/motion.yaml
  double max_time;        // s
  double resolution;      // rad, between two collision checks
  std::uint64_t seed;
};

struct PlanResult {
  bool success = false;
  JointPath path;
  double seconds = 0.0;
  std::string message;  // why not
};

// RRTConnect, shortened. A straight joint motion is taken when it is free.
PlanResult plan(const CollisionWorld& world, const JointVector& from, const JointVector& to,
                const PlannerConfig& config);

// Straight motion of the tool from `from` to the pose: joint path of small steps, all free of
// collision when `check`; fails at singularities and jumps.
PlanResult plan_straight(const CollisionWorld& world, const JointVector& from,
                         const Pose& T_base_tool0, bool check, double step_m = 0.005);

}  // namespace iwgnet_grasp::motion
