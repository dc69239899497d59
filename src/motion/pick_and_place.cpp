#include "iwgnet_grasp/motion/pick_and_place.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <iterator>
#include <limits>
#include <sstream>

#include "iwgnet_grasp/core/yaml.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"

namespace iwgnet_grasp::motion {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kSamePlace = 0.03;      // rad: a measured arm this near is where it was sent
constexpr double kAtRest = 0.005;        // rad: near enough to the observing pose to stay
constexpr double kWallClearance = 0.02;  // m, a carried part over the tray's wall
constexpr double kPileClearance = 0.015; // m, the lowest point of a carried part over the pile
constexpr double kHigherLift = 0.05;     // m over approach_height, at most
constexpr double kFarthestCentroid = 0.04;  // m from the grasp point: farther out nothing is gripped
constexpr double kBeside = 0.020;        // m beside the closing line's middle: what is gripped across lies nearer
constexpr double kFarthestFromRim = 0.070;  // m, likewise where a rim is gripped
constexpr double kUpperSide = 0.012;     // m, a part's upper side is not more uneven
constexpr double kSteepest = 0.7;        // slope, 35 deg: steeper parts cannot be held by a gripper pointing down
constexpr int kReached = 4;              // configurations kept for a pose, nearest first
constexpr double kLengthwise = 0.035;    // m between the pads: a part held by less is not held lengthwise
constexpr double kSameDirection = 0.6;   // cosine, 53 deg: a push's, or the opposite one
constexpr int kCombinations = 8;         // of grasp and slot configurations to plan for, best first

double seconds_since(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

// Least time for a motion at rest on both ends.
double duration(const JointVector& from, const JointVector& to, const JointLimits& limits) {
  double longest = 0.0;
  for (int i = 0; i < kJoints; ++i) {
    const double d = std::abs(to[i] - from[i]), v = limits.max_velocity[i], a = limits.max_acceleration[i];
    longest = std::max(longest, d < v * v / a ? 2 * std::sqrt(d / a) : d / v + v / a);
  }
  return longest;
}

JointPath reversed(JointPath path) {
  std::reverse(path.begin(), path.end());
  return path;
}

// Back along the approach.
Pose raised(Pose T, double distance) {
  T.translation() -= distance * T.linear().col(2);
  return T;
}

// About the approach axis by pi: the same grasp with the fingers exchanged.
Pose half_turn(const Pose& T_base_tcp) {
  Pose T = T_base_tcp;
  T.linear().leftCols<2>() *= -1.0;
  return T;
}

double height_of(const JointVector& q) { return kinematics::forward(q).translation().z(); }

// A straight path upwards, cut `distance` over its start; both parts have the point of the cut.
std::pair<JointPath, JointPath> split(const JointPath& up, double distance) {
  const double level = height_of(up.front()) + distance;
  auto next = up.begin() + 1;
  while (next + 1 != up.end() && height_of(*next) < level) ++next;
  const JointVector &a = *(next - 1), &b = *next;
  const double share = (level - height_of(a)) / (height_of(b) - height_of(a));
  const JointVector cut = a + std::clamp(share, 0.0, 1.0) * (b - a);
  JointPath lower(up.begin(), next), above(next, up.end());
  lower.push_back(cut);
  above.insert(above.begin(), cut);
  return {lower, above};
}

std::string millimetres(const Eigen::Vector3d& p) {
  std::ostringstream text;
  text << "(" << std::lround(p.x() * 1e3) << ", " << std::lround(p.y() * 1e3) << ", "
       << std::lround(p.z() * 1e3) << ") mm";
  return text.str();
}

std::string in_mm(double metres) { return std::to_string(std::lround(metres * 1e3)) + " mm"; }

// A pose over the table or the tray with its straight way up.
struct Reached {
  JointVector low, high;
  JointPath up;  // low -> high
  int turn;      // index of the pose
};

// The configurations nearest to `near` (at most kReached) that reach one of the TCP poses and rise
// from it free of collision in `world`. When there is none, `why` is the reason of the nearest.
std::vector<Reached> reach(const CollisionWorld& world, const std::array<Pose, 2>& T_base_tcp,
                           double gap, double height, const JointVector& near,
                           const JointLimits& limits, std::string& why) {
  struct Configuration {
    JointVector q;
    int turn;
    double cost;
  };
  std::array<Pose, 2> T_base_tool0;
  std::vector<Configuration> configurations;
  for (int turn = 0; turn < 2; ++turn) {
    T_base_tool0[turn] = T_base_tcp[turn] * kinematics::T_tool0_tcp(gap).inverse();
    const auto solutions = kinematics::inverse(T_base_tool0[turn], near[5]);
    for (int i = 0; i < solutions.count; ++i) {
      const JointVector q = kinematics::nearest_turn(solutions.q[i], near);
      configurations.push_back({q, turn, duration(near, q, limits)});
    }
  }
  std::sort(configurations.begin(), configurations.end(),
            [](const auto& a, const auto& b) { return a.cost < b.cost; });

  std::vector<Reached> found;
  std::string nearest_failure;
  for (const Configuration& c : configurations) {
    if (static_cast<int>(found.size()) == kReached) break;
    std::string failure;
    if (world.collides(c.q)) {
      failure = "the arm would touch: " + world.describe(c.q);
    } else {
      PlanResult up = plan_straight(world, c.q, raised(T_base_tool0[c.turn], height), true);
      if (up.success)
        found.push_back({c.q, up.path.back(), up.path, c.turn});
      else
        failure = up.message;
    }
    if (nearest_failure.empty()) nearest_failure = failure;
  }
  if (found.empty()) why = configurations.empty() ? "out of the arm's reach" : nearest_failure;
  return found;
}

}  // namespace

PickPlaceConfig load_pick_place_config(const std::string& config_dir) {
  const YamlFile file(config_dir + "/motion.yaml");
  PickPlaceConfig config;
  const auto positive = [&](const std::string& key) {
    const double value = file.get<double>(key);
    if (!(value > 0)) file.fail(key, "must be positive");
    return value;
  };
  const auto limits = [&](const std::string& key) {
    JointLimits result;
    result.max_velocity = file.vector(key + ".max_velocity", kJoints);
    result.max_acceleration = file.vector(key + ".max_acceleration", kJoints);
    if (!(result.max_velocity.minCoeff() > 0) || !(result.max_acceleration.minCoeff() > 0))
      file.fail(key, "needs positive velocities and accelerations");
    return result;
  };
  config.planner.max_time = positive("planner.max_time");
  config.planner.resolution = positive("planner.resolution");
  config.planner.seed = file.get<std::uint64_t>("planner.seed");
  config.limits = limits("limits");
  config.carry = limits("carry");
  config.carry_tool_acceleration = positive("carry.tool_acceleration");
  config.corner_deviation = file.get<double>("corner_deviation");
  if (!(config.corner_deviation >= 0)) file.fail("corner_deviation", "must not be negative");
  config.approach_height = positive("approach_height");
  config.approach_speed = positive("approach_speed");
  config.lift_speed = positive("lift_speed");
  config.grip_force = positive("grip_force");
  config.held_gap_min = positive("held_gap_min");
  config.held_length = positive("held_part.length");
  config.held_radius = positive("held_part.radius");
  config.held_reach = positive("held_part.reach");
  config.release_margin = positive("release_margin");
  config.release_height = positive("release_height");
  config.max_hang = positive("held_part.max_hang");
  config.max_fall = positive("max_fall");
  config.lower_speed = positive("lower_speed");
  config.contact_tolerance = file.vector("contact_tolerance", kJoints);
  if (!(config.contact_tolerance.minCoeff() > 0)) file.fail("contact_tolerance", "must be positive");
  config.push.gap = positive("push.gap");
  const auto& heights = config.push.tip_heights = file.get<std::vector<double>>("push.tip_heights");
  if (heights.empty() || !std::is_sorted(heights.rbegin(), heights.rend()) || !(heights.back() > 0))
    file.fail("push.tip_heights", "needs heights above 0, the highest first");
  config.push.overlap = positive("push.overlap");
  config.push.clearance = positive("push.clearance");
  config.push.run_up = positive("push.run_up");
  config.push.distance = positive("push.distance");
  config.push.min_distance = positive("push.min_distance");
  config.push.margin = positive("push.margin");
  config.push.speed = positive("push.speed");
  if (config.push.gap < config.held_gap_min)
    file.fail("push.gap", "must not be below held_gap_min: pushing is not gripping");
  return config;
}

PickAndPlace::PickAndPlace(const CellConfig& cell, const PickPlaceConfig& config)
    : cell_(cell), config_(config), world_(cell) {}

void PickAndPlace::set_heights(const grasping::HeightMap& heights) {
  heights_ = heights;
  world_.set_heights(heights);
}

PickAndPlace::HeldPart PickAndPlace::held_part(const Pose& T_base_tcp, double width,
                                               const Eigen::Vector3d& centroid) const {
  HeldPart held;
  // Seen by the gripper, which will point straight down over the tray: x closes, z is up.
  Pose T_base_view = T_base_tcp;
  T_base_view.linear().rightCols<2>() *= -1.0;
  const grasping::HeightMap heights = heights_.seen_from(T_base_view, Eigen::Vector2d::Constant(config_.held_reach));
  const double tip = -kinematics::kPadHeight / 2;
  const double surface = heights.max_in({0, 0}, 0.0, {0.006, 0.006});

  const grasping::Slope slope =
      grasping::surface_slope(heights, {0, 0}, {1, 0}, surface, width, kSteepest, kSteepest);

  // The pads stand at the part's sides: along the closing direction it is as long as the gap and
  // centred. Across it, it goes on at least as long as its upper side does.
  const auto profile = [&](double y) {
    double highest = -1.0;
    for (double x = -width / 2; x <= width / 2; x += heights.resolution())
      highest = std::max(highest, heights.at(x, y) - slope.along * x - slope.across * y);
    return highest;
  };
  double ends[2];
  for (const int side : {0, 1}) {
    double y = 0.0;
    while (y < config_.held_reach && profile(side ? y : -y) > surface - kUpperSide) y += heights.resolution();
    ends[side] = y;
  }
  const double length = ends[0] + ends[1];
  const Eigen::Vector2d center = (T_base_view.inverse() * centroid).head<2>();
  if (width > kLengthwise && length < width) {
    held.axis = Eigen::Vector2d::UnitX();
  } else if (width <= kLengthwise && std::abs(center.x()) > std::max(kBeside, std::abs(center.y()))) {
    // A rim between the pads: the rest of the part lies beside them, not between.
    held.axis = center.normalized();
    held.offset = held.axis * std::min(center.norm(), kFarthestFromRim);
  } else {
    held.offset.y() = std::clamp(center.y(), -kFarthestCentroid, kFarthestCentroid);
  }
  // How far it reaches down cannot be seen from above, only that it ends at the table. Turned upright
  // over the tray it hangs lower by what the gripper leans now.
  const Eigen::Vector3d tips = T_base_view * Eigen::Vector3d(0, 0, tip);
  const double tilt = std::abs(T_base_view.linear().row(2).head<2>().dot(held.axis));
  const double table = (tips.z() + config_.held_reach * tilt) / T_base_view.linear()(2, 2);
  held.hang = std::clamp(table, 0.0, config_.max_hang);
  return held;
}

Trajectory PickAndPlace::timed(std::vector<PathLeg> legs, std::string& why) const {
  for (const double share : {1.0, 0.5, 0.2, 0.0}) {
    for (PathLeg& leg : legs) leg.deviation = share * config_.corner_deviation;
    Trajectory trajectory = time_parametrize(legs);
    const auto contact = std::find_if(trajectory.begin(), trajectory.end(),
                                      [&](const TrajectoryPoint& p) { return world_.collides(p.q); });
    if (contact == trajectory.end()) return trajectory;
    why = world_.describe(contact->q);
  }
  return {};
}

PickResult PickAndPlace::plan_pick(const JointVector& start, const PickRequest& request, PickPlan& plan) {
  const auto began = Clock::now();
  const auto finish = [&](PickReason reason, const std::string& message) {
    return PickResult{reason, message, seconds_since(began)};
  };
  const grasping::GraspPose& grasp = request.grasp;
  if (!grasp.feasible) return finish(PickReason::kInfeasible, "infeasible grasp: " + grasp.reason);
  const bool finite = grasp.T_base_tcp.matrix().allFinite() && request.centroid.allFinite() &&
                      std::isfinite(grasp.width) && std::isfinite(grasp.opening);
  if (!finite) return finish(PickReason::kInfeasible, "infeasible grasp: its pose is not finite");
  if (grasp.width < 0 || grasp.opening > kinematics::max_gap() + 1e-3 || grasp.opening < grasp.width)
    return finish(PickReason::kInfeasible, "infeasible grasp: width and opening do not fit the 2F-85");
  const auto slots = cell_.tray.slots();
  if (request.tray_slot < 0 || request.tray_slot >= static_cast<int>(slots.size()))
    return finish(PickReason::kInfeasible, "the tray has no slot " + std::to_string(request.tray_slot) +
                                               ": it has " + std::to_string(slots.size()));

  const Eigen::Vector3d at = grasp.T_base_tcp.translation();
  const Column grasp_column(grasp.T_base_tcp);
  const double released = std::min(grasp.width + config_.release_margin, kinematics::max_gap());

  // Grasp.
  std::string why;
  world_.set_attached(std::nullopt);
  world_.set_gripper_gap(grasp.opening);
  world_.set_columns({grasp_column});
  // What a part hides below it may reach down to the table: all of it goes over all others.
  const double lift = std::clamp(heights_.highest() + kPileClearance, config_.approach_height,
                                 config_.approach_height + kHigherLift);
  const auto grasps = reach(world_, {grasp.T_base_tcp, half_turn(grasp.T_base_tcp)}, grasp.width,
                            lift, start, config_.limits, why);
  if (grasps.empty())
    return finish(PickReason::kUnreachable, "grasp at " + millimetres(at) + ": " + why);

  // Slot: the part's long axis along y, its centroid over the slot's centre. The fingers close across
  // the long axis, unless they hold the part by its end along it or by the rim of a hole.
  const HeldPart seen = held_part(grasp.T_base_tcp, grasp.width, request.centroid);
  // In the TCP frame, whose y axis is the view's turned round.
  const Eigen::Vector3d offset(seen.offset.x(), -seen.offset.y(), 0.0);
  const Eigen::Vector3d axis(seen.axis.x(), -seen.axis.y(), 0.0);
  // By how much the closing direction is turned from the slot's x for the axis to lie along its y.
  const double turn = std::remainder(M_PI / 2 - std::atan2(axis.y(), axis.x()), M_PI);
  // A part that reaches less far below the tips falls the rest; on the way down from where it may
  // touch, the tool is slow.
  const double last = std::min(seen.hang, config_.max_fall);
  const double slow = seen.hang - last;
  const double rise = slow + std::max(config_.approach_height, cell_.tray.wall_height + kWallClearance);
  const Eigen::Vector3d slot = slots[request.tray_slot];
  const double inwards = cell_.tray.center.x() < slot.x() ? -1.0 : 1.0;
  const auto slot_poses = [&](int grasp_turn, double shift) {
    Pose T = Pose::Identity();
    T.linear() = Eigen::Vector3d(1, -1, -1).asDiagonal();
    T.rotate(Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()));
    std::array<Pose, 2> poses{T, half_turn(T)};
    for (Pose& pose : poses) {
      const Eigen::Vector3d centroid = grasp_turn == 0 ? offset : Eigen::Vector3d(-offset);
      pose.translation() = slot - pose.linear() * centroid;
      pose.translation().x() += inwards * shift;
      pose.translation().z() =
          cell_.tray.floor_height + config_.release_height + last + kinematics::kPadHeight / 2;
    }
    return poses;
  };

