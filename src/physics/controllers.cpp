#include "iwgnet_grasp/physics/controllers.h"

#include <cmath>
#include <limits>
#include <sstream>

namespace iwgnet_grasp::physics {
namespace {

constexpr double kGapTolerance = 0.001;  // m, commanded gap reached
constexpr double kStillSpeed = 0.002;    // m/s of the gap
constexpr double kStallTime = 0.10;      // s still before the goal: stalled
constexpr double kStartTime = 0.10;      // s after the command before a stall is looked for
constexpr double kRestTime = 0.05;       // s that an arm goes nowhere: at rest, though it trembles

std::string joint_error(int joint, double error, double tolerance) {
  std::ostringstream text;
  text.precision(3);
  text << kJointNames[joint] << " is off by " << error << " rad (tolerance " << tolerance << ")";
  return text.str();
}

// Joint that exceeds its tolerance most, -1 when none does; negative tolerances are not checked.
int worst_joint(const JointVector& error, const JointVector& tolerance) {
  int worst = -1;
  double ratio = 1.0;
  for (int j = 0; j < kJoints; ++j) {
    if (tolerance[j] < 0) continue;
    const double r = std::abs(error[j]) / std::max(tolerance[j], 1e-9);
    if (r > ratio) {
      ratio = r;
      worst = j;
    }
  }
  return worst;
}

motion::TrajectoryPoint rest_at(const JointVector& q) {
  return {0.0, q, JointVector::Zero(), JointVector::Zero()};
}

}  // namespace

TrajectoryTolerances default_tolerances() {
  return {JointVector::Constant(0.2), JointVector::Constant(0.1), 0.6, 0.05};
}

TrajectoryController::TrajectoryController(const JointVector& q) { reset(q); }

void TrajectoryController::reset(const JointVector& q) {
  trajectory_.clear();
  tolerances_ = default_tolerances();
  status_ = TrajectoryStatus::kIdle;
  desired_ = rest_at(q);
  message_.clear();
}

void TrajectoryController::cancel(const ArmState& arm) {
  trajectory_.clear();
  desired_ = rest_at(arm.q);
  status_ = TrajectoryStatus::kIdle;
  message_ = "cancelled";
}

std::string TrajectoryController::start(const motion::Trajectory& trajectory,
                                        const TrajectoryTolerances& tolerances, double time,
                                        const ArmState& arm) {
  if (trajectory.empty()) return "trajectory has no points";
  double before = -1.0;
  for (std::size_t i = 0; i < trajectory.size(); ++i) {
    const auto& p = trajectory[i];
    const std::string where = "trajectory point " + std::to_string(i);
    if (!std::isfinite(p.time) || !p.q.allFinite() || !p.qd.allFinite() || !p.qdd.allFinite())
      return where + " is not finite";
    if (p.time < 0 || p.time <= before) return where + " has a time that does not increase";
    before = p.time;
  }
  motion::Trajectory accepted = trajectory;
  if (accepted.front().time > 0) {
    // As the driver does: a first point in the future is reached from the present set point.
    motion::TrajectoryPoint now = rest_at(arm.q);
    now.qd = arm.qd;
    accepted.insert(accepted.begin(), now);
  } else {
    // Not the goal's tolerances, which may be those of a contact.
    const JointVector away = accepted.front().q - arm.q, limit = default_tolerances().path;
    if (const int j = worst_joint(away, limit); j >= 0)
      return "trajectory starts too far from the arm: " + joint_error(j, away[j], limit[j]);
  }
  trajectory_ = std::move(accepted);
  tolerances_ = tolerances;
  start_time_ = time;
  still_since_ = -1.0;
  status_ = TrajectoryStatus::kActive;
  message_.clear();
  return "";
}

motion::TrajectoryPoint TrajectoryController::update(double time, const ArmState& arm) {
  if (status_ != TrajectoryStatus::kActive) return desired_;
  const double t = time - start_time_, end = trajectory_.back().time;
  // The arm has been driven to the previous set point by now.
  const JointVector path_error = desired_.q - arm.q;
  const bool under_way = t > 0;
  desired_ = motion::sample(trajectory_, t);
  if (t >= end) desired_ = rest_at(trajectory_.back().q);
  desired_.time = t;
  if (under_way && t < end) {
    if (const int j = worst_joint(path_error, tolerances_.path); j >= 0) {
      status_ = TrajectoryStatus::kPathViolated;
      message_ = "path tolerance violated: " + joint_error(j, path_error[j], tolerances_.path[j]);
      trajectory_.clear();
      desired_ = rest_at(arm.q);
      return desired_;
    }
  }
  if (t >= end) {
    const JointVector error = desired_.q - arm.q;
    const int j = worst_joint(error, tolerances_.goal);
    const double slow = tolerances_.stopped_velocity;
    if (still_since_ < 0 || (arm.q - still_q_).cwiseAbs().maxCoeff() > slow * kRestTime) {
      still_since_ = time;
      still_q_ = arm.q;
    }
    // An elastic grip makes the wrist tremble: its speed then says nothing, its way does.
    const bool stopped = arm.qd.cwiseAbs().maxCoeff() <= slow || time - still_since_ >= kRestTime;
    if (j < 0 && stopped) {
      status_ = TrajectoryStatus::kSucceeded;
    } else if (tolerances_.goal_time > 0 && t > end + tolerances_.goal_time) {
      status_ = TrajectoryStatus::kGoalViolated;
      message_ = j >= 0 ? "goal tolerance violated: " + joint_error(j, error[j], tolerances_.goal[j])
                        : "goal tolerance violated: the arm does not come to rest";
      desired_ = rest_at(arm.q);
    }
  }
  return desired_;
}

void GripperController::start(double gap, double force, double time) {
  gap_ = gap;
  force_ = force;
  start_time_ = time;
  still_since_ = -1.0;
  status_ = {true, false, false};
}

void GripperController::reset() { *this = GripperController(); }

GripperStatus GripperController::update(World& world, double time) {
  // World limits speed, force and gap to what the gripper can do.
  world.set_gripper_setpoint(gap_, std::numeric_limits<double>::infinity(), force_);
  if (!status_.active) return status_;
  const GripperState state = world.gripper();
  const bool still = std::abs(state.speed) < kStillSpeed;
  // By the way of the gap, not its speed, which trembles on an elastic grip.
  if (still_since_ < 0 || std::abs(state.gap - still_gap_) > kStillSpeed * kStallTime) {
    still_since_ = time;
    still_gap_ = state.gap;
  }
  const bool settled = time - still_since_ >= kStallTime;
  if (std::abs(state.gap - gap_) < kGapTolerance && still) {
    status_ = {false, true, false};
  } else if (settled && time - start_time_ >= kStartTime + kStallTime) {
    // At its end stop the gripper has done what it can: a goal beyond it counts as reached.
    const bool reached = std::abs(state.gap - world.reachable_gap(gap_)) < kGapTolerance;
    status_ = {false, reached, !reached};
  }
  return status_;
}

}  // namespace iwgnet_grasp::physics
