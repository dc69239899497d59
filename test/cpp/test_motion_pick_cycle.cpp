// Picks carried out on the simulated cell: what happens when they succeed, miss, are cancelled, fail
// on the way.
#include <gtest/gtest.h>

#include <fstream>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/physics/simulated_cell.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::motion;
using namespace iwgnet_grasp::physics;

namespace {

const std::string kSource = IWGNET_SOURCE_DIR;

// The simulated robot with a fault: the arm stops halfway along one of its trajectories.
class StoppingRobot : public SimulatedRobot {
 public:
  StoppingRobot(SimulatedCell& cell, int stop_at) : SimulatedRobot(cell), stop_at_(stop_at) {}
  ExecutionResult execute(const Trajectory& trajectory) override {
    if (count_++ != stop_at_) return SimulatedRobot::execute(trajectory);
    const TrajectoryPoint middle = sample(trajectory, trajectory.back().time / 2);
    PathLeg leg;
    for (const TrajectoryPoint& p : trajectory)
      if (p.time <= middle.time) leg.path.push_back(p.q);
    leg.limits = {JointVector::Constant(1.0), JointVector::Constant(2.0)};
    SimulatedRobot::execute(time_parametrize({leg}));
    return {false, "stopped by the operator"};
  }

 private:
  int count_ = 0, stop_at_;
};

class PickCycle : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    if (std::ifstream(kSource + "/assets/parts/rod_098/part.yaml"))
      cell = new SimulatedCell(kSource, kSource + "/config");
  }
  static void TearDownTestSuite() { delete cell; }
  void SetUp() override {
    if (!cell) GTEST_SKIP() << "the part library is not there: run scripts/setup";
    cell->load_scene("five_scattered", 0);
    picker = std::make_unique<PickAndPlace>(cell->config(), load_pick_place_config(kSource + "/config"));
  }

  // Across the shank of a rod that lies flat, 12 mm from its centre of mass towards the small end, by
  // ground truth.
  PickRequest grasp(int part, int slot) const {
    const Pose T = cell->world().part(part).T_base_part;
    const double yaw = std::atan2(T(1, 0), T(0, 0)) + M_PI / 2;
    PickRequest r;
    r.grasp.feasible = true;
    r.grasp.width = 0.020;
    r.grasp.opening = 0.050;
    r.grasp.T_base_tcp.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                                   Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX())).toRotationMatrix();
    double left = 0, right = 0;  // half widths of the ends
    for (const auto& v : cell->models()[part].mesh.vertices)
      (v.x() < 0 ? left : right) = std::max<double>(v.x() < 0 ? left : right, std::abs(v.y()));
    r.grasp.T_base_tcp.translation() = T * Eigen::Vector3d(left > right ? 0.012 : -0.012, 0, 0);
    r.grasp.T_base_tcp.translation().z() = 0.0225;
    r.centroid = T.translation();
    r.tray_slot = slot;
    return r;
  }
  bool in_tray(int part) const {
    const TrayConfig& tray = cell->config().tray;
    const Eigen::Vector3d p = cell->world().part(part).T_base_part.translation();
    return ((p.head<2>() - tray.center).cwiseAbs().array() < tray.inner_size.array() / 2).all();
  }
  double moved(int part, const Pose& before) const {
    return (cell->world().part(part).T_base_part.translation() - before.translation()).norm();
  }
  void expect_observing() const {
    EXPECT_LT((cell->arm().q - cell->config().observe_joints).cwiseAbs().maxCoeff(), 0.02);
  }

  static SimulatedCell* cell;
  std::unique_ptr<PickAndPlace> picker;
};
SimulatedCell* PickCycle::cell = nullptr;

}  // namespace

TEST_F(PickCycle, PutsThePartIntoItsSlot) {
  SimulatedRobot robot(*cell);
  std::vector<std::string> phases;
  const PickResult result = picker->run(robot, grasp(1, 7), [&](const std::string& phase) {
    phases.push_back(phase);
    return true;
  });
  EXPECT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  EXPECT_EQ(phases, (std::vector<std::string>{"approach", "grasp", "lift", "transfer", "release", "return"}));
  cell->step(240);
  const Eigen::Vector3d slot = cell->config().tray.slots()[7];
  const Pose T = cell->world().part(1).T_base_part;
  EXPECT_LT((T.translation() - slot).head<2>().norm(), 0.015);
  EXPECT_GT(std::abs(T(1, 0)), 0.97);  // long axis along the tray's y
  EXPECT_LT(cell->time(), 7.2);        // 500 picks an hour
  expect_observing();
}

TEST_F(PickCycle, MissesWhereNothingLies) {
  SimulatedRobot robot(*cell);
  PickRequest r = grasp(0, 0);
  r.grasp.T_base_tcp.translation().head<2>() = Eigen::Vector2d(0.5, 0.32);  // beside all parts
  r.centroid = r.grasp.T_base_tcp.translation();
  const PickResult result = picker->run(robot, r);
  EXPECT_EQ(result.reason, PickReason::kMissed) << result.message;
  EXPECT_NE(result.message.find("closed on nothing"), std::string::npos);
  EXPECT_GT(cell->gripper().gap, 0.045);
  expect_observing();
}

