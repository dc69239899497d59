// Robotiq 2F-85: the gap and the rise of the tips while closing, against the URDF's linkage.
#include <gtest/gtest.h>

#include <fstream>
#include <sstream>

#include "iwgnet_grasp/kinematics/kdl_chain.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::kinematics;

TEST(Robotiq2f85, GapFormula) {
  for (double q = 0; q <= 0.8; q += 0.05) {
    EXPECT_NEAR(gap_from_joint(q), 2 * (0.00541 + 0.05712 * std::sin(0.7185 - q)), 5e-5);
    EXPECT_NEAR(joint_from_gap(gap_from_joint(q)), q, 1e-9);
  }
  EXPECT_NEAR(max_gap(), 0.0860, 5e-4);
  EXPECT_DOUBLE_EQ(joint_from_gap(0.2), 0.0);
  EXPECT_DOUBLE_EQ(joint_from_gap(-0.1), 0.8);
}

TEST(Robotiq2f85, TipsRiseFourteenMillimetresWhileClosing) {
  EXPECT_NEAR(pad_center_height(max_gap()), 0.1303, 1e-4);
  EXPECT_NEAR(pad_center_height(gap_from_joint(0.8)), 0.1443, 1e-4);
  EXPECT_NEAR(finger_tip_height(0.03) - pad_center_height(0.03), 0.01875, 1e-12);
  EXPECT_NEAR(T_tool0_tcp(0.03)(2, 3), pad_center_height(0.03), 1e-12);
}

TEST(Robotiq2f85, IsTheLinkageOfTheUrdf) {
  std::ifstream file(IWGNET_SOURCE_DIR "/urdf/cell.urdf");
  std::stringstream urdf;
  urdf << file.rdbuf();
  const double half_pad = 0.00635 / 2;
  for (const std::string side : {"left", "right"}) {
    const KdlChain chain(urdf.str(), "tool0", side + "_inner_finger_pad");
    ASSERT_EQ(chain.joint_names().size(), 2u);  // outer knuckle, inner finger
    for (double q = 0; q <= 0.8; q += 0.1) {
      const Pose T = chain.forward(Eigen::Vector2d(q, -q));
      // Pads close along tool0's x and stay upright.
      EXPECT_NEAR(2 * (std::abs(T(0, 3)) - half_pad), gap_from_joint(q), 1e-6);
      EXPECT_NEAR(T(1, 3), 0.0, 1e-6);
      EXPECT_NEAR(T(2, 3), pad_center_height(gap_from_joint(q)), 1e-6);
      EXPECT_NEAR(T(2, 2), 1.0, 1e-9);
    }
  }
}
