#include "iwgnet_grasp/motion/trajectory.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "iwgnet_grasp/kinematics/ur5.h"

namespace iwgnet_grasp::motion {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kSamePoint = 1e-9;    // rad, waypoints nearer than this are one
constexpr double kStraight = 1e-6;     // |difference of directions| that is no corner
constexpr double kShortestBlend = 1e-4;  // rad, a tighter corner is a stop
constexpr double kGridStep = 0.02;     // of the path parameter
constexpr int kGridPerPiece = 4;
constexpr int kRows = kJoints + 3;     // joints, then the tool's position

using Row = Eigen::Matrix<double, kRows, 1>;

struct Limits {
  Row velocity, acceleration;
  double tool_speed;
};

Limits stricter(const Limits& a, const Limits& b) {
  return {a.velocity.cwiseMin(b.velocity), a.acceleration.cwiseMin(b.acceleration),
          std::min(a.tool_speed, b.tool_speed)};
}

// q(t) = q + t v + t^2 a / 2 for t in [0, length].
struct Piece {
  JointVector q, v, a;
  double length;
  Limits limits;
  bool stop_after;  // the trajectory rests at its end
};

Limits limits_of(const PathLeg& leg) {
  Limits limits;
  limits.velocity << leg.limits.max_velocity, Eigen::Vector3d::Constant(kInfinity);
  limits.acceleration << leg.limits.max_acceleration,
      Eigen::Vector3d::Constant(leg.max_tool_acceleration);
  limits.tool_speed = leg.max_tool_speed;
  const bool positive = (limits.velocity.array() > 0).all() &&
                        (limits.acceleration.array() > 0).all() && limits.tool_speed > 0;
  if (!positive) throw Error("time_parametrize: every limit of speed and acceleration must be positive");
  return limits;
}

struct Corner {
  JointVector q;
  double deviation;
  Limits limits;  // of the segment that ends here
};

std::vector<Corner> waypoints(const std::vector<PathLeg>& legs) {
  std::vector<Corner> points;
  for (const PathLeg& leg : legs) {
    const Limits limits = limits_of(leg);
    bool joint = !points.empty();  // the next waypoint is where this leg joins the one before
    for (const JointVector& q : leg.path) {
      if (!q.allFinite()) throw Error("time_parametrize: a waypoint is not finite");
      if (!points.empty() && (q - points.back().q).norm() < kSamePoint) {
        if (joint) points.back().deviation = std::min(points.back().deviation, leg.deviation);
      } else {
        points.push_back({q, leg.deviation, limits});
      }
      joint = false;
    }
  }
  if (points.empty()) throw Error("time_parametrize: the path has no waypoint");
  return points;
}

// Straight pieces with parabolas at the corners; speed of the parameter is continuous.
std::vector<Piece> smooth_path(const std::vector<Corner>& points) {
  std::vector<Piece> pieces;
  double used = 0.0;  // of the segment's start by the blend before
  for (std::size_t i = 1; i < points.size(); ++i) {
    const JointVector delta = points[i].q - points[i - 1].q;
    const double length = delta.norm();
    const JointVector u = delta / length;
    double blend = 0.0;
    JointVector next = u;
    double corner = 0.0;
    if (i + 1 < points.size()) {
      const JointVector after = points[i + 1].q - points[i].q;
      next = after / after.norm();
      corner = (next - u).norm();
      // The parabola passes the corner at a distance of blend |next - u| / 4.
      if (corner > kStraight)
        blend = std::min({length / 2, after.norm() / 2, 4 * points[i].deviation / corner});
    }
    const bool last = i + 1 == points.size();
    const bool stop = last || (corner > kStraight && blend < kShortestBlend);
    if (stop) blend = 0.0;
    if (length - used - blend > kSamePoint)
      pieces.push_back({points[i - 1].q + used * u, u, JointVector::Zero(), length - used - blend,
                        points[i].limits, stop});
    else if (stop && !pieces.empty())
      pieces.back().stop_after = true;
    if (blend > 0.0)
      pieces.push_back({points[i].q - blend * u, u, (next - u) / (2 * blend), 2 * blend,
                        stricter(points[i].limits, points[i + 1].limits), false});
    used = blend;
  }
  return pieces;
}

// First and second derivatives of joints and tool by the path parameter.
struct Derivatives {
  Row first, second;
};

Derivatives derivatives(const Piece& piece, double t, bool tool) {
  const JointVector q = piece.q + t * piece.v + 0.5 * t * t * piece.a, v = piece.v + t * piece.a;
  Derivatives d;
  d.first.head<kJoints>() = v;
  d.second.head<kJoints>() = piece.a;
  d.first.tail<3>().setZero();
  d.second.tail<3>().setZero();
  if (tool) {
    const double h = 1e-5;
    const auto linear = [](const JointVector& at) -> Eigen::Matrix<double, 3, 6> {
      return kinematics::jacobian(at).topRows<3>();
    };
    const auto J = linear(q);
    d.first.tail<3>() = J * v;
    d.second.tail<3>() = J * piece.a + (linear(q + h * v) - linear(q - h * v)) * v / (2 * h);
  }
  return d;
}

// One step of the grid, between two values of the path parameter inside one piece.
struct Step {
  int piece;
  double t, h;  // start within the piece, length
  Derivatives begin, end;
  const Limits* limits;
};

double max_squared_speed(const Derivatives& d, const Limits& limits) {
  double x = kInfinity;
  for (int i = 0; i < kJoints; ++i) {
    const double rate = std::abs(d.first[i]);
    if (rate > 1e-12) x = std::min(x, std::pow(limits.velocity[i] / rate, 2));
  }
  const double tool = d.first.tail<3>().squaredNorm();
  if (tool > 1e-18) x = std::min(x, limits.tool_speed * limits.tool_speed / tool);
  return x;
}

// The range of s'' that keeps the accelerations at both ends of the step when s'^2 = x at its
// start and is at most next_max at its end. False when there is none.
bool acceleration_range(const Step& step, double x, double next_max, double& low, double& high) {
  low = -x / (2 * step.h);
  high = (next_max - x) / (2 * step.h);
  const auto keep = [&](double coefficient, double offset, double limit) {
    if (limit == kInfinity) return true;
    if (std::abs(coefficient) < 1e-12) return std::abs(offset) <= limit;
    double a = (-limit - offset) / coefficient, b = (limit - offset) / coefficient;
    if (a > b) std::swap(a, b);
    low = std::max(low, a);
    high = std::min(high, b);
    return low <= high;
  };
  for (int i = 0; i < kRows; ++i) {
    const double limit = step.limits->acceleration[i];
    if (!keep(step.begin.first[i], step.begin.second[i] * x, limit) ||
        !keep(step.end.first[i] + 2 * step.h * step.end.second[i], step.end.second[i] * x, limit))
      return false;
  }
  return low <= high;
}

std::vector<Step> grid(const std::vector<Piece>& pieces) {
  std::vector<Step> steps;
  for (std::size_t p = 0; p < pieces.size(); ++p) {
    const Piece& piece = pieces[p];
    const bool tool = piece.limits.tool_speed < kInfinity || piece.limits.acceleration[kJoints] < kInfinity;
    const int count = std::max(kGridPerPiece, static_cast<int>(std::ceil(piece.length / kGridStep)));
    Derivatives begin = derivatives(piece, 0.0, tool);
    for (int k = 0; k < count; ++k) {
      Step step;
      step.piece = static_cast<int>(p);
      step.t = piece.length * k / count;
      step.h = piece.length / count;
      step.begin = begin;
      step.end = begin = derivatives(piece, step.t + step.h, tool);
      step.limits = &piece.limits;
      steps.push_back(step);
    }
  }
  return steps;
}

// s'^2 at the grid points: backward, the largest from which the end can still be reached; forward,
// the largest acceleration.
std::vector<double> speed_profile(const std::vector<Step>& steps, const std::vector<Piece>& pieces) {
  const std::size_t n = steps.size();
  std::vector<double> reach(n + 1, 0.0), x(n + 1, 0.0);
  for (std::size_t k = n; k-- > 0;) {
    double ceiling = std::min(max_squared_speed(steps[k].begin, *steps[k].limits), 1e6);
    if (k > 0) {
      ceiling = std::min(ceiling, max_squared_speed(steps[k - 1].end, *steps[k - 1].limits));
      const bool boundary = steps[k].piece != steps[k - 1].piece;
      if (boundary && pieces[steps[k - 1].piece].stop_after) ceiling = 0.0;
    }
    double low = 0.0, high = ceiling, a, b;
    if (acceleration_range(steps[k], high, reach[k + 1], a, b)) {
      low = high;
    } else {
      for (int i = 0; i < 50; ++i) {  // the feasible values are an interval that holds 0
        const double middle = (low + high) / 2;
        (acceleration_range(steps[k], middle, reach[k + 1], a, b) ? low : high) = middle;
      }
    }
    reach[k] = low;
  }
  for (std::size_t k = 0; k < n; ++k) {
    double low, high;
    if (!acceleration_range(steps[k], x[k], reach[k + 1], low, high))
      high = (reach[k + 1] - x[k]) / (2 * steps[k].h);  // a rounding error outside
    x[k + 1] = std::clamp(x[k] + 2 * steps[k].h * high, 0.0, reach[k + 1]);
  }
  return x;
}

}  // namespace