  struct Combination {
    const Reached* grasp;
    Reached slot;
    Column slot_column;
    double cost;
  };
  std::vector<Combination> combinations;
  world_.set_gripper_gap(released);
  // Fingers far apart may not fit beside the wall: then somewhat inwards.
  for (const double shift : {0.0, 0.01, 0.02}) {
    for (const Reached& g : grasps) {
      const auto poses = slot_poses(g.turn, shift);
      world_.set_columns({Column(poses[0]), Column(poses[1])});
      for (const Reached& s : reach(world_, poses, grasp.width, rise, g.high, config_.carry, why)) {
        const double cost = duration(start, g.high, config_.limits) +
                            duration(g.high, s.high, config_.carry) +
                            duration(s.high, cell_.observe_joints, config_.limits);
        combinations.push_back({&g, s, Column(poses[s.turn]), cost});
      }
    }
    if (!combinations.empty()) break;
  }
  if (combinations.empty())
    return finish(PickReason::kUnreachable,
                  "tray slot " + std::to_string(request.tray_slot) + ": " + why);
  std::sort(combinations.begin(), combinations.end(),
            [](const auto& a, const auto& b) { return a.cost < b.cost; });

  AttachedPart part;
  const double half_length = std::max(0.0, config_.held_length / 2 - config_.held_radius);
  part.a = offset - half_length * axis;
  part.b = offset + half_length * axis;
  part.radius = config_.held_radius;

