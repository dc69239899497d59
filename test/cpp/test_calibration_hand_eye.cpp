#include <gtest/gtest.h>

#include <random>

#include "iwgnet_grasp/calibration/hand_eye.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::calibration;

namespace {

constexpr double kDegree = M_PI / 180.0;

Pose pose(double x, double y, double z, double rx, double ry, double rz) {
  return Eigen::Translation3d(x, y, z) * Eigen::AngleAxisd(rz, Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(ry, Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(rx, Eigen::Vector3d::UnitX());
}

// A camera that looks down from 0.6 m and a board held below it.
struct Rig {
  Pose T_base_camera = pose(0.5, 0.01, 0.6, M_PI, 0.01, 0.02);
  Pose T_tool_target = pose(0.01, -0.02, 0.16, 0.02, -0.03, 0.5);
  std::mt19937_64 random;
  explicit Rig(unsigned seed) : random(seed) {}

  double uniform(double a, double b) { return std::uniform_real_distribution<>(a, b)(random); }
  double normal(double sigma) { return std::normal_distribution<>(0.0, sigma)(random); }

  std::vector<PosePair> pairs(int count, double sigma_t, double sigma_r, bool yaw_only = false) {
    std::vector<PosePair> result;
    for (int i = 0; i < count; ++i) {
      const double tilt = yaw_only ? 0.0 : 0.5;
      const Pose T_base_tool = pose(0.5 + uniform(-.15, .15), uniform(-.12, .12), uniform(.1, .3),
                                    M_PI + uniform(-tilt, tilt), uniform(-tilt, tilt), uniform(-1, 1));
      Pose T_camera_target = T_base_camera.inverse() * T_base_tool * T_tool_target;
      T_camera_target = T_camera_target * pose(normal(sigma_t), normal(sigma_t), normal(sigma_t),
                                               normal(sigma_r), normal(sigma_r), normal(sigma_r));
      result.push_back({T_base_tool, T_camera_target});
    }
    return result;
  }
  double error_m(const HandEyeResult& r) const {
    return (r.T_base_camera.translation() - T_base_camera.translation()).norm();
  }
  double error_rad(const HandEyeResult& r) const {
    return Eigen::AngleAxisd(r.T_base_camera.linear().transpose() * T_base_camera.linear()).angle();
  }
  Pose rough_start() const { return T_base_camera * pose(.03, -.02, .03, .05, -.05, .08); }
};

TEST(HandEye, FindsTheCameraExactlyFromCleanPairs) {
  Rig rig(1);
  const auto result = refine(rig.pairs(10, 0, 0), rig.rough_start());
  ASSERT_TRUE(result.success) << result.reason;
  EXPECT_LT(rig.error_m(result), 1e-9);
  EXPECT_LT(rig.error_rad(result), 1e-9);
  EXPECT_TRUE(result.T_tool_target.isApprox(rig.T_tool_target, 1e-8));
}

TEST(HandEye, ErrorStaysWithinItsOwnCovariance) {
  // Mahalanobis distances of a 6-dimensional estimate average 6; they are inflated here by the
  // estimated noise scale, so 6 +- 1.5 over 200 draws.
  double total = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    Rig rig(seed);
    const auto result = refine(rig.pairs(15, 5e-4, 0.1 * kDegree), rig.rough_start(),
                               {5e-4, 0.1 * kDegree});
    ASSERT_TRUE(result.success) << result.reason;
    const Pose error = rig.T_base_camera.inverse() * result.T_base_camera;
    const Eigen::AngleAxisd turn(error.linear());
    Eigen::Matrix<double, 6, 1> e;
    e << error.translation(), turn.angle() * turn.axis();
    total += e.dot(result.covariance.inverse() * e);
  }
  EXPECT_NEAR(total / 200, 6.5, 1.5);
}

TEST(HandEye, OneWrongPairHardlyMovesTheResult) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    Rig rig(seed);
    auto pairs = rig.pairs(15, 1e-4, 0.02 * kDegree);
    const PoseNoise noise{1e-4, 0.02 * kDegree};
    const auto clean = refine(pairs, rig.rough_start(), noise);
    pairs[7].T_camera_target = pairs[7].T_camera_target * pose(.03, -.02, .01, .1, 0, .2);
    const auto spoiled = refine(pairs, rig.rough_start(), noise);
    ASSERT_TRUE(clean.success && spoiled.success) << spoiled.reason;
    EXPECT_LT((clean.T_base_camera.translation() - spoiled.T_base_camera.translation()).norm(), 2e-4);
    EXPECT_LT(spoiled.weights[7], 0.01);
  }
}

TEST(HandEye, RefusesWhatCannotBeSolvedAndSaysWhy) {
  Rig rig(3);
  const auto good = rig.pairs(8, 0, 0);
  EXPECT_EQ(refuse_pairs(good), "");
  EXPECT_NE(refuse_pairs(std::vector<PosePair>(good.begin(), good.begin() + 3)).find("only 3 pairs"), std::string::npos);
  EXPECT_NE(refuse_pairs(rig.pairs(8, 0, 0, true)).find("one axis"), std::string::npos);
  auto repeated = good;
  repeated.push_back(good[2]);
  EXPECT_NE(refuse_pairs(repeated).find("same robot pose"), std::string::npos);
  auto broken = good;
  broken[4].T_camera_target.translation().x() = std::nan("");
  EXPECT_NE(refuse_pairs(broken).find("pair 4"), std::string::npos);
}

TEST(HandEye, RefusesEyeInHandDataGivenAsEyeToHand) {
  // The camera rides on the tool and looks at a fixed target.
  Rig rig(4);
  const Pose T_tool_camera = pose(.05, 0, .05, 0, 0, .3), T_base_target = pose(.5, 0, 0, 0, 0, 0);
  std::vector<PosePair> pairs;
  for (const auto& pair : rig.pairs(12, 0, 0))
    pairs.push_back({pair.T_base_tool,
                     (pair.T_base_tool * T_tool_camera).inverse() * T_base_target});
  const auto result = refine(pairs, rig.rough_start());
  EXPECT_FALSE(result.success);
  EXPECT_NE(result.reason, "");
}

TEST(HandEye, LeaveOneOutSpreadGrowsWithTheNoise) {
  Rig quiet(5), loud(5);
  const auto a = quiet.pairs(12, 1e-4, 0.02 * kDegree), b = loud.pairs(12, 1e-3, 0.2 * kDegree);
  const auto ra = refine(a, quiet.rough_start()), rb = refine(b, loud.rough_start());
  ASSERT_TRUE(ra.success && rb.success);
  const auto sa = leave_one_out_spread(a, ra, {}), sb = leave_one_out_spread(b, rb, {});
  EXPECT_GT(sb.first, 3 * sa.first);
  EXPECT_GT(sb.second, 3 * sa.second);
}

}  // namespace
