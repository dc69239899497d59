// Verdicts on what real physics did.
#include <gtest/gtest.h>

#include "physics_rig.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kWidth = 0.020;       // m, of the block that is picked
constexpr double kGraspHeight = 0.022;  // m, pads' midpoint over the table

struct Trial : Rig {
  Trial() : Rig({0.5, 0.0, kGraspHeight + 0.10}, kWidth) {
    world.add_part(block({0.12, kWidth, 0.024}, 0.4), at(0.5, 0.0, 0.0121));
    judge.reset(world);
    grip(0.085, 40.0, 0.3);
  }
  void pick() {
    move({0.5, 0.0, kGraspHeight}, 0.2, 1.0);
    grip(0.0, 40.0);
    move({0.5, 0.0, 0.20}, 0.5, 2.0);
  }
  void place() {
    const double x = cell.tray.center.x(), y = cell.tray.center.y();
    move({x, y, 0.20}, 0.4, 1.5);
    move({x, y, kGraspHeight + cell.tray.floor_height + 0.003}, 0.2, 1.0);
    grip(0.060, 40.0, 0.5);
    move({x, y, 0.20}, 0.3, 1.0);
    hold(0.5);
  }
  Verdict verdict() { return judge.verdict(world); }
};

TEST(JudgeOfATrial, PassesAPickIntoTheTray) {
  Trial trial;
  trial.pick();
  trial.place();
  const Verdict v = trial.verdict();
  EXPECT_TRUE(v.success) << to_json(v);
  ASSERT_EQ(v.picks.size(), 1u);
  EXPECT_EQ(v.picks[0].part, 0);
  EXPECT_LT(v.picks[0].slip_mm, 1.0);
  EXPECT_LT(v.picks[0].slip_deg, 1.0);
  EXPECT_GT(v.picks[0].release_time, v.picks[0].grip_time);
  EXPECT_EQ(v.in_tray, 1);
  EXPECT_NE(to_json(v).find("\"success\": true"), std::string::npos);
}

TEST(JudgeOfATrial, CallsOpeningInMidAirADrop) {
  Trial trial;
  trial.pick();
  trial.grip(0.085, 40.0, 0.8);
  const Verdict v = trial.verdict();
  EXPECT_FALSE(v.success);
  ASSERT_EQ(v.picks.size(), 1u);
  EXPECT_EQ(v.picks[0].reason, "dropped");
  EXPECT_EQ(v.in_tray, 0);
  EXPECT_EQ(v.on_table, 1);
}

TEST(JudgeOfATrial, CallsClosingOnNothingAMissEvenWhenTheNextAttemptSucceeds) {
  Trial trial;
  trial.grip(0.0, 40.0, 1.2);
  trial.grip(0.085, 40.0, 0.8);
  trial.pick();
  trial.place();
  const Verdict v = trial.verdict();
  ASSERT_EQ(v.picks.size(), 2u) << to_json(v);
  EXPECT_EQ(v.picks[0].reason, "missed");
  EXPECT_TRUE(v.picks[1].success);
  EXPECT_EQ(v.in_tray, 1);
  EXPECT_FALSE(v.success);
}

TEST(JudgeOfATrial, ReportsFingersDrivenIntoTheTable) {
  Trial trial;
  trial.move({0.5, 0.12, 0.10}, 0.3, 1.0);
  trial.move({0.5, 0.12, -0.005}, 0.05, 0.5);  // the open finger tips end 1 cm too deep
  const Verdict v = trial.verdict();
  ASSERT_FALSE(v.collisions.empty());
  EXPECT_NE(v.collisions[0].find("table"), std::string::npos);
  EXPECT_FALSE(v.success);
}

TEST(JudgeOfATrial, SeesAWeakGripSlip) {
  Trial trial;
  trial.world.reset(trial.q);
  // 3.4 kg at 20 N: Coulomb allows 2.6 kg.
  trial.world.add_part(block({0.12, kWidth, 0.024}, 3.4), at(0.5, 0.0, 0.0121));
  trial.judge.reset(trial.world);
  trial.grip(0.085, 20.0, 0.3);
  trial.move({0.5, 0.0, kGraspHeight}, 0.2, 1.0);
  trial.grip(0.0, 20.0);
  trial.move({0.5, 0.0, 0.20}, 0.1, 0.5);
  trial.hold(0.3);
  trial.grip(0.085, 20.0, 0.5);
  const Verdict v = trial.verdict();
  ASSERT_EQ(v.picks.size(), 1u) << to_json(v);
  EXPECT_GT(v.picks[0].slip_mm, 5.0);
  EXPECT_TRUE(v.picks[0].reason == "dropped" || v.picks[0].reason == "slipped") << to_json(v);
}

}  // namespace
}  // namespace iwgnet_grasp::physics