  const int tries = std::min<int>(kCombinations, static_cast<int>(combinations.size()));
  for (int i = 0; i < tries; ++i) {
    const Reached &g = *combinations[i].grasp, &s = combinations[i].slot;
    const Column slot_column = combinations[i].slot_column;
    const auto leg = [&](const JointPath& path, const JointLimits& limits) {
      PathLeg result;
      result.path = path;
      result.limits = limits;
      result.deviation = config_.corner_deviation;
      return result;
    };
    const auto carried = [&](const JointPath& path, double speed) {
      PathLeg result = leg(path, config_.carry);
      result.max_tool_acceleration = config_.carry_tool_acceleration;
      result.max_tool_speed = speed;
      return result;
    };

    world_.set_attached(std::nullopt);
    world_.set_gripper_gap(grasp.opening);
    world_.set_columns({grasp_column});
    const PlanResult to_grasp = motion::plan(world_, start, g.high, config_.planner);
    if (!to_grasp.success) {
      why = "way to the grasp: " + to_grasp.message;
      continue;
    }
    PathLeg down = leg(reversed(g.up), config_.limits);
    down.max_tool_speed = config_.approach_speed;
    plan.approach = timed({leg(to_grasp.path, config_.limits), down}, why);
    if (plan.approach.empty()) continue;

    world_.set_gripper_gap(grasp.width);
    AttachedPart held = part;  // in the TCP frame of this wrist turn
    if (g.turn == 1) {
      held.a.head<2>() *= -1.0;
      held.b.head<2>() *= -1.0;
    }
    world_.set_attached(held);
    world_.set_columns({grasp_column, slot_column});
    const PlanResult to_slot = motion::plan(world_, g.high, s.high, config_.planner);
    if (!to_slot.success) {
      why = "way to the tray: " + to_slot.message;
      continue;
    }
    const double unlimited = std::numeric_limits<double>::infinity();
    const auto [lower, above] = split(s.up, slow);
    plan.carry = timed({carried(g.up, config_.lift_speed), carried(to_slot.path, unlimited),
                        carried(reversed(above), config_.approach_speed)}, why);
    if (plan.carry.empty()) continue;
    plan.lower.clear();
    if (slow > 0) {
      plan.lower = timed({carried(reversed(lower), config_.lower_speed)}, why);
      if (plan.lower.empty()) continue;
    }

    world_.set_attached(std::nullopt);
    world_.set_gripper_gap(released);
    world_.set_columns({slot_column});
    const PlanResult home = motion::plan(world_, s.high, cell_.observe_joints, config_.planner);
    if (!home.success) {
      why = "way back: " + home.message;
      continue;
    }
    plan.up = s.up;
    plan.home = home.path;
    plan.retreat = timed({leg(plan.up, config_.limits), leg(plan.home, config_.limits)}, why);
    if (plan.retreat.empty()) continue;
    return finish(PickReason::kSucceeded, "");
  }
  return finish(PickReason::kNoPlan, "grasp at " + millimetres(at) + ": " + why);
}