TEST_F(PickCycle, CancelledBeforeTheLiftLeavesThePart) {
  SimulatedRobot robot(*cell);
  const Pose before = cell->world().part(2).T_base_part;
  const PickResult result =
      picker->run(robot, grasp(2, 0), [](const std::string& phase) { return phase != "lift"; });
  EXPECT_EQ(result.reason, PickReason::kExecutionFailed);
  EXPECT_NE(result.message.find("cancelled"), std::string::npos);
  EXPECT_LT(moved(2, before), 0.02);
  expect_observing();
}

TEST_F(PickCycle, PushesAPartAsideWithoutAttemptingToGraspIt) {
  SimulatedRobot robot(*cell);
  const CameraConfig& camera = cell->config().camera;
  picker->set_heights(grasping::HeightMap(cell->ideal_depth(), camera.color, camera.T_base_color,
                                          cell->config()));
  const Pose before = cell->world().part(1).T_base_part;
  const double start = cell->time();
  Eigen::Vector3d seen = before.translation();
  seen.z() *= 2;  // it lies on the table: the middle of its upper side
  const PickResult result = picker->push(robot, {seen});
  EXPECT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  EXPECT_GT(moved(1, before), 0.02);
  EXPECT_LT(moved(1, before), 0.15);
  EXPECT_LT(cell->time() - start, 5.0);
  const Verdict verdict = cell->verdict();
  EXPECT_TRUE(verdict.picks.empty());
  EXPECT_TRUE(verdict.collisions.empty());
  EXPECT_EQ(verdict.on_table, verdict.parts);
  expect_observing();
  EXPECT_EQ(picker->push(robot, {}).reason, PickReason::kUnreachable);
}

TEST_F(PickCycle, StoppedOnTheWayToThePart) {
  StoppingRobot robot(*cell, 0);
  const Pose before = cell->world().part(3).T_base_part;
  const PickResult result = picker->run(robot, grasp(3, 0));
  EXPECT_EQ(result.reason, PickReason::kExecutionFailed);
  EXPECT_NE(result.message.find("stopped by the operator"), std::string::npos);
  EXPECT_LT(moved(3, before), 0.002);
  expect_observing();
}

TEST_F(PickCycle, StoppedWithThePartPutsItBack) {
  StoppingRobot robot(*cell, 1);
  const Pose before = cell->world().part(4).T_base_part;
  const PickResult result = picker->run(robot, grasp(4, 0));
  EXPECT_EQ(result.reason, PickReason::kExecutionFailed);
  cell->step(240);
  EXPECT_LT(moved(4, before), 0.03);
  EXPECT_FALSE(in_tray(4));
  EXPECT_GT(cell->gripper().gap, 0.03);
  expect_observing();
}

TEST_F(PickCycle, ComesHomeFromContact) {
  SimulatedRobot robot(*cell);
  PickPlan plan;
  ASSERT_EQ(picker->plan_pick(cell->config().observe_joints, grasp(0, 0), plan).reason, PickReason::kSucceeded);
  ASSERT_TRUE(robot.execute(plan.approach).success);
  PickAndPlace fresh(cell->config(), load_pick_place_config(kSource + "/config"));
  const PickResult result = fresh.observe(robot);
  EXPECT_EQ(result.reason, PickReason::kSucceeded) << result.message;
  expect_observing();
}

TEST_F(PickCycle, LowersAPartUntilItTouches) {
  SimulatedRobot robot(*cell);
  const PickPlaceConfig config = load_pick_place_config(kSource + "/config");
  PickPlan plan;
  ASSERT_EQ(picker->plan_pick(cell->config().observe_joints, grasp(1, 0), plan).reason, PickReason::kSucceeded);
  ASSERT_TRUE(robot.execute(plan.approach).success);
  ASSERT_TRUE(robot.grip(0.0, config.grip_force).success);
  const double lying = cell->world().part(1).T_base_part.translation().z();

  const CollisionWorld world(cell->config());
  const auto straight = [&](double up, double speed) {
    const JointVector q = robot.joints();
    Pose T = kinematics::forward(q);
    T.translation().z() += up;
    PathLeg leg;
    leg.path = plan_straight(world, q, T, false).path;
    leg.limits = config.carry;
    leg.max_tool_speed = speed;
    return time_parametrize({leg});
  };
  ASSERT_TRUE(robot.execute(straight(0.030, config.lift_speed)).success);
  // Nothing is in the way of 20 mm.
  ExecutionResult moved = robot.execute_until_contact(straight(-0.020, config.lower_speed), config.contact_tolerance);
  EXPECT_TRUE(moved.success && !moved.contact) << moved.message;
  // The table is in the way of 30 mm more, after 10.
  moved = robot.execute_until_contact(straight(-0.030, config.lower_speed), config.contact_tolerance);
  EXPECT_TRUE(moved.success && moved.contact) << moved.message;
  EXPECT_NEAR(cell->world().part(1).T_base_part.translation().z(), lying, 0.001);
  EXPECT_TRUE(cell->verdict().collisions.empty()) << cell->verdict().collisions.front();
}
