// One pick: approach, grasp, lift, transfer, release, back to observing.
#pragma once

#include <functional>
#include <string>

#include "iwgnet_grasp/grasping/grasp_pose.h"
#include "iwgnet_grasp/motion/planner.h"

namespace iwgnet_grasp::motion {

struct ExecutionResult {
  bool success = false;
  std::string message;
};

struct GripResult {
  bool success = false;  // the command was carried out
  bool stalled = false;  // stopped by an object before the commanded gap
  double gap = 0.0;      // m
  std::string message;
};

// What pick and place needs from a robot. Implemented over ROS actions and by the simulated cell.
// Calls block until done; execute() returns when the arm has come to rest at the end.
class Robot {
 public:
  virtual ~Robot() = default;
  virtual JointVector joints() = 0;
  virtual ExecutionResult execute(const Trajectory& trajectory) = 0;
  virtual GripResult grip(double gap_m, double force_n) = 0;
};

struct PickPlaceConfig {  // config/motion.yaml
  PlannerConfig planner;
  JointLimits limits;            // transfers
  double approach_height;        // m, TCP above the grasp before and after
  double approach_speed;         // m/s of the tool on the last stretch down
  double lift_speed;             // m/s of the tool on the way up with a part
  double grip_force;             // N
  double held_gap_min;           // m, a smaller gap after closing means nothing is held
  double release_margin;         // m, fingers open by this much beyond the object
  double release_height;         // m, finger tips above the tray floor when letting go
};
PickPlaceConfig load_pick_place_config(const std::string& config_dir);  // Throws Error.

enum class PickReason {  // values of PickPlace.action
  kSucceeded = 0,
  kUnknownGrasp = 1,
  kInfeasible = 2,
  kUnreachable = 3,
  kNoPlan = 4,
  kExecutionFailed = 5,
  kMissed = 6,
  kLost = 7
};

struct PickRequest {
  grasping::GraspPose grasp;
  Eigen::Vector3d centroid;  // of the object's visible surface, base_link
  int tray_slot;
};

struct PickResult {
  PickReason reason = PickReason::kSucceeded;
  std::string message;
  double planning_seconds = 0.0;  // wall
};

class PickAndPlace {
 public:
  PickAndPlace(const CellConfig& cell, const PickPlaceConfig& config);

  // Heights of what lies on the table, from the scene that the grasp belongs to.
  void set_heights(const grasping::HeightMap& heights);
  // `phase` is told each phase's name as it begins; returning false cancels before the next.
  PickResult run(Robot& robot, const PickRequest& request,
                 const std::function<bool(const std::string&)>& phase = {});
  // Brings the arm to the observing pose.
  PickResult observe(Robot& robot);

 private:
  CellConfig cell_;
  PickPlaceConfig config_;
  CollisionWorld world_;
};

}  // namespace iwgnet_grasp::motion
