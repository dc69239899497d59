// Whole picks as planned: every place of the workspace into every slot, within limits, free of
// collision, part where it belongs; and clear refusals.
#include <gtest/gtest.h>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/pick_and_place.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::motion;

namespace {

const std::string kConfigDir = std::string(IWGNET_SOURCE_DIR) + "/config";
const CellConfig kCell = load_cell_config(kConfigDir);
const PickPlaceConfig kConfig = load_pick_place_config(kConfigDir);

PickRequest request(double x, double y, double z, double yaw, int slot, double along = 0.02) {
  PickRequest r;
  r.grasp.feasible = true;
  r.grasp.width = 0.02;
  r.grasp.opening = 0.05;
  r.grasp.T_base_tcp.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                                 Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX())).toRotationMatrix();
  r.grasp.T_base_tcp.translation() << x, y, z;
  r.centroid = r.grasp.T_base_tcp * Eigen::Vector3d(0.0, along, 0.005);
  r.tray_slot = slot;
  return r;
}

Pose tcp(const JointVector& q, double gap) { return kinematics::forward(q) * kinematics::T_tool0_tcp(gap); }

// What the camera measures of a surface: height(x, y) m over the table, NaN where the table is seen.
template <typename Height>
grasping::HeightMap heights_of(Height&& height) {
  const PinholeIntrinsics camera = kCell.camera.color;
  cv::Mat depth(camera.height, camera.width, CV_32FC1, cv::Scalar(0.6));
  for (int v = 0; v < camera.height; ++v)
    for (int u = 0; u < camera.width; ++u) {
      double h = 0.0;
      for (int i = 0; i < 4; ++i) {  // the point of the surface on the pixel's line of sight
        const double z = 0.6 - h;
        const double seen = height(0.5 + (u - camera.cx) / camera.fx * z, -(v - camera.cy) / camera.fy * z);
        h = std::isnan(seen) ? 0.0 : seen;
      }
      depth.at<float>(v, u) = static_cast<float>(0.6 - h);
    }
  return grasping::HeightMap(depth, camera, kCell.camera.T_base_color, kCell);
}

void expect_limits(const Trajectory& trajectory, const JointLimits& limits) {
  for (const TrajectoryPoint& p : trajectory) {
    EXPECT_LE((p.qd.cwiseAbs() - limits.max_velocity).maxCoeff(), 1e-9);
    EXPECT_LE((p.qdd.cwiseAbs() - limits.max_acceleration).maxCoeff(), 1e-9);
  }
}

}  // namespace

TEST(PlanPick, ReachesTheWholeWorkspaceAndEverySlot) {
  PickAndPlace picker(kCell, kConfig);
  const Eigen::Vector2d step = (kCell.workspace_max - kCell.workspace_min) / 4;
  int count = 0;
  for (int ix = 0; ix <= 4; ++ix)
    for (int iy = 0; iy <= 4; ++iy)
      for (int turn = 0; turn < 6; ++turn) {
        const double x = kCell.workspace_min.x() + ix * step.x(), y = kCell.workspace_min.y() + iy * step.y();
        const double z = count % 2 ? 0.022 : 0.07, yaw = -M_PI / 2 + turn * M_PI / 6;
        const PickRequest r = request(x, y, z, yaw, count++ % 10);
        PickPlan plan;
        const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
        ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;

        // Grasp: the TCP of the closed gripper, at either wrist turn.
        const Pose T_grasp = tcp(plan.approach.back().q, r.grasp.width);
        EXPECT_LT((T_grasp.translation() - r.grasp.T_base_tcp.translation()).norm(), 1e-6);
        EXPECT_NEAR(std::abs(T_grasp.linear().col(0).dot(r.grasp.T_base_tcp.linear().col(0))), 1.0, 1e-9);
        // Slot: closing along base x, the part's centroid over the slot's centre.
        const JointVector over = plan.carry.back().q;
        const JointVector low = plan.lower.empty() ? over : plan.lower.back().q;
        const Pose T_slot = tcp(low, r.grasp.width);
        EXPECT_NEAR(std::abs(T_slot(0, 0)), 1.0, 1e-6);
        const Eigen::Vector3d centroid = T_slot * (T_grasp.inverse() * r.centroid);
        const Eigen::Vector3d slot = kCell.tray.slots()[r.tray_slot];
        EXPECT_LT((centroid - slot).head<2>().norm(), 1e-6);
        EXPECT_GT(T_slot(2, 3) - kinematics::kPadHeight / 2, kCell.tray.floor_height);
        // One motion into the next, home at the end.
        EXPECT_LT((plan.approach.front().q - kCell.observe_joints).norm(), 1e-9);
        EXPECT_LT((plan.carry.front().q - plan.approach.back().q).norm(), 1e-9);
        if (!plan.lower.empty()) {
          EXPECT_LT((plan.lower.front().q - over).norm(), 1e-9);
        }
        EXPECT_LT((plan.retreat.front().q - low).norm(), 1e-9);
        EXPECT_LT((plan.retreat.back().q - kCell.observe_joints).norm(), 1e-9);
        expect_limits(plan.approach, kConfig.limits);
        expect_limits(plan.carry, kConfig.carry);
        expect_limits(plan.retreat, kConfig.limits);
      }
}

