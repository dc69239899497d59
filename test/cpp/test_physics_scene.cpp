// Scenes: settled, inside the workspace, the same for one seed.
#include <gtest/gtest.h>

#include "iwgnet_grasp/physics/scene.h"
#include "physics_rig.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kHighest = 0.11;  // m: nearer than 0.49 m the D455 sees nothing

std::vector<PartModel> library() {
  std::vector<PartModel> parts = {block({0.14, 0.04, 0.022}, 0.45), block({0.12, 0.03, 0.020}, 0.30),
                                  block({0.15, 0.05, 0.024}, 0.55)};
  for (auto& part : parts) part.family = "connecting_rod";
  return parts;
}

class Scenes : public ::testing::Test {
 protected:
  CellConfig cell = load_cell_config(kConfig);
  World world{cell_urdf(), kSource, cell, kConfig};

  Eigen::MatrixXd build(const std::string& name, std::uint64_t seed) {
    world.reset(cell.observe_joints);
    const auto models =
        build_scene(world, load_scene_spec(kConfig, name), cell, library(), seed);
    EXPECT_EQ(static_cast<int>(models.size()), world.part_count());
    Eigen::MatrixXd poses(16, world.part_count());
    for (int k = 0; k < world.part_count(); ++k) {
      const Eigen::Matrix4d T = world.part(k).T_base_part.matrix();
      poses.col(k) = Eigen::Map<const Eigen::VectorXd>(T.data(), 16);
    }
    return poses;
  }
};

TEST_F(Scenes, AStackComesToRestInsideTheWorkspaceWithPartsOnParts) {
  const auto poses = build("ten_stacked", 4);
  ASSERT_EQ(world.part_count(), 10);
  EXPECT_TRUE(world.parts_at_rest());
  EXPECT_EQ(world.time(), 0.0);
  double highest = 0.0;
  for (int k = 0; k < 10; ++k) {
    const Eigen::Vector3d p = world.part(k).T_base_part.translation();
    EXPECT_TRUE((p.head<2>().array() >= cell.workspace_min.array()).all()) << k;
    EXPECT_TRUE((p.head<2>().array() <= cell.workspace_max.array()).all()) << k;
    EXPECT_GT(p.z(), 0.009) << k;
    EXPECT_LT(p.z(), kHighest) << k;
    highest = std::max(highest, p.z());
  }
  EXPECT_GT(highest, 0.025) << "a pile has a second layer";
  // It stays as it lies when the robot is there again.
  for (int i = 0; i < 240; ++i) world.step();
  for (int k = 0; k < 10; ++k) {
    const Eigen::Matrix4d T = world.part(k).T_base_part.matrix();
    EXPECT_LT((Eigen::Map<const Eigen::VectorXd>(T.data(), 16) - poses.col(k)).norm(), 1e-6);
  }
}

TEST_F(Scenes, OneSeedGivesOneSceneToTheBit) {
  const auto first = build("seven_stacked", 7);
  EXPECT_NE(first, build("seven_stacked", 8));
  EXPECT_EQ(first, build("seven_stacked", 7));
  World other(cell_urdf(), kSource, cell, kConfig);
  build_scene(other, load_scene_spec(kConfig, "seven_stacked"), cell, library(), 7);
  for (int k = 0; k < 7; ++k) {
    const Eigen::Matrix4d T = other.part(k).T_base_part.matrix();
    EXPECT_EQ((Eigen::Map<const Eigen::VectorXd>(T.data(), 16)), first.col(k));
  }
}

TEST_F(Scenes, ScatteredPartsLieFlatAndApart) {
  for (std::uint64_t seed = 0; seed < 5; ++seed) {
    build("five_scattered", seed);
    for (int k = 0; k < 5; ++k) {
      const Pose T = world.part(k).T_base_part;
      EXPECT_GT(std::abs(T.linear()(2, 2)), 0.999);
      EXPECT_LT(T.translation().z(), 0.0125);
    }
    for (const Contact& c : world.contacts())
      EXPECT_FALSE(c.a.rfind("part", 0) == 0 && c.b.rfind("part", 0) == 0);
  }
}

TEST_F(Scenes, AnUnknownSceneNamesTheKnownOnes) {
  try {
    load_scene_spec(kConfig, "nine_floating");
    FAIL();
  } catch (const Error& error) {
    const std::string text = error.what();
    EXPECT_NE(text.find("nine_floating"), std::string::npos);
    EXPECT_NE(text.find("five_scattered"), std::string::npos);
  }
}

TEST_F(Scenes, PartsThatDoNotFitAreRefused) {
  SceneSpec spec = load_scene_spec(kConfig, "five_scattered");
  spec.min_gap = 0.30;
  EXPECT_THROW(build_scene(world, spec, cell, library(), 0), Error);
}

TEST(PartLibrary, ABrokenPartIsRefusedWithItsFile) {
  EXPECT_THROW(load_part("/nonexistent/part"), Error);
  EXPECT_THROW(load_parts("/nonexistent"), Error);
}

}  // namespace
}  // namespace iwgnet_grasp::physics
