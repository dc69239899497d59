// Time parametrisation: limits at every sample, rest at both ends, the optimum where it is known.
#include <gtest/gtest.h>

#include <random>

#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/trajectory.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::motion;

namespace {

JointLimits limits(double velocity, double acceleration) {
  return {JointVector::Constant(velocity), JointVector::Constant(acceleration)};
}

JointPath random_path(std::mt19937& random, int count) {
  std::uniform_real_distribution<double> angle(-1.5, 1.5);
  JointPath path(count);
  for (JointVector& q : path)
    for (int i = 0; i < kJoints; ++i) q[i] = angle(random);
  return path;
}

void expect_within(const Trajectory& trajectory, const JointLimits& limits) {
  for (const TrajectoryPoint& p : trajectory) {
    EXPECT_LE((p.qd.cwiseAbs() - limits.max_velocity).maxCoeff(), 1e-9);
    EXPECT_LE((p.qdd.cwiseAbs() - limits.max_acceleration).maxCoeff(), 1e-9);
  }
}

double distance_to_path(const JointVector& q, const JointPath& path) {
  double best = 1e9;
  for (std::size_t i = 1; i < path.size(); ++i) {
    const JointVector d = path[i] - path[i - 1];
    const double t = std::clamp((q - path[i - 1]).dot(d) / d.squaredNorm(), 0.0, 1.0);
    best = std::min(best, (q - path[i - 1] - t * d).norm());
  }
  return best;
}

}  // namespace

TEST(TimeParametrize, StraightMotionIsBangCoastBang) {
  JointVector to = JointVector::Zero();
  to[0] = 2.0;
  to[3] = -0.5;
  const Trajectory t = time_parametrize({JointVector::Zero(), to}, limits(1.0, 4.0));
  EXPECT_NEAR(t.back().time, 2.0 / 1.0 + 1.0 / 4.0, 1e-3);  // d / v + v / a
  const Trajectory brief = time_parametrize({JointVector::Zero(), 0.05 * to}, limits(1.0, 4.0));
  EXPECT_NEAR(brief.back().time, 2 * std::sqrt(0.1 / 4.0), 1e-3);
}

TEST(TimeParametrize, KeepsLimitsAndPathAndRestsAtTheEnds) {
  std::mt19937 random(1);
  const JointLimits bounds = limits(M_PI, 8.0);
  for (int i = 0; i < 60; ++i) {
    const JointPath path = random_path(random, 2 + i % 6);
    const double deviation = i % 3 * 0.05;
    const Trajectory t = time_parametrize(path, bounds, deviation);
    expect_within(t, bounds);
    EXPECT_DOUBLE_EQ(t.front().time, 0.0);
    EXPECT_LT((t.front().q - path.front()).norm(), 1e-12);
    EXPECT_LT((t.back().q - path.back()).norm(), 1e-12);
    EXPECT_EQ(t.front().qd.norm(), 0.0);
    EXPECT_EQ(t.back().qd.norm(), 0.0);
    for (std::size_t k = 1; k < t.size(); ++k) EXPECT_GT(t[k].time, t[k - 1].time);
    for (const TrajectoryPoint& p : t) EXPECT_LT(distance_to_path(p.q, path), deviation + 1e-6);
  }
}

TEST(TimeParametrize, PositionsAreTheIntegralOfVelocities) {
  std::mt19937 random(2);
  const Trajectory t = time_parametrize(random_path(random, 5), limits(2.0, 6.0));
  JointVector q = t.front().q;
  for (std::size_t k = 1; k < t.size(); ++k) {
    q += (t[k].qd + t[k - 1].qd) / 2 * (t[k].time - t[k - 1].time);
    EXPECT_LT((q - t[k].q).norm(), 0.01);
  }
}

TEST(TimeParametrize, RoundedCornersAreFasterThanStops) {
  std::mt19937 random(3);
  const JointPath path = random_path(random, 4);
  const double stops = time_parametrize(path, limits(2, 6), 0.0).back().time;
  const double round = time_parametrize(path, limits(2, 6), 0.1).back().time;
  EXPECT_LT(round, 0.95 * stops);
}

TEST(TimeParametrize, ReversalAndRepeatedWaypoints) {
  JointVector a = JointVector::Zero(), b = JointVector::Constant(0.4);
  const JointLimits bounds = limits(2, 6);
  expect_within(time_parametrize({a, a, b, b, a}, bounds, 0.05), bounds);
  const Trajectory still = time_parametrize({a, a}, bounds);
  ASSERT_EQ(still.size(), 2u);
  EXPECT_GT(still.back().time, 0.0);
}

TEST(TimeParametrize, ToolLimitsHoldOnTheirLeg) {
  JointVector a, b, c;
  a << 0.3, -1.2, 1.6, -1.97, -1.57, 0.3;
  b << 0.9, -1.1, 1.7, -2.17, -1.57, 0.9;
  c << 0.95, -0.9, 1.9, -2.57, -1.57, 0.95;
  PathLeg fast{{a, b}, limits(M_PI, 8)}, slow{{b, c}, limits(M_PI, 8)};
  slow.max_tool_speed = 0.2;
  fast.max_tool_acceleration = slow.max_tool_acceleration = 4.0;
  const Trajectory t = time_parametrize({fast, slow});
  expect_within(t, limits(M_PI, 8));
  double fastest_first = 0, fastest_second = 0;
  Eigen::Vector3d before = Eigen::Vector3d::Zero();
  for (std::size_t k = 0; k < t.size(); ++k) {
    const Eigen::Vector3d velocity = (kinematics::jacobian(t[k].q) * t[k].qd).head<3>();
    const double past = (t[k].q - b).dot(c - b) / (c - b).norm();  // rad beyond the junction
    (past > 0 ? fastest_second : fastest_first) =
        std::max(past > 0 ? fastest_second : fastest_first, velocity.norm());
    if (k > 0) {
      const Eigen::Vector3d acceleration = (velocity - before) / (t[k].time - t[k - 1].time);
      EXPECT_LT(acceleration.cwiseAbs().maxCoeff(), 4.0 * 1.05);
    }
    before = velocity;
  }
  EXPECT_LE(fastest_second, 0.2 + 1e-9);
  EXPECT_GT(fastest_first, 0.3);
}

TEST(TimeParametrize, RefusesNonsense) {
  EXPECT_THROW(time_parametrize(JointPath{}, limits(1, 1)), Error);
  EXPECT_THROW(time_parametrize({JointVector::Zero(), JointVector::Ones()}, limits(0, 1)), Error);
  EXPECT_THROW(time_parametrize({JointVector::Zero(), JointVector::Constant(std::nan(""))}, limits(1, 1)),
               Error);
  EXPECT_THROW(sample({}, 0.0), Error);
}

TEST(SampleTrajectory, InterpolatesAndClamps) {
  std::mt19937 random(4);
  const Trajectory coarse = time_parametrize(random_path(random, 4), limits(2, 6), 0.1, 0.02);
  EXPECT_EQ(sample(coarse, -1).q, coarse.front().q);
  EXPECT_EQ(sample(coarse, 1e9).q, coarse.back().q);
  for (std::size_t k = 0; k + 1 < coarse.size(); ++k) {
    EXPECT_LT((sample(coarse, coarse[k].time).q - coarse[k].q).norm(), 1e-12);
    const double middle = (coarse[k].time + coarse[k + 1].time) / 2;
    const double h = 1e-6;
    const JointVector slope = (sample(coarse, middle + h).q - sample(coarse, middle - h).q) / (2 * h);
    EXPECT_LT((sample(coarse, middle).qd - slope).norm(), 1e-6);
  }
}