TEST(PlanPick, WideGraspsFitBesideTheTraysWalls) {
  PickAndPlace picker(kCell, kConfig);
  for (const int slot : {0, 4, 5, 9})
    for (const double width : {0.04, 0.055, 0.065}) {
      PickRequest r = request(0.5, 0.05, 0.022, 0.3, slot);
      r.grasp.width = width;
      r.grasp.opening = 0.08;
      PickPlan plan;
      const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
      EXPECT_EQ(result.reason, PickReason::kSucceeded) << result.message;
    }
}

TEST(PlanPick, APartHeldLengthwiseLiesAlongTheSlotToo) {
  PickAndPlace picker(kCell, kConfig);
  PickRequest r = request(0.5, 0.05, 0.022, 0.3, 2);
  r.grasp.width = 0.055;
  r.grasp.opening = 0.075;
  // 55 mm between the pads, 20 mm across them.
  const Eigen::Vector2d closing = r.grasp.T_base_tcp.linear().col(0).head<2>();
  picker.set_heights(heights_of([&](double x, double y) {
    const Eigen::Vector2d p(x - 0.5, y - 0.05);
    const bool on = std::abs(p.dot(closing)) < 0.0275 && std::abs(p.x() * closing.y() - p.y() * closing.x()) < 0.01;
    return on ? 0.03 : std::nan("");
  }));
  PickPlan plan;
  const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
  ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  const Pose T_grasp = tcp(plan.approach.back().q, r.grasp.width);
  const Pose T_slot = tcp(plan.carry.back().q, r.grasp.width);
  const Eigen::Vector3d axis = T_slot.linear() * (T_grasp.linear().transpose() * r.grasp.T_base_tcp.linear().col(0));
  EXPECT_NEAR(std::abs(axis.y()), 1.0, 1e-6);
  // The pads hold it by its middle.
  EXPECT_LT((T_slot.translation() - kCell.tray.slots()[2]).head<2>().norm(), 1e-6);
}

TEST(PlanPick, APartOfWhichLittleIsSeenLiesAcrossTheSlot) {
  // 22 mm between the pads and less than that seen across them: a part on its edge, whose ends lie
  // lower, not one that is held lengthwise.
  PickAndPlace picker(kCell, kConfig);
  const PickRequest r = request(0.5, 0.05, 0.022, 0.0, 2);
  picker.set_heights(heights_of([](double x, double y) {
    return std::abs(x - 0.5) < 0.011 && std::abs(y - 0.05) < 0.008 ? 0.03 : std::nan("");
  }));
  PickPlan plan;
  const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
  ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  EXPECT_NEAR(std::abs(tcp(plan.carry.back().q, r.grasp.width)(0, 0)), 1.0, 1e-6);
}