JointVector PickAndPlace::start_of(Robot& robot) const {
  const JointVector q = robot.joints();
  if (!q.allFinite()) throw Error("the robot reports joint angles that are not finite");
  // Where the arm was sent to, so that its servo error does not become part of the next path.
  for (const auto& there : {commanded_, std::optional<JointVector>(cell_.observe_joints)})
    if (there && (q - *there).cwiseAbs().maxCoeff() < kSamePlace) return *there;
  return q;
}

ExecutionResult PickAndPlace::move(Robot& robot, const Trajectory& trajectory, bool until_contact) {
  const ExecutionResult result =
      until_contact ? robot.execute_until_contact(trajectory, config_.contact_tolerance)
                    : robot.execute(trajectory);
  commanded_.reset();
  if (result.success && !result.contact) commanded_ = trajectory.back().q;
  return result;
}

Trajectory PickAndPlace::retreat_from(const JointVector& q, const PickPlan& plan) const {
  PathLeg up, home;
  up.path = {q};
  std::copy_if(plan.up.begin(), plan.up.end(), std::back_inserter(up.path),
               [&](const JointVector& p) { return height_of(p) > height_of(q); });
  home.path = plan.home;
  up.limits = home.limits = config_.limits;
  std::string why;
  return timed({up, home}, why);
}

