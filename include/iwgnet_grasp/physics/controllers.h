// The drivers' controllers: what follow_joint_trajectory and the gripper action do on the robot.
#pragma once

#include <optional>
#include <string>

#include "iwgnet_grasp/motion/trajectory.h"
#include "iwgnet_grasp/physics/world.h"

namespace iwgnet_grasp::physics {

struct TrajectoryTolerances {
  JointVector path;         // rad, negative: not checked
  JointVector goal;         // rad
  double goal_time;         // s after the trajectory's end
  double stopped_velocity;  // rad/s
};
TrajectoryTolerances default_tolerances();  // Universal_Robots_ROS_Driver: 0.2, 0.1, 0.6, 0.05

// Values are the error codes of control_msgs/FollowJointTrajectoryResult.
enum class TrajectoryStatus {
  kIdle = 1,
  kActive = 2,
  kSucceeded = 0,
  kInvalidGoal = -1,
  kPathViolated = -4,
  kGoalViolated = -5
};

class TrajectoryController {
 public:
  explicit TrajectoryController(const JointVector& q);

  // Empty string when accepted, else why not (not finite, times not increasing, start too far off).
  std::string start(const motion::Trajectory& trajectory, const TrajectoryTolerances& tolerances,
                    double time, const ArmState& arm);
  void cancel(const ArmState& arm);  // holds the present position
  void reset(const JointVector& q);

  // Set point for the step that begins at `time`; updates the status.
  motion::TrajectoryPoint update(double time, const ArmState& arm);
  TrajectoryStatus status() const { return status_; }
  const std::string& message() const { return message_; }
  const motion::TrajectoryPoint& desired() const { return desired_; }

 private:
  motion::Trajectory trajectory_;
  TrajectoryTolerances tolerances_;
  TrajectoryStatus status_ = TrajectoryStatus::kIdle;
  motion::TrajectoryPoint desired_;
  double start_time_ = 0.0;
  double still_since_ = -1.0;  // s; since when the arm has been near still_q_ at the end
  JointVector still_q_ = JointVector::Zero();
  std::string message_;
};

struct GripperStatus {
  bool active = false;
  bool reached = false;  // commanded gap reached
  bool stalled = false;  // stopped by something before it
};

class GripperController {
 public:
  void start(double gap, double force, double time);
  GripperStatus update(World& world, double time);
  void reset();
  GripperStatus status() const { return status_; }
  double goal() const { return gap_; }
  double force() const { return force_; }

 private:
  double gap_ = 0.085, force_ = 40.0;
  double start_time_ = 0.0, still_since_ = -1.0, still_gap_ = 0.0;
  GripperStatus status_;
};

}  // namespace iwgnet_grasp::physics
