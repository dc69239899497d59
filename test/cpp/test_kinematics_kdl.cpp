// KDL chains from URDF against the closed form of the UR5.
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <random>
#include <sstream>

#include "iwgnet_grasp/kinematics/kdl_chain.h"
#include "iwgnet_grasp/kinematics/ur5.h"

using namespace iwgnet_grasp;
using namespace iwgnet_grasp::kinematics;

namespace {

// A UR5 of joints only, written from the DH table with fixed joints between them.
std::string ur5_urdf(const std::string& joint_type = "revolute") {
  std::ostringstream xml;
  xml.precision(17);
  xml << "<robot name='ur5'><link name='base_link'/><link name='dh_base'/>"
      << "<joint name='turn' type='fixed'><parent link='base_link'/><child link='dh_base'/>"
      << "<origin rpy='0 0 " << M_PI << "'/></joint>";
  std::string parent = "dh_base";
  for (int i = 0; i < kJoints; ++i) {
    const std::string moved = "moved" + std::to_string(i), frame = "frame" + std::to_string(i);
    xml << "<link name='" << moved << "'/><link name='" << frame << "'/>"
        << "<joint name='" << kJointNames[i] << "' type='" << joint_type << "'><parent link='"
        << parent << "'/><child link='" << moved << "'/><axis xyz='0 0 1'/>"
        << "<limit lower='-6.28318530717958' upper='6.28318530717958' effort='150' velocity='3.14'/></joint>"
        << "<joint name='fixed" << i << "' type='fixed'><parent link='" << moved
        << "'/><child link='" << frame << "'/><origin xyz='" << kUr5Dh[i].a << " 0 "
        << kUr5Dh[i].d << "' rpy='" << kUr5Dh[i].alpha << " 0 0'/></joint>";
    parent = frame;
  }
  xml << "</robot>";
  return xml.str();
}

std::string cell_urdf() {
  std::ifstream file(IWGNET_SOURCE_DIR "/urdf/cell.urdf");
  std::stringstream text;
  text << file.rdbuf();
  return text.str();
}

JointVector random_joints(std::mt19937& random) {
  std::uniform_real_distribution<double> angle(-M_PI, M_PI);
  JointVector q;
  for (int i = 0; i < kJoints; ++i) q[i] = angle(random);
  return q;
}

void expect_same_forward(const KdlChain& chain) {
  std::mt19937 random(1);
  for (int i = 0; i < 500; ++i) {
    const JointVector q = random_joints(random);
    EXPECT_LT((chain.forward(q).matrix() - forward(q).matrix()).cwiseAbs().maxCoeff(), 1e-9);
  }
}

}  // namespace

TEST(KdlChain, ForwardEqualsTheClosedForm) {
  expect_same_forward(KdlChain(ur5_urdf(), "base_link", "frame5"));
}

TEST(KdlChain, TheCellsUrdfIsTheSameUr5) {
  const KdlChain chain(cell_urdf(), "base_link", "tool0");
  ASSERT_EQ(chain.joint_names(), std::vector<std::string>(kJointNames, kJointNames + kJoints));
  expect_same_forward(chain);
}

TEST(KdlChain, InverseReachesThePoseFromFarSeeds) {
  const KdlChain chain(ur5_urdf(), "base_link", "frame5");
  std::mt19937 random(2);
  int found = 0;
  const int poses = 300;
  for (int i = 0; i < poses; ++i) {
    const Pose T = forward(random_joints(random));
    const auto q = chain.inverse(T, random_joints(random));
    if (!q) continue;
    ++found;
    EXPECT_LT((forward(*q).matrix() - T.matrix()).cwiseAbs().maxCoeff(), 2e-6);
    // It is one of the closed-form solutions, unless the wrist is singular.
    const IkSolutions all = inverse(T);
    double nearest = 10;
    for (int k = 0; k < all.count; ++k) {
      double distance = 0;
      for (int j = 0; j < kJoints; ++j)
        distance = std::max(distance, std::abs(std::remainder(all.q[k][j] - (*q)[j], 2 * M_PI)));
      nearest = std::min(nearest, distance);
    }
    if (std::abs(std::sin((*q)[4])) > 0.01) {
      EXPECT_LT(nearest, 1e-3);
    }
  }
  EXPECT_GE(found, poses * 99 / 100);
}

TEST(KdlChain, SolutionsKeepTheLimits) {
  const KdlChain chain(cell_urdf(), "base_link", "tool0");
  std::mt19937 random(3);
  for (int i = 0; i < 50; ++i) {
    const auto q = chain.inverse(forward(random_joints(random)), Eigen::VectorXd::Constant(6, 6.0));
    if (!q) continue;
    EXPECT_TRUE((q->array() >= chain.lower().array()).all());
    EXPECT_TRUE((q->array() <= chain.upper().array()).all());
  }
  EXPECT_NEAR(chain.upper()[2], M_PI, 1e-6);
}

TEST(KdlChain, ContinuousJointsTurnFreely) {
  const KdlChain chain(ur5_urdf("continuous"), "base_link", "frame5");
  EXPECT_DOUBLE_EQ(chain.lower()[0], -2 * M_PI);
}

TEST(KdlChain, UnreachableAndBrokenInput) {
  const KdlChain chain(ur5_urdf(), "base_link", "frame5");
  Pose far = Pose::Identity();
  far.translation().x() = 3.0;
  EXPECT_FALSE(chain.inverse(far, Eigen::VectorXd::Zero(6), 3));
  far.translation().x() = std::nan("");
  EXPECT_FALSE(chain.inverse(far, Eigen::VectorXd::Zero(6), 3));
  EXPECT_THROW(chain.forward(Eigen::VectorXd::Zero(5)), Error);
  EXPECT_THROW(chain.inverse(far, Eigen::VectorXd::Zero(7)), Error);
  EXPECT_THROW(KdlChain("<robot", "base_link", "tool0"), Error);
  EXPECT_THROW(KdlChain(ur5_urdf(), "base_link", "nowhere"), Error);
  EXPECT_THROW(KdlChain(ur5_urdf(), "base_link", "dh_base"), Error);  // nothing moves
}