bool PickAndPlace::plan_push(const JointVector& start, const grasping::Push& push,
                             Trajectory& approach, Trajectory& sweep, std::string& why) {
  const Eigen::Vector2d way = push.to - push.from;
  Pose T = Pose::Identity();  // closes along the way: so nothing comes between the pads
  T.linear().col(2) = -Eigen::Vector3d::UnitZ();
  T.linear().col(0) << way.normalized(), 0.0;
  T.linear().col(1) = T.linear().col(2).cross(T.linear().col(0));
  T.translation() << push.from, push.tip_height + kinematics::kPadHeight / 2;
  world_.set_attached(std::nullopt);
  world_.set_gripper_gap(config_.push.gap);
  world_.set_columns({Column(T)});
  for (const Reached& r : reach(world_, {T, half_turn(T)}, config_.push.gap, config_.approach_height,
                                start, config_.limits, why)) {
    const PlanResult there = motion::plan(world_, start, r.high, config_.planner);
    if (!there.success) {
      why = there.message;
      continue;
    }
    PathLeg over, down, along;
    over.path = there.path;
    down.path = reversed(r.up);
    over.limits = down.limits = along.limits = config_.limits;
    down.max_tool_speed = config_.approach_speed;
    approach = timed({over, down}, why);
    if (approach.empty()) continue;
    Pose end = kinematics::forward(r.low);
    end.translation().head<2>() += way;
    const PlanResult straight = plan_straight(world_, r.low, end, false);
    if (!straight.success) {
      why = straight.message;
      continue;
    }
    along.path = straight.path;
    along.max_tool_speed = config_.push.speed;
    along.deviation = 0.0;
    sweep = time_parametrize({along});
    return true;
  }
  return false;
}

