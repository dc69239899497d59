#include <gtest/gtest.h>

#include <random>

#include "iwgnet_grasp/calibration/hand_eye.h"
#include "iwgnet_grasp/calibration/reprojection.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::calibration;

namespace {

Pose pose(double x, double y, double z, double rx, double ry, double rz) {
  return Eigen::Translation3d(x, y, z) * Eigen::AngleAxisd(rz, Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(ry, Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(rx, Eigen::Vector3d::UnitX());
}

// A camera that looks down from 0.6 m at a board of 7 x 5 corners in a tilted gripper.
struct Rig {
  PinholeIntrinsics camera{1280, 800, 640, 640, 639.5, 399.5};
  Pose T_base_camera = pose(0.5, 0.01, 0.6, M_PI, 0.01, 0.02);
  Pose T_tool_target = pose(0.01, -0.02, 0.26, 0.02, -0.03, 0.5);
  std::mt19937_64 random;
  explicit Rig(unsigned seed) : random(seed) {}

  double uniform(double a, double b) { return std::uniform_real_distribution<>(a, b)(random); }

  std::vector<TargetView> views(int count, double sigma_px) {
    std::normal_distribution<double> noise(0.0, 1.0);
    std::vector<TargetView> result;
    for (int i = 0; i < count; ++i) {
      const Pose T_camera_target =
          pose(uniform(-.1, .1), uniform(-.05, .05), uniform(.28, .42), M_PI + uniform(-.5, .5),
               uniform(-.5, .5), uniform(-1, 1));
      TargetView view;
      view.T_base_tool = T_base_camera * T_camera_target * T_tool_target.inverse();
      for (int row = -2; row <= 2; ++row)
        for (int column = -3; column <= 3; ++column) {
          const Eigen::Vector3d corner(0.028 * column, 0.028 * row, 0.0);
          const Eigen::Vector3d p = T_camera_target * corner;
          view.corners.push_back(corner);
          view.pixels.emplace_back(camera.fx * p.x() / p.z() + camera.cx + sigma_px * noise(random),
                                   camera.fy * p.y() / p.z() + camera.cy + sigma_px * noise(random));
        }
      result.push_back(view);
    }
    return result;
  }
  ReprojectionResult solve(const std::vector<TargetView>& views) const {
    return refine_reprojection(views, camera, T_base_camera * pose(.01, -.01, .01, .03, -.02, .02),
                               T_tool_target * pose(-.005, .005, .004, .02, .03, -.02));
  }
  double error_m(const ReprojectionResult& r) const {
    return (r.T_base_camera.translation() - T_base_camera.translation()).norm();
  }
};

TEST(Reprojection, FindsBothTransformsExactlyFromExactCorners) {
  Rig rig(1);
  const auto result = rig.solve(rig.views(8, 0.0));
  ASSERT_TRUE(result.success) << result.reason;
  EXPECT_TRUE(result.T_base_camera.isApprox(rig.T_base_camera, 1e-9));
  EXPECT_TRUE(result.T_tool_target.isApprox(rig.T_tool_target, 1e-9));
  EXPECT_LT(result.rms_px, 1e-6);
}

TEST(Reprojection, ResidualsAreSeenMinusPredicted) {
  Rig rig(2);
  auto views = rig.views(4, 0.0);
  for (auto& pixel : views[0].pixels) pixel += Eigen::Vector2d(1.5, -0.5);
  for (const auto& r :
       reprojection_residuals(views[0], rig.camera, rig.T_base_camera, rig.T_tool_target))
    EXPECT_LT((r - Eigen::Vector2d(1.5, -0.5)).norm(), 1e-9);
}

TEST(Reprojection, ErrorAgreesWithItsOwnCovariance) {
  // A 6-dimensional estimate lies at a squared Mahalanobis distance of 6 on average; the mean of
  // 100 draws has a standard deviation of sqrt(12 / 100).
  double total = 0, noise = 0;
  for (unsigned seed = 0; seed < 100; ++seed) {
    Rig rig(seed);
    const auto result = rig.solve(rig.views(10, 0.1));
    ASSERT_TRUE(result.success) << result.reason;
    const Pose error = rig.T_base_camera.inverse() * result.T_base_camera;
    const Eigen::AngleAxisd turn(error.linear());
    Eigen::Matrix<double, 6, 1> e;
    e << error.translation(), turn.angle() * turn.axis();
    total += e.dot(result.covariance.inverse() * e) / 100;
    noise += result.rms_px / 100;
  }
  EXPECT_NEAR(total, 6.5, 1.5);
  EXPECT_NEAR(noise, 0.1, 0.01);
}

TEST(Reprojection, AWrongRobotPoseIsLeftOut) {
  for (unsigned seed = 0; seed < 10; ++seed) {
    Rig rig(seed);
    auto views = rig.views(15, 0.1);
    const auto clean = rig.solve(views);
    views[4].T_base_tool = views[4].T_base_tool * pose(.02, -.02, .01, .1, 0, .1);
    const auto spoiled = rig.solve(views);
    ASSERT_TRUE(clean.success && spoiled.success) << spoiled.reason;
    EXPECT_LT(spoiled.weights[4], 1e-6);
    EXPECT_LT((clean.T_base_camera.translation() - spoiled.T_base_camera.translation()).norm(), 1e-4);
  }
}

TEST(Reprojection, RefusesWhatCannotBeSolvedAndSaysWhy) {
  Rig rig(3);
  auto views = rig.views(8, 0.0);
  EXPECT_NE(rig.solve({views[0], views[1], views[2]}).reason.find("only 3 views"), std::string::npos);
  auto few = views;
  few[5].corners.resize(3);
  few[5].pixels.resize(3);
  EXPECT_NE(rig.solve(few).reason.find("view 5"), std::string::npos);
  auto broken = views;
  broken[2].pixels[0].x() = std::nan("");
  EXPECT_NE(rig.solve(broken).reason.find("view 2"), std::string::npos);
  for (auto& view : views)  // a target that slips in the gripper
    view.T_base_tool = view.T_base_tool * pose(rig.uniform(-.2, .2), rig.uniform(-.2, .2), 0,
                                               rig.uniform(-1, 1), rig.uniform(-1, 1), 0);
  const auto contradicting = rig.solve(views);
  EXPECT_TRUE(!contradicting.success || contradicting.rms_px > 5.0);
}

TEST(AxXb, IsZeroForTheTrueCameraAndGrowsWithATurnOfIt) {
  Rig rig(4);
  std::vector<PosePair> pairs;
  for (const auto& view : rig.views(10, 0.0))
    pairs.push_back({view.T_base_tool,
                     rig.T_base_camera.inverse() * view.T_base_tool * rig.T_tool_target});
  const auto [m, rad] = axxb_rms(pairs, rig.T_base_camera);
  EXPECT_LT(m, 1e-12);
  EXPECT_LT(rad, 1e-7);
  // With the camera moved by d, A X and X B differ by (R_A - 1) d: nothing for a motion that does
  // not turn, 2 |d| for half a turn.
  const Pose a = Pose::Identity();
  const Pose b = Pose(Eigen::Translation3d(0, 0, 0.1)) * pose(0, 0, 0, 0, 0, M_PI);
  std::vector<PosePair> two;
  for (const Pose& T : {a, b})
    two.push_back({T, rig.T_base_camera.inverse() * T * rig.T_tool_target});
  Pose moved = rig.T_base_camera;
  moved.translation().x() += 0.01;
  EXPECT_NEAR(axxb_rms(two, moved).first, 0.02, 1e-9);
}

}  // namespace
