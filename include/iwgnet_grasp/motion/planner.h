// Collision-free joint paths by OMPL.
#pragma once

#include <cstdint>
#include <string>

#include "iwgnet_grasp/motion/collision_world.h"
#include "iwgnet_grasp/motion/trajectory.h"

namespace iwgnet_grasp::motion {

struct PlannerConfig {  // config/motion.yaml
  double max_time;        // s
  double resolution;      // rad of the fastest joint, between two collision checks
  std::uint64_t seed;
};

struct PlanResult {
  bool success = false;
  JointPath path;
  double seconds = 0.0;
  std::string message;  // why not
};

// RRTConnect, shortened. A straight joint motion is taken when it is free. The same seed gives the
// same path as long as max_time is not reached.
PlanResult plan(const CollisionWorld& world, const JointVector& from, const JointVector& to,
                const PlannerConfig& config);

// Whether the straight joint motion is free of collision, ends included.
bool straight_joint_motion_is_free(const CollisionWorld& world, const JointVector& from,
                                   const JointVector& to, double resolution);

// Straight motion of the tool from `from` to the pose: the fewest waypoints whose joint
// interpolation stays within `tolerance_m` of the line, found on steps of step_m, all free of
// collision when `check`; fails at singularities and jumps.
PlanResult plan_straight(const CollisionWorld& world, const JointVector& from,
                         const Pose& T_base_tool0, bool check, double step_m = 0.005,
                         double tolerance_m = 0.0005);

}  // namespace iwgnet_grasp::motion