Trajectory time_parametrize(const std::vector<PathLeg>& legs, double dt) {
  if (!(dt > 0)) throw Error("time_parametrize: the sampling interval must be positive");
  const std::vector<Corner> points = waypoints(legs);
  Trajectory trajectory;
  const auto rest = [&](double time, const JointVector& q) {
    trajectory.push_back({time, q, JointVector::Zero(), JointVector::Zero()});
  };
  if (points.size() == 1) {
    rest(0.0, points[0].q);
    rest(dt, points[0].q);
    return trajectory;
  }

  const std::vector<Piece> pieces = smooth_path(points);
  const std::vector<Step> steps = grid(pieces);
  const std::vector<double> x = speed_profile(steps, pieces);

  double step_start = 0.0, stretch = 1.0, next = 0.0;
  for (std::size_t k = 0; k < steps.size(); ++k) {
    const Step& step = steps[k];
    const double speed = std::sqrt(x[k]);
    const double duration = 2 * step.h / (speed + std::sqrt(x[k + 1]));
    const double acceleration = (x[k + 1] - x[k]) / (2 * step.h);
    for (; next < step_start + duration; next += dt) {
      const double t = next - step_start;
      const double at = step.t + std::min(step.h, speed * t + 0.5 * acceleration * t * t);
      const double rate = std::max(speed + acceleration * t, 0.0);
      const Piece& piece = pieces[step.piece];
      const bool tool = step.limits->tool_speed < kInfinity || step.limits->acceleration[kJoints] < kInfinity;
      const Derivatives d = derivatives(piece, at, tool);
      const Row velocity = d.first * rate, accelerations = d.second * rate * rate + d.first * acceleration;
      trajectory.push_back({next, piece.q + at * piece.v + 0.5 * at * at * piece.a,
                            velocity.head<kJoints>(), accelerations.head<kJoints>()});
      // Between grid points limits are met only to first order: what is over stretches the time.
      stretch = std::max(stretch, velocity.tail<3>().norm() / step.limits->tool_speed);
      for (int i = 0; i < kRows; ++i) {
        stretch = std::max(stretch, std::abs(velocity[i]) / step.limits->velocity[i]);
        stretch = std::max(stretch, std::sqrt(std::abs(accelerations[i]) / step.limits->acceleration[i]));
      }
    }
    step_start += duration;
  }
  if (step_start - trajectory.back().time < 1e-6) trajectory.pop_back();
  rest(step_start, points.back().q);
  for (TrajectoryPoint& point : trajectory) {
    point.time *= stretch;
    point.qd /= stretch;
    point.qdd /= stretch * stretch;
  }
  return trajectory;
}

