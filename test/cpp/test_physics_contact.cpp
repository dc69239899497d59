// Falling, resting and sliding parts against their formulas.
#include <gtest/gtest.h>

#include "physics_rig.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kGravity = 9.80665;       // config/physics.yaml
constexpr double kPartFriction = 0.55;     // likewise

class Contacts : public ::testing::Test {
 protected:
  CellConfig cell = load_cell_config(kConfig);
  std::unique_ptr<World> world_ = std::make_unique<World>(cell_urdf(), kSource, cell, kConfig);

  void SetUp() override { world_->simulate_robot(false); }
  void run(double seconds) {
    for (int i = 0; i < std::lround(seconds / world_->timestep()); ++i) world_->step();
  }
};

TEST_F(Contacts, FreeFallFollowsGravity) {
  const double height = 0.5, time = 0.25;
  world_->add_part(block({0.04, 0.04, 0.04}, 0.3), at(0.5, 0.0, height));
  run(time);
  const PartState part = world_->part(0);
  // Semi-implicit Euler overshoots g t^2 / 2 by g t dt / 2.
  const double fallen = kGravity * time * (time + world_->timestep()) / 2;
  EXPECT_NEAR(height - part.T_base_part.translation().z(), fallen, 1e-6);
  EXPECT_NEAR(part.linear.z(), -kGravity * time, 1e-6);
}

TEST_F(Contacts, ARestingBlockPressesWithItsWeightAndFallsAsleep) {
  world_->simulate_robot(true);
  const double mass = 0.4;
  world_->add_part(block({0.06, 0.05, 0.04}, mass), at(0.5, 0.0, 0.0201));
  run(0.3);
  double force = 0.0;
  for (const Contact& c : world_->contacts())
    if (c.a == "part:0" || c.b == "part:0") force += c.normal_force;
  EXPECT_NEAR(force, mass * kGravity, 0.02 * mass * kGravity);
  EXPECT_NEAR(world_->part(0).T_base_part.translation().z(), 0.02, 2e-4);
  run(1.0);
  EXPECT_TRUE(world_->parts_at_rest());
}

// A heavy wedge of the given angle stands on the table; a block is let go on its slope.
class Slope : public Contacts {
 protected:
  double slid_after(double angle, double seconds) {
    const double length = 0.30, width = 0.10, height = length * std::tan(angle);
    // Its centre of mass is put into the middle of its base: it must only stand firm.
    std::vector<Eigen::Vector3d> corners;
    for (const double y : {-width / 2, width / 2}) {
      corners.emplace_back(-length / 2, y, 0.0);
      corners.emplace_back(length / 2, y, 0.0);
      corners.emplace_back(length / 2, y, height);
    }
    world_->add_part(convex_part(corners, {length, width, height}, 50.0), at(0.5, 0.0, 0.0));
    const Eigen::Vector3d normal(-std::sin(angle), 0.0, std::cos(angle));
    const Eigen::Vector3d middle(0.5, 0.0, height / 2);
    Pose T = Pose(Eigen::Translation3d(middle + 0.0101 * normal)) *
             Eigen::AngleAxisd(-angle, Eigen::Vector3d::UnitY());
    world_->add_part(block({0.06, 0.05, 0.02}, 0.4), T);
    run(0.05);  // touch down
    const Eigen::Vector3d start = world_->part(1).T_base_part.translation();
    const Eigen::Vector3d speed = world_->part(1).linear;
    run(seconds);
    const Eigen::Vector3d down(-std::cos(angle), 0.0, -std::sin(angle));
    initial_speed = speed.dot(down);
    return (world_->part(1).T_base_part.translation() - start).dot(down);
  }
  double initial_speed = 0.0;
  const double friction_angle = std::atan(kPartFriction * kPartFriction);
};

TEST_F(Slope, HoldsJustBelowTheFrictionAngle) {
  EXPECT_LT(std::abs(slid_after(friction_angle - 0.01, 1.0)), 5e-4);
}

TEST_F(Slope, SlidesJustAboveTheFrictionAngle) {
  EXPECT_GT(slid_after(friction_angle + 0.01, 1.0), 0.01);
}

TEST_F(Slope, SlidesWithCoulombsAcceleration) {
  const double angle = friction_angle + 0.10, time = 0.3;
  const double slid = slid_after(angle, time);
  const double a =
      kGravity * (std::sin(angle) - kPartFriction * kPartFriction * std::cos(angle));
  const double expected = initial_speed * time + a * time * time / 2;
  EXPECT_NEAR(slid, expected, 0.05 * expected);
}

TEST_F(Contacts, TheSameCallsGiveTheSameBits) {
  const auto tumble = [&] {
    world_->reset(cell.observe_joints);
    world_->simulate_robot(false);
    for (int k = 0; k < 5; ++k)
      world_->add_part(block({0.10, 0.03, 0.02}, 0.4),
                     at(0.5, 0.01 * k, 0.03 + 0.04 * k) *
                         Eigen::AngleAxisd(k, Eigen::Vector3d(1, k, 2).normalized()));
    run(0.8);
    Eigen::Matrix<double, 16, 5> poses;
    for (int k = 0; k < 5; ++k)
      poses.col(k) = Eigen::Map<const Eigen::Matrix<double, 16, 1>>(
          world_->part(k).T_base_part.matrix().data());
    return poses;
  };
  const auto first = tumble();
  EXPECT_EQ(first, tumble());
  world_ = std::make_unique<World>(cell_urdf(), kSource, cell, kConfig);
  EXPECT_EQ(first, tumble());
}

}  // namespace
}  // namespace iwgnet_grasp::physics
