// The trajectory controller's verdicts and the gripper's stall, as the drivers give them.
#include <gtest/gtest.h>

#include "physics_rig.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kStep = 1.0 / 480;

motion::Trajectory ramp(const JointVector& from, const JointVector& to, double duration) {
  const JointVector zero = JointVector::Zero();
  return {{0.0, from, zero, zero}, {duration, to, zero, zero}};
}

ArmState arm_at(const JointVector& q) { return {q, JointVector::Zero(), JointVector::Zero()}; }

// An arm that follows its set point after one step, off by `error`.
TrajectoryStatus follow(TrajectoryController& controller, ArmState arm, const JointVector& error,
                        double seconds) {
  for (int i = 0; i <= std::lround(seconds / kStep); ++i) {
    const auto set = controller.update(i * kStep, arm);
    arm.qd = set.qd;
    arm.q = set.q + error;
  }
  return controller.status();
}

class Controller : public ::testing::Test {
 protected:
  JointVector from = JointVector::Zero(), to = JointVector::Constant(0.5);
  TrajectoryController controller{JointVector::Zero()};
};

TEST_F(Controller, SucceedsAtTheEnd) {
  ASSERT_EQ(controller.start(ramp(from, to, 1.0), default_tolerances(), 0.0, arm_at(from)), "");
  EXPECT_EQ(follow(controller, arm_at(from), JointVector::Zero(), 0.9), TrajectoryStatus::kActive);
  ASSERT_EQ(controller.start(ramp(from, to, 1.0), default_tolerances(), 0.0, arm_at(from)), "");
  EXPECT_EQ(follow(controller, arm_at(from), JointVector::Zero(), 1.1),
            TrajectoryStatus::kSucceeded);
  EXPECT_LT((controller.desired().q - to).norm(), 1e-12);
}

TEST_F(Controller, AbortsOffThePathAndHolds) {
  ASSERT_EQ(controller.start(ramp(from, to, 1.0), default_tolerances(), 0.0, arm_at(from)), "");
  JointVector error = JointVector::Zero();
  error[2] = 0.25;  // tolerance 0.2
  EXPECT_EQ(follow(controller, arm_at(from), error, 0.5), TrajectoryStatus::kPathViolated);
  EXPECT_NE(controller.message().find("elbow_joint"), std::string::npos);
  EXPECT_EQ(controller.desired().qd, JointVector::Zero());
}

TEST_F(Controller, ChecksNoPathWhereTheToleranceIsNegative) {
  TrajectoryTolerances tolerances = default_tolerances();
  tolerances.path.setConstant(-1.0);
  ASSERT_EQ(controller.start(ramp(from, to, 1.0), tolerances, 0.0, arm_at(from)), "");
  const JointVector error = JointVector::Constant(0.25);
  EXPECT_EQ(follow(controller, arm_at(from), error, 1.5), TrajectoryStatus::kActive);
  EXPECT_EQ(follow(controller, arm_at(from), error, 1.7), TrajectoryStatus::kGoalViolated);
}

// An arm that has arrived but is never slow: what tells rest is how far it goes.
TEST_F(Controller, TremblingIsRestAndCreepingIsNot) {
  const auto ends = [&](double way, double speed) {
    EXPECT_EQ(controller.start(ramp(from, to, 0.1), default_tolerances(), 0.0, arm_at(from)), "");
    for (int i = 0; i <= std::lround(0.9 / kStep); ++i) {
      ArmState arm = arm_at(controller.desired().q);
      arm.q[5] += way * (i % 2 ? 1 : -1) + speed * (i * kStep - 0.1);
      arm.qd[5] = 0.2;
      controller.update(i * kStep, arm);
    }
    return controller.status();
  };
  EXPECT_EQ(ends(0.0003, 0.0), TrajectoryStatus::kSucceeded);
  EXPECT_EQ(ends(0.0, 0.1), TrajectoryStatus::kGoalViolated);
}

TEST_F(Controller, RefusesBadTrajectories) {
  const auto refusal = [&](const motion::Trajectory& t) {
    return controller.start(t, default_tolerances(), 0.0, arm_at(from));
  };
  EXPECT_NE(refusal({}), "");
  motion::Trajectory t = ramp(from, to, 1.0);
  t[1].q[3] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_NE(refusal(t).find("point 1"), std::string::npos);
  t = ramp(from, to, 1.0);
  t[1].time = 0.0;
  EXPECT_NE(refusal(t).find("time"), std::string::npos);
  EXPECT_NE(refusal(ramp(to, from, 1.0)).find("too far"), std::string::npos);
  EXPECT_EQ(controller.status(), TrajectoryStatus::kIdle);
}

TEST(GripperAction, StallsOnAPartAndReachesWithoutOne) {
  for (const bool part : {false, true}) {
    Rig rig({0.5, 0.0, 0.022}, 0.020);
    if (part) rig.world.add_part(block({0.06, 0.020, 0.04}, 0.3), at(0.5, 0.0, 0.0201));
    rig.grip(0.060, 40.0, 0.6);
    EXPECT_TRUE(rig.gripper.status().reached);
    rig.grip(0.0, 40.0, 1.2);
    EXPECT_FALSE(rig.gripper.status().active);
    EXPECT_EQ(rig.gripper.status().stalled, part);
    EXPECT_EQ(rig.gripper.status().reached, !part);
  }
}

}  // namespace
}  // namespace iwgnet_grasp::physics
