// The simulated cell as a whole: same seed, same bits; time, controllers and camera work together.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <opencv2/core.hpp>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/trajectory.h"
#include "iwgnet_grasp/physics/simulated_cell.h"

namespace iwgnet_grasp::physics {
namespace {

class Cell : public ::testing::Test {
 protected:
  static void SetUpTestSuite() { cell_ = new SimulatedCell(IWGNET_SOURCE_DIR); }
  static void TearDownTestSuite() {
    delete cell_;
    cell_ = nullptr;
  }
  static SimulatedCell* cell_;

  // Straight joint motion within the UR5's limits.
  static motion::Trajectory straight(const JointVector& from, const JointVector& to) {
    const motion::JointLimits limits{JointVector::Constant(1.5), JointVector::Constant(3.0)};
    return motion::time_parametrize({from, to}, limits);
  }
};
SimulatedCell* Cell::cell_ = nullptr;

bool same_bits(const cv::Mat& a, const cv::Mat& b) {
  if (a.size() != b.size() || a.type() != b.type()) return false;
  for (int row = 0; row < a.rows; ++row)
    if (std::memcmp(a.ptr(row), b.ptr(row), a.cols * a.elemSize()) != 0) return false;
  return true;
}

TEST_F(Cell, SameSeedGivesTheSameSceneAndTheSameImagesToTheBit) {
  ASSERT_EQ(cell_->load_scene("five_scattered", 11), 5);
  std::vector<Eigen::Matrix4d> poses;
  for (int i = 0; i < 5; ++i) poses.push_back(cell_->world().part(i).T_base_part.matrix());
  const cv::Mat color = cell_->color().clone(), depth = cell_->depth().clone();

  // What happened in between must not matter.
  SimulatedRobot robot(*cell_);
  robot.grip(0.02, 40.0);
  cell_->load_scene("seven_stacked", 3);

  ASSERT_EQ(cell_->load_scene("five_scattered", 11), 5);
  for (int i = 0; i < 5; ++i)
    EXPECT_EQ(poses[i], cell_->world().part(i).T_base_part.matrix()) << "part " << i;
  EXPECT_TRUE(same_bits(color, cell_->color()));
  EXPECT_TRUE(same_bits(depth, cell_->depth()));
  // A second look draws other noise.
  EXPECT_FALSE(same_bits(depth, cell_->depth()));
}

TEST_F(Cell, AnotherSeedGivesAnotherScene) {
  cell_->load_scene("five_scattered", 1);
  const Eigen::Matrix4d first = cell_->world().part(0).T_base_part.matrix();
  cell_->load_scene("five_scattered", 2);
  EXPECT_GT((first - cell_->world().part(0).T_base_part.matrix()).norm(), 1e-3);
}

TEST_F(Cell, AnUnknownSceneIsAnErrorThatNamesTheKnownOnes) {
  try {
    cell_->load_scene("six_flying", 0);
    FAIL() << "no error";
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("five_scattered"), std::string::npos) << error.what();
  }
}

TEST_F(Cell, TimeAdvancesByTheStep) {
  cell_->load_scene("", 0);
  const double start = cell_->time();
  cell_->step(480);
  EXPECT_NEAR(cell_->time() - start, 480 * cell_->timestep(), 1e-9);
  EXPECT_NEAR(cell_->timestep(), 1.0 / 480.0, 1e-12);
}

TEST_F(Cell, RobotFollowsATrajectoryToItsEndAndComesToRest) {
  cell_->load_scene("", 0);
  SimulatedRobot robot(*cell_);
  const JointVector from = robot.joints();
  JointVector to = from;
  to[0] -= 0.6;
  to[4] += 0.3;
  const motion::Trajectory trajectory = straight(from, to);
  const double start = cell_->time();
  const motion::ExecutionResult result = robot.execute(trajectory);
  ASSERT_TRUE(result.success) << result.message;
  EXPECT_LT((robot.joints() - to).cwiseAbs().maxCoeff(), 2e-3);
  EXPECT_LT(cell_->arm().qd.cwiseAbs().maxCoeff(), 0.011);
  EXPECT_GE(cell_->time() - start, trajectory.back().time - cell_->timestep());
  EXPECT_LT(cell_->time() - start, trajectory.back().time + 1.5);
}

TEST_F(Cell, RobotRefusesATrajectoryThatStartsElsewhere) {
  cell_->load_scene("", 0);
  SimulatedRobot robot(*cell_);
  JointVector far = robot.joints();
  far[1] += 0.5;
  JointVector to = far;
  to[1] += 0.2;
  const double start = cell_->time();
  const motion::ExecutionResult result = robot.execute(straight(far, to));
  EXPECT_FALSE(result.success);
  EXPECT_FALSE(result.message.empty());
  EXPECT_LT(cell_->time() - start, 2.0);
}

TEST_F(Cell, GripperReachesItsGapsAndStopsOnNothingInEmptyAir) {
  cell_->load_scene("", 0);
  SimulatedRobot robot(*cell_);
  for (const double gap : {0.03, 0.085, 0.005}) {
    const motion::GripResult result = robot.grip(gap, 40.0);
    EXPECT_TRUE(result.success) << result.message;
    EXPECT_FALSE(result.stalled);
    EXPECT_NEAR(result.gap, gap, 2e-3);
  }
}

TEST_F(Cell, IdealDepthShowsTheTableWhereTheCameraConfigPutsIt) {
  cell_->load_scene("", 0);
  const cv::Mat depth = cell_->ideal_depth();
  const CameraConfig& camera = cell_->camera();
  const double height = camera.T_base_color.translation().z();
  EXPECT_NEAR(depth.at<float>(depth.rows / 2, depth.cols / 2), height, 1e-4);
  double low, high;
  cv::minMaxLoc(cell_->part_mask(), &low, &high);
  EXPECT_EQ(high, -1);
}

TEST_F(Cell, MaskShowsEveryScatteredPartWhereItLies) {
  const int parts = cell_->load_scene("five_scattered", 4);
  const cv::Mat mask = cell_->part_mask();
  const std::vector<double> outlines = cell_->unoccluded_areas();
  ASSERT_EQ(static_cast<int>(outlines.size()), parts);
  for (int i = 0; i < parts; ++i) {
    const double seen = cv::countNonZero(mask == i);
    EXPECT_GT(seen, 500) << "part " << i;
    // Nothing lies on a scattered part; the outline is counted on a grid four times coarser.
    EXPECT_NEAR(seen / outlines[i], 1.0, 0.1) << "part " << i;
  }
}

TEST_F(Cell, NoiseOfTheCameraIsSmallAgainstTheIdealDepth) {
  cell_->load_scene("five_scattered", 5);
  const cv::Mat ideal = cell_->ideal_depth();
  const cv::Mat measured = cell_->aligned_depth(cell_->depth());
  ASSERT_EQ(measured.size(), ideal.size());
  std::vector<double> errors;
  // The workspace, not the rim where only one imager looks.
  for (int row = 250; row < 550; ++row)
    for (int column = 450; column < 830; ++column) {
      const float d = measured.at<float>(row, column);
      if (std::isfinite(d)) errors.push_back(std::abs(d - ideal.at<float>(row, column)));
    }
  ASSERT_GT(errors.size(), 0.8 * 300 * 380);
  std::nth_element(errors.begin(), errors.begin() + errors.size() / 2, errors.end());
  EXPECT_LT(errors[errors.size() / 2], 1e-3);
}

}  // namespace
}  // namespace iwgnet_grasp::physics
