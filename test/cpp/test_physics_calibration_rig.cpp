// The calibration rig of the simulated cell: what is off, by how much, and where it shows.
#include <gtest/gtest.h>

#include <cmath>

#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/physics/calibration_rig.h"
#include "iwgnet_grasp/physics/simulated_cell.h"

namespace iwgnet_grasp::physics {
namespace {

const std::string kConfig = std::string(IWGNET_SOURCE_DIR) + "/config";

TEST(CalibrationRig, OffsetsComeFromTheSeedAndStayWithinTheirLimits) {
  const Offset limit{0.008, 0.026};
  double farthest = 0;
  for (std::uint64_t seed = 0; seed < 200; ++seed) {
    const Pose T = draw_offset(limit, seed);
    EXPECT_LE(T.translation().cwiseAbs().maxCoeff(), limit.translation);
    EXPECT_LE(Eigen::AngleAxisd(T.linear()).angle(), std::sqrt(3.0) * limit.rotation);
    EXPECT_TRUE(T.isApprox(draw_offset(limit, seed), 0.0));
    farthest = std::max(farthest, T.translation().cwiseAbs().maxCoeff());
  }
  EXPECT_GT(farthest, 0.9 * limit.translation);
}

TEST(CalibrationRig, NoiseHasTheStatedDeviation) {
  const Offset sigma{5e-4, 1.745e-3};
  double translation = 0, rotation = 0;
  const int count = 3000;
  for (int i = 0; i < count; ++i) {
    const Pose T = draw_noise(sigma, 7, i);
    translation += T.translation().squaredNorm() / (3.0 * count);
    rotation += std::pow(Eigen::AngleAxisd(T.linear()).angle(), 2) / (3.0 * count);
  }
  EXPECT_NEAR(std::sqrt(translation) / sigma.translation, 1.0, 0.04);
  EXPECT_NEAR(std::sqrt(rotation) / sigma.rotation, 1.0, 0.04);
}

TEST(CalibrationRig, CameraAndBoardAreOffInEverySceneAndTheConfigStaysNominal) {
  SimulatedCell cell(IWGNET_SOURCE_DIR);
  const CalibrationRig rig = load_calibration_rig(kConfig);
  const Pose nominal = cell.config().camera.T_base_color;
  EXPECT_TRUE(cell.camera().T_base_color.isApprox(nominal, 0.0));
  EXPECT_THROW(cell.T_tool_board(), Error);

  cell.offset_camera(3);
  cell.hold_board(cv::Mat(168, 224, CV_8UC1, cv::Scalar(255)), 3);
  cell.load_scene("", 0);
  const Pose camera = cell.camera().T_base_color;
  const Pose off = nominal.inverse() * camera;
  EXPECT_GT(off.translation().norm(), 1e-4);
  EXPECT_LE(off.translation().cwiseAbs().maxCoeff(), rig.camera_offset.translation);
  EXPECT_TRUE(cell.config().camera.T_base_color.isApprox(nominal, 0.0));
  const Pose board_off = rig.T_tool_board.inverse() * cell.T_tool_board();
  EXPECT_GT(board_off.translation().norm(), 1e-4);
  EXPECT_LE(board_off.translation().cwiseAbs().maxCoeff(), rig.board_offset.translation);
  EXPECT_TRUE(cell.arm().q.isApprox(rig.start_joints, 1e-9));
  cell.load_scene("", 1);
  EXPECT_TRUE(cell.camera().T_base_color.isApprox(camera, 0.0));

  // What is measured of the board scatters around where it is.
  const Pose truth = camera.inverse() * kinematics::forward(cell.arm().q) * cell.T_tool_board();
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (int i = 0; i < 400; ++i) mean += cell.measure_board(i).translation() / 400;
  EXPECT_LT((mean - truth.translation()).norm(), 4 * rig.pose_noise.translation / 20 * std::sqrt(3.0));
}

TEST(CalibrationRig, TheCameraSeesTheBoardsPrintWhereItIsHeld) {
  SimulatedCell cell(IWGNET_SOURCE_DIR);
  cell.hold_board(cv::Mat(168, 224, CV_8UC1, cv::Scalar(255)), 0);
  cell.load_scene("", 0);
  // A camera 0.3 m before the print, looking straight at it.
  const Pose T_base_board = kinematics::forward(cell.arm().q) * cell.T_tool_board();
  Pose T_board_camera = Pose::Identity();
  T_board_camera.linear() = Eigen::Vector3d(1, -1, -1).asDiagonal();
  T_board_camera.translation().z() = 0.3;
  const PinholeIntrinsics k{320, 240, 320, 320, 159.5, 119.5};
  cell.sync_renderer();
  const cv::Mat depth = cell.renderer().depth(k, T_base_board * T_board_camera);
  for (const auto& [u, v] : {std::pair{160, 120}, {60, 60}, {260, 180}})
    EXPECT_NEAR(depth.at<float>(v, u), 0.3, 1e-4);
}

}  // namespace
}  // namespace iwgnet_grasp::physics
