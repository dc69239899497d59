// UR5: forward model (Eq. 1), all closed-form solutions (Eq. 2), Jacobian.
#include <gtest/gtest.h>

#include <random>

#include "iwgnet_grasp/kinematics/ur5.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::kinematics;

namespace {

JointVector random_joints(std::mt19937& random) {
  std::uniform_real_distribution<double> angle(-M_PI, M_PI);
  JointVector q;
  for (int i = 0; i < kJoints; ++i) q[i] = angle(random);
  return q;
}

double angle_distance(const JointVector& a, const JointVector& b) {
  double worst = 0;
  for (int i = 0; i < kJoints; ++i)
    worst = std::max(worst, std::abs(std::remainder(a[i] - b[i], 2 * M_PI)));
  return worst;
}

Pose product_of_eq1(const JointVector& q) {
  Eigen::Matrix4d T = Eigen::Matrix4d::Identity();
  T(0, 0) = T(1, 1) = -1;  // base_link -> DH base: pi about z
  for (int i = 0; i < kJoints; ++i) T = T * dh_transform(kUr5Dh[i], q[i]);
  return Pose(T);
}

}  // namespace

TEST(Ur5Forward, IsTheProductOfEquation1) {
  std::mt19937 random(1);
  for (int i = 0; i < 1000; ++i) {
    const JointVector q = random_joints(random);
    EXPECT_LT((forward(q).matrix() - product_of_eq1(q).matrix()).cwiseAbs().maxCoeff(), 1e-12);
  }
}

TEST(Ur5Forward, KnownPoses) {
  // Arm stretched along base_link's +x by the turn of pi: |x| = a2 + a3, y = d4 + d6, z = d1 - d5.
  const Pose T = forward(JointVector::Zero());
  EXPECT_NEAR(T(0, 3), 0.425 + 0.39225, 1e-12);
  EXPECT_NEAR(T(1, 3), 0.10915 + 0.0823, 1e-12);
  EXPECT_NEAR(T(2, 3), 0.089159 - 0.09465, 1e-12);
  // Upright: z = d1 + 0.425 + 0.39225 + d5 above the base.
  JointVector up;
  up << 0, -M_PI / 2, 0, -M_PI / 2, 0, 0;
  EXPECT_NEAR(forward(up)(2, 3), 0.089159 + 0.425 + 0.39225 + 0.09465, 1e-12);
}

TEST(Ur5Inverse, RoundTripOnTenThousandPoses) {
  std::mt19937 random(2);
  double worst_pose = 0, worst_joint = 0;
  long found = 0;
  for (int i = 0; i < 10000; ++i) {
    const JointVector q = random_joints(random);
    const Pose T = forward(q);
    const IkSolutions solutions = inverse(T);
    ASSERT_GE(solutions.count, 1);
    found += solutions.count;
    double nearest = 10;
    for (int k = 0; k < solutions.count; ++k) {
      for (int j = 0; j < kJoints; ++j) {
        ASSERT_GT(solutions.q[k][j], -M_PI - 1e-15);
        ASSERT_LE(solutions.q[k][j], M_PI);
      }
      const Pose reached = forward(solutions.q[k]);
      worst_pose = std::max(worst_pose, (reached.matrix() - T.matrix()).cwiseAbs().maxCoeff());
      nearest = std::min(nearest, angle_distance(solutions.q[k], q));
    }
    worst_joint = std::max(worst_joint, nearest);
  }
  EXPECT_LT(worst_pose, 1e-9);
  EXPECT_LT(worst_joint, 1e-6);  // joints lose digits near singularities, poses do not
  EXPECT_GT(found / 10000.0, 4.0);
}

TEST(Ur5Inverse, SolutionsAreDistinct) {
  std::mt19937 random(3);
  for (int i = 0; i < 500; ++i) {
    const IkSolutions s = inverse(forward(random_joints(random)));
    for (int a = 0; a < s.count; ++a)
      for (int b = 0; b < a; ++b) EXPECT_GT(angle_distance(s.q[a], s.q[b]), 1e-9);
  }
}

TEST(Ur5Inverse, WristSingularityTakesTheGivenJoint6) {
  JointVector q;
  q << 0.3, -1.2, 1.4, -0.7, 0.0, 0.9;
  const Pose T = forward(q);
  const IkSolutions s = inverse(T, 0.25);
  ASSERT_GE(s.count, 1);
  bool taken = false;
  for (int k = 0; k < s.count; ++k) {
    EXPECT_LT((forward(s.q[k]).matrix() - T.matrix()).cwiseAbs().maxCoeff(), 1e-9);
    taken |= std::abs(s.q[k][4]) < 1e-9 && std::abs(s.q[k][5] - 0.25) < 1e-9;
  }
  EXPECT_TRUE(taken);
}