Trajectory time_parametrize(const JointPath& path, const JointLimits& limits, double deviation, double dt) {
  PathLeg leg;
  leg.path = path;
  leg.limits = limits;
  leg.deviation = deviation;
  return time_parametrize(std::vector<PathLeg>{leg}, dt);
}

TrajectoryPoint sample(const Trajectory& trajectory, double t) {
  if (trajectory.empty()) throw Error("sample: the trajectory is empty");
  if (!(t > trajectory.front().time)) return trajectory.front();
  if (t >= trajectory.back().time) return trajectory.back();
  const auto after = std::upper_bound(trajectory.begin(), trajectory.end(), t,
                                      [](double time, const TrajectoryPoint& p) { return time < p.time; });
  const TrajectoryPoint &b = *after, &a = *(after - 1);
  const double h = b.time - a.time, s = (t - a.time) / h;
  const JointVector chord = (b.q - a.q) / h;
  // q = a.q + h (a.qd s + c s^2 + d s^3)
  const JointVector c = 3 * chord - 2 * a.qd - b.qd, d = a.qd + b.qd - 2 * chord;
  return {t, a.q + h * s * (a.qd + s * (c + s * d)), a.qd + s * (2 * c + 3 * s * d), (2 * c + 6 * s * d) / h};
}

}  // namespace iwgnet_grasp::motion