PickResult PickAndPlace::push(Robot& robot, const std::vector<Eigen::Vector3d>& objects) {
  const auto began = Clock::now();
  PickResult result;
  result.reason = PickReason::kUnreachable;
  result.message = "no room for the fingers to push from";
  Trajectory approach, sweep;
  const JointVector start = start_of(robot);
  const auto direction = [](const grasping::Push& push) {
    return Eigen::Vector2d((push.to - push.from).normalized());
  };
  auto pushes = grasping::find_pushes(heights_, objects, cell_, config_.push);
  std::stable_partition(pushes.begin(), pushes.end(), [&](const grasping::Push& push) {
    return std::none_of(pushed_.begin(), pushed_.end(), [&](const Eigen::Vector2d& before) {
      return std::abs(direction(push).dot(before)) > kSameDirection;
    });
  });
  for (const grasping::Push& push : pushes) {
    if (!plan_push(start, push, approach, sweep, result.message)) continue;
    pushed_.push_back(direction(push));
    result.reason = PickReason::kSucceeded;
    result.message.clear();
    break;
  }
  result.planning_seconds = seconds_since(began);
  if (result.reason != PickReason::kSucceeded) return result;

  const auto fail = [&](const std::string& message) {
    result.reason = PickReason::kExecutionFailed;
    result.message = message;
  };
  const GripResult closed = robot.preset(config_.push.gap, config_.grip_force);
  if (!closed.success) {
    fail("the gripper did not move: " + closed.message);
    return result;
  }
  for (const Trajectory* trajectory : {&approach, &sweep}) {
    const ExecutionResult moved = move(robot, *trajectory);
    if (moved.success) continue;
    fail("push: " + moved.message);
    break;
  }
  const PickResult home = observe(robot);
  if (home.reason != PickReason::kSucceeded) fail(home.message);
  return result;
}