TEST(PlanPick, ThePadsStandAtThePartsSidesWhateverTheCentroidSays) {
  // A bar along base y, gripped 25 mm from its middle; a neighbour draws the centroid aside.
  PickAndPlace picker(kCell, kConfig);
  picker.set_heights(heights_of([](double x, double y) {
    return std::abs(x - 0.5) < 0.01 && std::abs(y - 0.025) < 0.05 ? 0.03 : std::nan("");
  }));
  PickRequest r = request(0.5, 0.0, 0.022, 0.0, 3);
  r.centroid = {0.52, 0.025, 0.02};
  PickPlan plan;
  const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
  ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  const Pose T_grasp = tcp(plan.approach.back().q, r.grasp.width);
  const Pose T_slot = tcp(plan.carry.back().q, r.grasp.width);
  const Eigen::Vector3d middle = T_slot * (T_grasp.inverse() * Eigen::Vector3d(0.5, 0.025, 0.022));
  EXPECT_LT((middle - kCell.tray.slots()[3]).head<2>().norm(), 0.003);
}

TEST(PlanPick, APartIsLoweredSlowlyFromWhereItMayTouchTheTray) {
  PickAndPlace picker(kCell, kConfig);
  const double floor = kCell.tray.floor_height + kConfig.release_height;
  for (const double z : {0.022, 0.05, 0.08, 0.16}) {
    // A part between pads at this height may reach down to the table.
    const double tips = z - kinematics::kPadHeight / 2, hang = std::min(tips, kConfig.max_hang);
    const PickRequest r = request(0.5, 0.0, z, 0.0, 3);
    PickPlan plan;
    ASSERT_EQ(picker.plan_pick(kCell.observe_joints, r, plan).reason, PickReason::kSucceeded);
    const auto tips_at = [&](const Trajectory& trajectory) {
      return tcp(trajectory.back().q, r.grasp.width).translation().z() - kinematics::kPadHeight / 2;
    };
    EXPECT_NEAR(tips_at(plan.carry), floor + hang, 1e-3);
    EXPECT_EQ(plan.lower.empty(), hang <= kConfig.max_fall);
    if (plan.lower.empty()) continue;
    EXPECT_NEAR(tips_at(plan.lower), floor + kConfig.max_fall, 1e-6);
    EXPECT_GT(plan.lower.back().time, (hang - kConfig.max_fall) / kConfig.lower_speed);
  }
}

TEST(PlanPick, ALeaningGripperMovesAlongItsApproachAndStandsUprightOverTheTray) {
  PickAndPlace picker(kCell, kConfig);
  for (const double roll : {-0.4, 0.0, 0.4})
    for (const double pitch : {-0.4, 0.4}) {
      PickRequest r = request(0.5, 0.05, 0.06, 0.3, 3);
      r.grasp.T_base_tcp.rotate(Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitY()) *
                                Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitX()));
      PickPlan plan;
      const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
      ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;
      const Pose& T = r.grasp.T_base_tcp;
      const Pose T_grasp = tcp(plan.approach.back().q, r.grasp.width);
      EXPECT_LT((T_grasp.translation() - T.translation()).norm(), 1e-6);
      EXPECT_NEAR(T_grasp.linear().col(2).dot(T.linear().col(2)), 1.0, 1e-9);
      const auto expect_on_the_line = [&](const Trajectory& trajectory) {
        for (const TrajectoryPoint& p : trajectory) {
          const Eigen::Vector3d away = tcp(p.q, r.grasp.width).translation() - T.translation();
          if (away.norm() < kConfig.approach_height / 2) {
            EXPECT_LT(away.cross(T.linear().col(2)).norm(), 0.002);
          }
        }
      };
      expect_on_the_line(plan.approach);
      expect_on_the_line(plan.carry);
      EXPECT_NEAR(tcp(plan.carry.back().q, r.grasp.width)(2, 2), -1.0, 1e-6);
    }
}

TEST(PlanPick, TrajectoriesAreFreeOfCollisionBetweenTheirSamples) {
  PickAndPlace picker(kCell, kConfig);
  CollisionWorld world(kCell);
  for (const double x : {0.36, 0.5, 0.64})
    for (const int slot : {0, 4, 5, 9}) {
      const PickRequest r = request(x, -0.1, 0.022, 0.4, slot);
      PickPlan plan;
      ASSERT_EQ(picker.plan_pick(kCell.observe_joints, r, plan).reason, PickReason::kSucceeded);
      const auto expect_free = [&](const Trajectory& t, double gap) {
        world.set_gripper_gap(gap);
        for (double time = 0; time < t.back().time; time += 0.001)
          EXPECT_EQ(world.describe(sample(t, time).q), "");
      };
      expect_free(plan.approach, r.grasp.opening);
      expect_free(plan.carry, r.grasp.width);
      expect_free(plan.retreat, r.grasp.width + kConfig.release_margin);
    }
}

