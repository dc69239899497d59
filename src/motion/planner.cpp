#include "iwgnet_grasp/motion/planner.h"

#include <ompl/base/MotionValidator.h>
#include <ompl/base/SpaceInformation.h>
#include <ompl/base/StateSampler.h>
#include <ompl/base/spaces/RealVectorStateSpace.h>
#include <ompl/geometric/PathGeometric.h>
#include <ompl/geometric/planners/rrt/RRTConnect.h>
#include <ompl/util/Console.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <random>

#include "iwgnet_grasp/kinematics/ur5.h"

namespace iwgnet_grasp::motion {
namespace {

namespace ob = ompl::base;
using Clock = std::chrono::steady_clock;

constexpr double kElbowLimit = M_PI;        // rad, ur_description limits the elbow for planning
constexpr double kJointLimit = 2 * M_PI;    // rad
constexpr double kDetour = 1.2;             // rad, how far a path may leave the range of its ends
constexpr double kRange = 0.8;              // rad, longest step of a tree
constexpr int kShortcuts = 120;             // attempts
constexpr int kAttempts = 4;              // at ever smaller steps
constexpr double kFineCheck = 8;          // times finer than the planner's resolution
constexpr double kJump = 0.35;              // rad a step: more is another arm configuration

double since(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

// The result with its end written into it; an empty message is success.
const PlanResult& ended(PlanResult& result, const std::string& message, Clock::time_point start) {
  result.success = message.empty();
  result.message = message;
  result.seconds = since(start);
  return result;
}

JointVector joints_of(const ob::State* state) {
  return Eigen::Map<const JointVector>(state->as<ob::RealVectorStateSpace::StateType>()->values);
}

// OMPL draws from one global generator; this one repeats with the planner's seed.
class SeededSampler : public ob::RealVectorStateSampler {
 public:
  SeededSampler(const ob::StateSpace* space, std::uint64_t seed)
      : ob::RealVectorStateSampler(space), random_(seed) {}

  void sampleUniform(ob::State* state) override {
    const auto& bounds = space_->as<ob::RealVectorStateSpace>()->getBounds();
    for (int i = 0; i < kJoints; ++i)
      state->as<ob::RealVectorStateSpace::StateType>()->values[i] =
          std::uniform_real_distribution<double>(bounds.low[i], bounds.high[i])(random_);
  }

 private:
  std::mt19937_64 random_;
};

class StraightMotion : public ob::MotionValidator {
 public:
  StraightMotion(const ob::SpaceInformationPtr& si, const CollisionWorld& world, double resolution)
      : ob::MotionValidator(si), world_(world), resolution_(resolution) {}

  bool checkMotion(const ob::State* a, const ob::State* b) const override {
    return straight_joint_motion_is_free(world_, joints_of(a), joints_of(b), resolution_);
  }
  bool checkMotion(const ob::State* a, const ob::State* b,
                   std::pair<ob::State*, double>& last_valid) const override {
    last_valid.second = 0.0;
    if (last_valid.first) si_->copyState(last_valid.first, a);
    return checkMotion(a, b);
  }

 private:
  const CollisionWorld& world_;
  const double resolution_;
};

double path_length(const JointPath& path) {
  double length = 0.0;
  for (std::size_t i = 1; i < path.size(); ++i) length += (path[i] - path[i - 1]).norm();
  return length;
}

// Replaces stretches between random points of the path by straight motions where these are free.
void shorten(JointPath& path, const CollisionWorld& world, const PlannerConfig& config) {
  std::mt19937_64 random(config.seed + 1);
  for (int attempt = 0; attempt < kShortcuts && path.size() > 2; ++attempt) {
    const double total = path_length(path);
    std::uniform_real_distribution<double> along(0.0, total);
    double a = along(random), b = along(random);
    if (attempt == 0) a = 0.0, b = total;
    if (a > b) std::swap(a, b);
    const auto locate = [&](double s, std::size_t& segment) {
      for (segment = 0; segment + 2 < path.size(); ++segment) {
        const double length = (path[segment + 1] - path[segment]).norm();
        if (s <= length) break;
        s -= length;
      }
      const JointVector d = path[segment + 1] - path[segment];
      return JointVector(path[segment] + d * std::min(1.0, s / d.norm()));
    };
    std::size_t first, last;
    const JointVector from = locate(a, first), to = locate(b, last);
    if (first == last || !straight_joint_motion_is_free(world, from, to, config.resolution)) continue;
    JointPath shorter(path.begin(), path.begin() + first + 1);
    for (const JointVector& q : {from, to})
      if ((q - shorter.back()).norm() > 1e-9) shorter.push_back(q);
    for (std::size_t i = last + 1; i < path.size(); ++i)
      if ((path[i] - shorter.back()).norm() > 1e-9) shorter.push_back(path[i]);
    path = std::move(shorter);
  }
}

// Empty when none was found in time.
JointPath rrt_connect(const CollisionWorld& world, const JointVector& from, const JointVector& to,
                      const PlannerConfig& config, Clock::time_point start) {
  ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
  auto space = std::make_shared<ob::RealVectorStateSpace>(kJoints);
  ob::RealVectorBounds bounds(kJoints);
  for (int i = 0; i < kJoints; ++i) {
    const double limit = i == 2 ? kElbowLimit : kJointLimit;
    bounds.setLow(i, std::max(-limit - 1e-6, std::min(from[i], to[i]) - kDetour));
    bounds.setHigh(i, std::min(limit + 1e-6, std::max(from[i], to[i]) + kDetour));
  }
  space->setBounds(bounds);
  space->setStateSamplerAllocator([&](const ob::StateSpace* s) {
    return std::make_shared<SeededSampler>(s, config.seed);
  });
  auto si = std::make_shared<ob::SpaceInformation>(space);
  si->setStateValidityChecker([&](const ob::State* s) { return !world.collides(joints_of(s)); });
  si->setMotionValidator(std::make_shared<StraightMotion>(si, world, config.resolution));
  si->setup();
  const auto state = [&](const JointVector& q) {
    ob::ScopedState<> s(space);
    for (int i = 0; i < kJoints; ++i) s[i] = q[i];
    return s;
  };
  auto problem = std::make_shared<ob::ProblemDefinition>(si);
  problem->setStartAndGoalStates(state(from), state(to));
  ompl::geometric::RRTConnect planner(si);
  planner.setRange(kRange);
  planner.setProblemDefinition(problem);
  planner.setup();
  // A condition of our own: solve(seconds) would start a timer thread.
  const ob::PlannerTerminationCondition timeout([&] { return since(start) > config.max_time; });
  if (planner.solve(timeout) != ob::PlannerStatus::EXACT_SOLUTION) return {};
  JointPath path;
  for (ob::State* s : problem->getSolutionPath()->as<ompl::geometric::PathGeometric>()->getStates())
    path.push_back(joints_of(s));
  return path;
}

std::string degrees(const JointVector& q) {
  std::string text;
  for (int i = 0; i < kJoints; ++i)
    text += (i ? " " : "") + std::to_string(static_cast<int>(std::lround(q[i] * 180 / M_PI)));
  return text;
}

}  // namespace

bool straight_joint_motion_is_free(const CollisionWorld& world, const JointVector& from,
                                   const JointVector& to, double resolution) {
  if (world.collides(from) || world.collides(to)) return false;
  const JointVector delta = to - from;
  const int steps = static_cast<int>(std::ceil(delta.cwiseAbs().maxCoeff() / resolution));
  // Coarse to fine: the middle of a motion meets obstacles first.
  int stride = 1;
  while (stride < steps) stride *= 2;
  for (stride /= 2; stride >= 1; stride /= 2)
    for (int i = stride; i < steps; i += 2 * stride)
      if (world.collides(from + delta * i / steps)) return false;
  return true;
}

PlanResult plan(const CollisionWorld& world, const JointVector& from, const JointVector& to,
                const PlannerConfig& config) {
  const auto start = Clock::now();
  PlanResult result;
  const auto finish = [&](const std::string& message) { return ended(result, message, start); };
  if (!from.allFinite() || !to.allFinite()) return finish("a joint angle is not finite");
  for (const auto& [q, name] : {std::pair{from, "start"}, std::pair{to, "goal"}}) {
    if (world.collides(q))
      return finish(std::string("the ") + name + " (" + degrees(q) + " deg) collides: " + world.describe(q));
    for (int i = 0; i < kJoints; ++i)
      if (std::abs(q[i]) > (i == 2 ? kElbowLimit : kJointLimit) + 1e-6)
        return finish(std::string("the ") + name + " lies outside the limits of " + kJointNames[i]);
  }
  if (straight_joint_motion_is_free(world, from, to, config.resolution / kFineCheck)) {
    result.path = {from, to};
    return finish("");
  }

  // The tree may pass an edge between two checks: what the fine check refuses is planned again with
  // smaller steps.
  PlannerConfig finer = config;
  for (int attempt = 0; attempt < kAttempts; ++attempt, finer.resolution /= 2, ++finer.seed) {
    result.path = rrt_connect(world, from, to, finer, start);
    if (result.path.empty())
      return finish("no path found within " + std::to_string(config.max_time) + " s from " +
                    degrees(from) + " to " + degrees(to) + " deg");
    shorten(result.path, world, finer);
    bool free = true;
    for (std::size_t i = 1; free && i < result.path.size(); ++i)
      free = straight_joint_motion_is_free(world, result.path[i - 1], result.path[i],
                                           config.resolution / kFineCheck);
    if (free) return finish("");
  }
  result.path.clear();
  return finish("every path found passes too close to an obstacle");
}

PlanResult plan_straight(const CollisionWorld& world, const JointVector& from, const Pose& T_base_tool0,
                         bool check, double step_m, double tolerance_m) {
  const auto start = Clock::now();
  PlanResult result;
  const auto finish = [&](const std::string& message) { return ended(result, message, start); };
  if (!from.allFinite() || !T_base_tool0.matrix().allFinite())
    return finish("the straight motion's start or goal is not finite");
  const Pose T_start = kinematics::forward(from);
  const Eigen::Vector3d travel = T_base_tool0.translation() - T_start.translation();
  const Eigen::Quaterniond q_start(T_start.linear()), q_goal(T_base_tool0.linear());
  const double turn = q_start.angularDistance(q_goal);
  const int steps = std::max(1, static_cast<int>(std::ceil(std::max(travel.norm() / step_m, turn / 0.05))));

  JointPath fine{from};
  for (int i = 1; i <= steps; ++i) {
    const double t = static_cast<double>(i) / steps;
    Pose T = Pose::Identity();
    T.linear() = q_start.slerp(t, q_goal).toRotationMatrix();
    T.translation() = T_start.translation() + t * travel;
    const auto solutions = kinematics::inverse(T, fine.back()[5]);
    const JointVector* nearest = nullptr;
    JointVector best, candidate;
    for (int k = 0; k < solutions.count; ++k) {
      candidate = kinematics::nearest_turn(solutions.q[k], fine.back());
      if (nearest && (candidate - fine.back()).cwiseAbs().maxCoeff() >= (best - fine.back()).cwiseAbs().maxCoeff())
        continue;
      best = candidate;
      nearest = &best;
    }
    const auto where = [&] {
      return std::to_string(std::lround(t * travel.norm() * 1000)) + " mm along the straight motion";
    };
    if (!nearest) return finish("out of reach " + where());
    if ((best - fine.back()).cwiseAbs().maxCoeff() > kJump)
      return finish("a singularity " + where() + " would turn the arm over");
    if (check && world.collides(best)) return finish("collision " + where() + ": " + world.describe(best));
    fine.push_back(best);
  }

  // From each waypoint to the farthest next one that keeps the tool on the line between them.
  const Eigen::Vector3d direction = travel.norm() > 0 ? Eigen::Vector3d(travel.normalized()) : Eigen::Vector3d::UnitZ();
  const auto on_line = [&](const JointVector& a, const JointVector& b) {
    for (const double t : {0.25, 0.5, 0.75}) {
      const Eigen::Vector3d p = kinematics::forward(a + t * (b - a)).translation() - T_start.translation();
      if ((p - direction.dot(p) * direction).norm() > tolerance_m) return false;
    }
    return true;
  };
  result.path = {from};
  for (std::size_t at = 0; at + 1 < fine.size();) {
    std::size_t next = fine.size() - 1;
    while (next > at + 1 && !on_line(fine[at], fine[next])) --next;
    result.path.push_back(fine[next]);
    at = next;
  }
  return finish("");
}

}  // namespace iwgnet_grasp::motion