PickResult PickAndPlace::observe(Robot& robot) {
  const auto began = Clock::now();
  const JointVector q = start_of(robot);
  PickResult result;
  if ((q - cell_.observe_joints).cwiseAbs().maxCoeff() < kAtRest) return result;
  world_.set_attached(std::nullopt);
  world_.set_gripper_gap(kinematics::max_gap());
  world_.set_columns({});

  // Near the table the fingers may stand around a part, known or not: straight up first, and farther
  // while that is in contact.
  PathLeg up, home;
  up.path = {q};
  const Pose T_tool0 = kinematics::forward(q);
  const bool low = (T_tool0 * kinematics::T_tool0_tcp(0.0)).translation().z() < 2 * config_.approach_height;
  if (low || world_.collides(q)) {
    for (const double share : {1.0, 0.5, 1.5, 2.5}) {
      const PlanResult rise = plan_straight(world_, q, raised(T_tool0, share * config_.approach_height), false);
      if (!rise.success) continue;
      up.path = rise.path;
      if (!world_.collides(rise.path.back())) break;
    }
  }
  const PlanResult way = motion::plan(world_, up.path.back(), cell_.observe_joints, config_.planner);
  result.planning_seconds = seconds_since(began);
  if (!way.success) {
    result.reason = PickReason::kNoPlan;
    result.message = "no way back to the observing pose: " + way.message +
                     "; move the arm clear by hand and try again";
    return result;
  }
  home.path = way.path;
  up.limits = home.limits = config_.limits;
  up.max_tool_speed = config_.lift_speed;
  up.deviation = home.deviation = 0.0;
  const ExecutionResult moved = move(robot, time_parametrize({up, home}));
  if (!moved.success) {
    result.reason = PickReason::kExecutionFailed;
    result.message = "on the way to the observing pose: " + moved.message;
  }
  return result;
}