TEST(Ur5Inverse, StretchedArmIsReachedAndBeyondIsNot) {
  JointVector q;
  q << 0.4, -0.8, 0.0, 0.5, 1.0, -0.3;
  Pose T = forward(q);
  const IkSolutions s = inverse(T);
  ASSERT_GE(s.count, 1);
  for (int k = 0; k < s.count; ++k)
    EXPECT_LT((forward(s.q[k]).matrix() - T.matrix()).cwiseAbs().maxCoeff(), 1e-9);
  T.translation() = Eigen::Vector3d(1.5, 0, 0.3);
  EXPECT_EQ(inverse(T).count, 0);
  // The cylinder of radius d4 about the base axis is out of reach of the wrist centre.
  T.linear() = Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX()).toRotationMatrix();
  T.translation() = Eigen::Vector3d(0.05, 0, 0.4);
  EXPECT_EQ(inverse(T).count, 0);
  T.translation().setConstant(std::nan(""));
  EXPECT_EQ(inverse(T).count, 0);
}

// The sign of Eq. 2. With (X, Y) the wrist centre in the DH base frame, its printed arguments
// (d6 ay - py, px - d6 ax) are (-Y, X), and both roots come out as -q1.
TEST(Ur5Inverse, Equation2AsPrintedGivesMinusTheta1) {
  std::mt19937 random(4);
  const double d4 = kUr5Dh[3].d, d6 = kUr5Dh[5].d;
  for (int i = 0; i < 1000; ++i) {
    const JointVector q = random_joints(random);
    Eigen::Matrix4d T = Eigen::Matrix4d::Identity();
    for (int j = 0; j < kJoints; ++j) T = T * dh_transform(kUr5Dh[j], q[j]);
    const double ax = T(0, 2), ay = T(1, 2), px = T(0, 3), py = T(1, 3);
    const double m = d6 * ay - py, n = px - d6 * ax;
    const double root = std::sqrt(std::max(0.0, m * m + n * n - d4 * d4));
    double printed = 10, second_argument_negated = 10;
    for (const double sign : {1.0, -1.0}) {
      const double turn = std::atan2(d4, sign * root);
      printed = std::min(printed, std::abs(std::remainder(std::atan2(m, n) - turn + q[0], 2 * M_PI)));
      second_argument_negated =
          std::min(second_argument_negated,
                   std::abs(std::remainder(std::atan2(m, -n) - turn - q[0], 2 * M_PI)));
    }
    EXPECT_LT(printed, 1e-6);                  // equals -q1
    EXPECT_LT(second_argument_negated, 1e-6);  // equals q1
  }
}

TEST(Ur5Inverse, NearestTurnStaysWithinTwoPi) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> reference(-2 * M_PI, 2 * M_PI);
  for (int i = 0; i < 1000; ++i) {
    const JointVector q = random_joints(random);
    JointVector r;
    for (int j = 0; j < kJoints; ++j) r[j] = reference(random);
    const JointVector t = nearest_turn(q, r);
    EXPECT_LE(t.cwiseAbs().maxCoeff(), 2 * M_PI);
    EXPECT_LT(angle_distance(t, q), 1e-9);
    for (int j = 0; j < kJoints; ++j)
      for (const double other : {t[j] - 2 * M_PI, t[j] + 2 * M_PI}) {
        if (std::abs(other) > 2 * M_PI) continue;
        EXPECT_LE(std::abs(t[j] - r[j]), std::abs(other - r[j]) + 1e-9);
      }
  }
}

TEST(Ur5Jacobian, MatchesFiniteDifferences) {
  std::mt19937 random(6);
  const double h = 1e-6;
  for (int i = 0; i < 200; ++i) {
    const JointVector q = random_joints(random);
    const auto J = jacobian(q);
    for (int j = 0; j < kJoints; ++j) {
      JointVector plus = q, minus = q;
      plus[j] += h;
      minus[j] -= h;
      const Pose A = forward(plus), B = forward(minus);
      const Eigen::Vector3d linear = (A.translation() - B.translation()) / (2 * h);
      const Eigen::AngleAxisd turn(Eigen::Matrix3d(A.linear() * B.linear().transpose()));
      const Eigen::Vector3d angular = turn.axis() * turn.angle() / (2 * h);
      EXPECT_LT((J.block<3, 1>(0, j) - linear).norm(), 1e-8);
      EXPECT_LT((J.block<3, 1>(3, j) - angular).norm(), 1e-6);
    }
  }
}