TEST(PlanPick, TheToolIsSlowNearTheTable) {
  PickAndPlace picker(kCell, kConfig);
  PickPlan plan;
  const PickRequest r = request(0.5, 0.0, 0.022, 0.0, 3);
  ASSERT_EQ(picker.plan_pick(kCell.observe_joints, r, plan).reason, PickReason::kSucceeded);
  const auto tool_speed = [](const TrajectoryPoint& p) {
    return (kinematics::jacobian(p.q) * p.qd).head<3>().norm();
  };
  for (const TrajectoryPoint& p : plan.approach)
    if (tcp(p.q, r.grasp.width).translation().z() < 0.022 + kConfig.approach_height / 2) {
      EXPECT_LE(tool_speed(p), kConfig.approach_speed + 1e-6);
      // Straight down.
      EXPECT_LT((tcp(p.q, r.grasp.width).translation() - r.grasp.T_base_tcp.translation()).head<2>().norm(), 0.002);
    }
  double fastest = 0;
  for (const TrajectoryPoint& p : plan.carry) fastest = std::max(fastest, tool_speed(p));
  EXPECT_GT(fastest, 2 * kConfig.lift_speed);
}

TEST(PlanPick, KeepsClearOfPartsOnTheWay) {
  // A pile 100 mm high between the observing pose and the grasp.
  const PinholeIntrinsics camera = kCell.camera.color;
  cv::Mat depth(camera.height, camera.width, CV_32FC1, cv::Scalar(0.6));
  const auto row = [&](double y, double h) { return static_cast<int>(camera.cy - y * camera.fy / (0.6 - h)); };
  depth.rowRange(row(0.20, 0.1), row(0.10, 0.1)).setTo(0.5);
  const grasping::HeightMap heights(depth, camera, kCell.camera.T_base_color, kCell);
  PickAndPlace picker(kCell, kConfig);
  picker.set_heights(heights);
  PickPlan plan;
  const PickRequest r = request(0.5, -0.08, 0.022, 0.0, 3);
  const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
  ASSERT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  CollisionWorld world(kCell);
  world.set_heights(heights);
  world.set_gripper_gap(r.grasp.opening);
  for (double time = 0; time < plan.approach.back().time; time += 0.002)
    EXPECT_EQ(world.describe(sample(plan.approach, time).q), "");
}

TEST(PlanPick, RefusesInOneClearLine) {
  PickAndPlace picker(kCell, kConfig);
  PickPlan plan;
  const auto refuse = [&](PickRequest r, PickReason reason, const std::string& word) {
    const PickResult result = picker.plan_pick(kCell.observe_joints, r, plan);
    EXPECT_EQ(result.reason, reason) << result.message;
    EXPECT_NE(result.message.find(word), std::string::npos) << result.message;
    EXPECT_EQ(result.message.find('\n'), std::string::npos);
  };
  PickRequest r = request(0.5, 0.0, 0.022, 0.0, 0);
  r.grasp.feasible = false;
  r.grasp.reason = "no depth";
  refuse(r, PickReason::kInfeasible, "no depth");
  r = request(0.5, 0.0, 0.022, 0.0, 0);
  r.grasp.T_base_tcp.translation().x() = std::nan("");
  refuse(r, PickReason::kInfeasible, "finite");
  r = request(0.5, 0.0, 0.022, 0.0, 10);
  refuse(r, PickReason::kInfeasible, "slot 10");
  r = request(0.5, 0.0, 0.022, 0.0, 0);
  r.grasp.opening = 0.2;
  refuse(r, PickReason::kInfeasible, "2F-85");
  refuse(request(1.1, 0.0, 0.022, 0.0, 0), PickReason::kUnreachable, "reach");
  refuse(request(0.5, 0.0, 0.005, 0.0, 0), PickReason::kUnreachable, "table");
}

TEST(LoadPickPlaceConfig, NamesTheFileAndTheKey) {
  try {
    load_pick_place_config("/nonexistent");
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("motion.yaml"), std::string::npos);
  }
}
