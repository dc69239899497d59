// Paths: free of collision at fine resolution, straight where asked, clear when there is none.
#include <gtest/gtest.h>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/planner.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::motion;

namespace {

const PlannerConfig kConfig{2.0, 0.02, 7};

CellConfig cell() { return load_cell_config(std::string(IWGNET_SOURCE_DIR) + "/config"); }

Pose tool_down(double x, double y, double z, double yaw = 0.0) {
  Pose T = Pose::Identity();
  T.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX())).toRotationMatrix();
  T.translation() << x, y, z;
  return T * kinematics::T_tool0_tcp(0.085).inverse();
}

JointVector joints(const Pose& T_base_tool0, const JointVector& near) {
  const auto solutions = kinematics::inverse(T_base_tool0);
  JointVector best = JointVector::Constant(100);
  for (int i = 0; i < solutions.count; ++i) {
    const JointVector q = kinematics::nearest_turn(solutions.q[i], near);
    if ((q - near).norm() < (best - near).norm()) best = q;
  }
  return best;
}

// A cell with a wall across the way from the tray to the workspace.
CellConfig walled() {
  CellConfig config = cell();
  config.camera_mount.push_back({{0.45, 0.26, 0.15}, {0.30, 0.02, 0.30}});
  return config;
}

void expect_free(const CollisionWorld& world, const JointPath& path) {
  for (std::size_t i = 1; i < path.size(); ++i)
    EXPECT_TRUE(straight_joint_motion_is_free(world, path[i - 1], path[i], 0.004));
}

}  // namespace

TEST(Plan, TakesTheStraightJointMotionWhereItIsFree) {
  const CollisionWorld world(cell());
  const JointVector from = cell().observe_joints, to = joints(tool_down(0.5, 0.0, 0.12), from);
  const PlanResult result = plan(world, from, to, kConfig);
  ASSERT_TRUE(result.success) << result.message;
  EXPECT_EQ(result.path.size(), 2u);
  expect_free(world, result.path);
}

TEST(Plan, GoesAroundObstacles) {
  const CollisionWorld world(walled());
  const JointVector from = cell().observe_joints;
  for (const double x : {0.40, 0.45, 0.50, 0.55}) {
    const JointVector to = joints(tool_down(x, 0.05, 0.10), from);
    ASSERT_FALSE(straight_joint_motion_is_free(world, from, to, 0.02));
    const PlanResult result = plan(world, from, to, kConfig);
    ASSERT_TRUE(result.success) << result.message;
    EXPECT_EQ(result.path.front(), from);
    EXPECT_EQ(result.path.back(), to);
    expect_free(world, result.path);
    double length = 0;
    for (std::size_t i = 1; i < result.path.size(); ++i) length += (result.path[i] - result.path[i - 1]).norm();
    EXPECT_LT(length, 4 * (to - from).norm() + 2);  // shortened, no wild detour
  }
}

TEST(Plan, TheSameSeedGivesTheSamePath) {
  const CollisionWorld world(walled());
  const JointVector from = cell().observe_joints, to = joints(tool_down(0.5, 0.0, 0.10), from);
  const PlanResult a = plan(world, from, to, kConfig), b = plan(world, from, to, kConfig);
  ASSERT_TRUE(a.success && b.success);
  ASSERT_EQ(a.path.size(), b.path.size());
  for (std::size_t i = 0; i < a.path.size(); ++i) EXPECT_EQ(a.path[i], b.path[i]);
}

TEST(Plan, SaysWhyThereIsNoPath) {
  const CollisionWorld world(cell());
  const JointVector from = cell().observe_joints;
  const JointVector in_table = joints(tool_down(0.5, 0.0, -0.05), from);
  const PlanResult blocked = plan(world, from, in_table, kConfig);
  EXPECT_FALSE(blocked.success);
  EXPECT_NE(blocked.message.find("goal"), std::string::npos);
  EXPECT_NE(blocked.message.find("table"), std::string::npos);
  JointVector turned = from;
  turned[2] = 3.5;
  EXPECT_FALSE(plan(world, from, turned, kConfig).success);
  EXPECT_FALSE(plan(world, from, JointVector::Constant(std::nan("")), kConfig).success);

  CellConfig closed = cell();  // a roof and walls around the workspace
  closed.camera_mount.push_back({{0.5, 0.0, 0.47}, {0.8, 0.6, 0.02}});
  for (const double side : {-1.0, 1.0}) {
    closed.camera_mount.push_back({{0.5, side * 0.3, 0.24}, {0.8, 0.02, 0.48}});
    closed.camera_mount.push_back({{0.5 + side * 0.4, 0.0, 0.24}, {0.02, 0.6, 0.48}});
  }
  const CollisionWorld box(closed);
  PlannerConfig brief = kConfig;
  brief.max_time = 0.1;
  JointVector inside = joints(tool_down(0.5, 0.0, 0.05), from);
  EXPECT_FALSE(plan(box, from, inside, brief).success);
}

TEST(PlanStraight, KeepsTheToolOnTheLine) {
  const CollisionWorld world(cell());
  const Pose high = tool_down(0.5, 0.1, 0.15, 0.7), low = tool_down(0.5, 0.1, 0.03, 0.7);
  const JointVector from = joints(high, cell().observe_joints);
  const PlanResult result = plan_straight(world, from, low, true);
  ASSERT_TRUE(result.success) << result.message;
  EXPECT_LT((kinematics::forward(result.path.back()).matrix() - low.matrix()).cwiseAbs().maxCoeff(), 1e-9);
  EXPECT_LT(result.path.size(), 12u);
  for (std::size_t i = 1; i < result.path.size(); ++i)
    for (double t = 0; t <= 1; t += 0.1) {
      const Pose T = kinematics::forward(result.path[i - 1] + t * (result.path[i] - result.path[i - 1]));
      EXPECT_LT((T.translation() - high.translation()).head<2>().norm(), 0.0007);
      EXPECT_LT(T(2, 2), -0.9999);
    }
}

TEST(PlanStraight, SaysWhyNot) {
  const CollisionWorld world(cell());
  const JointVector from = joints(tool_down(0.5, 0.0, 0.10), cell().observe_joints);
  const PlanResult into_table = plan_straight(world, from, tool_down(0.5, 0.0, -0.02), true);
  EXPECT_FALSE(into_table.success);
  EXPECT_NE(into_table.message.find("table"), std::string::npos);
  EXPECT_TRUE(plan_straight(world, from, tool_down(0.5, 0.0, -0.02), false).success);
  const PlanResult far = plan_straight(world, from, tool_down(1.2, 0.0, 0.10), false);
  EXPECT_FALSE(far.success);
  EXPECT_NE(far.message.find("reach"), std::string::npos);
}
