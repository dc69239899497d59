// One pick: approach, grasp, lift, transfer, release, back to observing.
//
// The motion is planned whole before the arm moves and executed as four trajectories: observing ->
// grasp, grasp -> over the tray slot, slowly down until the part meets something, tray slot ->
// observing. Where they go straight up or down the tool is slow; in between it passes corners
// without stopping.
#pragma once

#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/grasping/grasp_pose.h"
#include "iwgnet_grasp/grasping/push.h"
#include "iwgnet_grasp/motion/planner.h"

namespace iwgnet_grasp::motion {

struct ExecutionResult {
  bool success = false;
  std::string message;
  bool contact = false;  // of execute_until_contact(): stopped before the end
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
  // The same, but an arm that a joint of is held back by more than path_tolerance (rad) has met
  // something: it stops there, and that is a success.
  virtual ExecutionResult execute_until_contact(const Trajectory& trajectory,
                                                const JointVector& path_tolerance) = 0;
  virtual GripResult grip(double gap_m, double force_n) = 0;
  // Starts the gripper moving; a robot that can returns at once, so that the arm moves meanwhile.
  // Default: waits.
  virtual GripResult preset(double gap_m, double force_n) { return grip(gap_m, force_n); }
  // m between the pads now; NaN when the robot cannot tell, and closing again has to.
  virtual double gap() { return std::numeric_limits<double>::quiet_NaN(); }
};

struct PickPlaceConfig {  // config/motion.yaml
  PlannerConfig planner;
  JointLimits limits;             // free motion
  JointLimits carry;              // with a part in the gripper
  double carry_tool_acceleration; // m/s^2 along each axis
  double corner_deviation;        // rad, see PathLeg
  double approach_height;         // m, TCP above the grasp before and after
  double approach_speed;          // m/s of the tool on the last stretch down
  double lift_speed;              // m/s of the tool on the way up with a part
  double grip_force;              // N
  double held_gap_min;            // m, a smaller gap after closing means nothing is held
  double held_length, held_radius;  // m, capsule that stands for a held part
  double held_reach;              // m from a part's centroid to its far end, at most
  double max_hang;                // m, a part reaches no farther below the finger tips
  double release_margin;          // m, fingers open by this much beyond the object
  double release_height;          // m, part's lowest point above the tray floor when letting go
  double max_fall;                // m, by how much a part may reach less far down than was assumed
  double lower_speed;             // m/s of the tool where that may happen
  JointVector contact_tolerance;  // rad, joints held back by more have met something
  grasping::PushConfig push;
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

// The gripper opens before, closes between `approach` and `carry`, lets go before `retreat`.
struct PickPlan {
  Trajectory approach, carry, lower, retreat;
  JointPath up, home;  // what `retreat` goes along
};

class PickAndPlace {
 public:
  PickAndPlace(const CellConfig& cell, const PickPlaceConfig& config);

  // Heights of what lies on the table, from the scene that the grasp belongs to.
  void set_heights(const grasping::HeightMap& heights);
  // `phase` is told each phase's name as it begins; returning false cancels before the next.
  // Whatever happens, the arm ends at the observing pose if it can be brought there.
  PickResult run(Robot& robot, const PickRequest& request,
                 const std::function<bool(const std::string&)>& phase = {});
  // Pushes one of the objects (centroids of their visible surfaces, base_link, m) with the fingers,
  // as grasping::find_pushes() proposes, and brings the arm to the observing pose. Not in the
  // direction of a push since the last pick if another is possible: what clings together moves on
  // together.
  PickResult push(Robot& robot, const std::vector<Eigen::Vector3d>& objects);
  // Brings the arm to the observing pose.
  PickResult observe(Robot& robot);

  // The whole motion from `start` without moving anything: reason kSucceeded fills `plan`.
  PickResult plan_pick(const JointVector& start, const PickRequest& request, PickPlan& plan);

 private:
  // What the heights tell of the part that is grasped at the pose, as the gripper sees it from above: x
  // closes. It is laid into the tray by it.
  struct HeldPart {
    Eigen::Vector2d axis = Eigen::Vector2d::UnitY();   // the long one, unit
    Eigen::Vector2d offset = Eigen::Vector2d::Zero();  // m from the grasp to the part's centroid
    double hang = 0.0;        // m below the finger tips, at most: it lies on the table or higher
  };
  HeldPart held_part(const Pose& T_base_tcp, double width, const Eigen::Vector3d& centroid) const;
  JointVector start_of(Robot& robot) const;
  ExecutionResult move(Robot& robot, const Trajectory& trajectory, bool until_contact = false);
  // From `start` over and down to where a push begins, and the push. False when the arm cannot.
  bool plan_push(const JointVector& start, const grasping::Push& push, Trajectory& approach,
                 Trajectory& sweep, std::string& why);
  // The planned way home from where the part met something; empty when it collides.
  Trajectory retreat_from(const JointVector& q, const PickPlan& plan) const;
  // The fastest trajectory along the legs that is free of collision: corners are cut less where
  // cutting them collides. Empty when even stops at the corners collide; `why` says with what.
  Trajectory timed(std::vector<PathLeg> legs, std::string& why) const;
  // After a transfer that stopped on the way: back to the grasp the way it came, and open.
  void put_back(Robot& robot, const PickPlan& plan, double opening);

  CellConfig cell_;
  PickPlaceConfig config_;
  CollisionWorld world_;
  grasping::HeightMap heights_;
  std::optional<JointVector> commanded_;  // where the last trajectory ended
  std::vector<Eigen::Vector2d> pushed_;   // directions of the pushes since the last pick, unit
};

}  // namespace iwgnet_grasp::motion