void PickAndPlace::put_back(Robot& robot, const PickPlan& plan, double opening) {
  // From wherever the arm stopped back over the grasp, along what was planned for the way there.
  const JointVector q = start_of(robot);
  std::string why;
  const auto nearest = std::min_element(
      plan.carry.begin(), plan.carry.end(), [&](const TrajectoryPoint& a, const TrajectoryPoint& b) {
        return (a.q - q).squaredNorm() < (b.q - q).squaredNorm();
      });
  PathLeg back;
  back.path = {q};
  for (auto it = std::make_reverse_iterator(nearest); it != plan.carry.rend(); ++it)
    back.path.push_back(it->q);
  back.limits = config_.carry;
  back.max_tool_speed = config_.lift_speed;
  back.max_tool_acceleration = config_.carry_tool_acceleration;
  if ((*nearest).q.allFinite() && (nearest->q - q).cwiseAbs().maxCoeff() < 10 * kSamePlace)
    move(robot, time_parametrize({back}));
  robot.grip(opening, config_.grip_force);
}

PickResult PickAndPlace::run(Robot& robot, const PickRequest& request,
                             const std::function<bool(const std::string&)>& phase) {
  pushed_.clear();
  PickPlan plan;
  PickResult result = plan_pick(start_of(robot), request, plan);

  // The failure with the arm brought home; what goes wrong on that way is added to the message.
  const auto fail = [&](PickReason reason, const std::string& message) {
    result.reason = reason;
    result.message = message;
    const PickResult home = observe(robot);
    if (home.reason != PickReason::kSucceeded) result.message += "; " + home.message;
    return result;
  };
  if (result.reason != PickReason::kSucceeded) return fail(result.reason, result.message);
  const auto begin = [&](const std::string& name) { return !phase || phase(name); };
  const double opening = request.grasp.opening, force = config_.grip_force;
  const auto held = [&](const GripResult& grip) { return grip.success && grip.gap >= config_.held_gap_min; };

  if (!begin("approach")) return fail(PickReason::kExecutionFailed, "cancelled before the approach");
  const GripResult opened = robot.preset(opening, force);
  if (!opened.success)
    return fail(PickReason::kExecutionFailed, "the gripper did not open: " + opened.message);
  ExecutionResult moved = move(robot, plan.approach);
  if (!moved.success) return fail(PickReason::kExecutionFailed, "approach: " + moved.message);

  if (!begin("grasp")) return fail(PickReason::kExecutionFailed, "cancelled before the grasp");
  const GripResult grip = robot.grip(0.0, force);
  const auto let_go = [&] { robot.grip(opening, force); };
  if (!grip.success) {
    let_go();
    return fail(PickReason::kExecutionFailed, "the gripper did not close: " + grip.message);
  }
  if (!held(grip)) {
    let_go();
    return fail(PickReason::kMissed, "the gripper closed on nothing (gap " + in_mm(grip.gap) + ")");
  }

  if (!begin("lift") || !begin("transfer")) {
    let_go();
    return fail(PickReason::kExecutionFailed, "cancelled before the lift");
  }
  moved = move(robot, plan.carry);
  bool contact = false;
  if (moved.success && !plan.lower.empty()) {
    moved = move(robot, plan.lower, true);
    contact = moved.contact;
  }
  if (!moved.success) {
    put_back(robot, plan, opening);
    return fail(PickReason::kExecutionFailed, "transfer: " + moved.message);
  }
  double gap = robot.gap();  // is it still there?
  if (std::isnan(gap)) gap = robot.grip(0.0, force).gap;
  if (gap < config_.held_gap_min) {
    let_go();
    return fail(PickReason::kLost, "the part left the gripper on the way (gap " + in_mm(grip.gap) +
                                       " after the grasp, " + in_mm(gap) + " over the tray)");
  }

  begin("release");  // a cancelled pick sets the part down first
  const GripResult released =
      robot.grip(std::min(gap + config_.release_margin, kinematics::max_gap()), force);
  if (!released.success)
    return fail(PickReason::kExecutionFailed, "the gripper did not let go: " + released.message);
  begin("return");
  const Trajectory retreat = contact ? retreat_from(start_of(robot), plan) : plan.retreat;
  if (retreat.empty()) return observe(robot);
  moved = move(robot, retreat);
  if (!moved.success) return fail(PickReason::kExecutionFailed, "the part is in the tray; return: " + moved.message);
  return result;
}

}  // namespace iwgnet_grasp::motion
