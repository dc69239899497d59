#include <gtest/gtest.h>

#include "iwgnet_grasp/grasping/push.h"
#include "iwgnet_grasp/motion/pick_and_place.h"
#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::grasping {
namespace {

const std::string kConfig = IWGNET_SOURCE_DIR "/config";
const Eigen::Vector3d kMiddle(0.5, 0.0, 0.02);

struct Table {
  CellConfig cell = load_cell_config(kConfig);
  PushConfig config = motion::load_pick_place_config(kConfig).push;
  sensing::Renderer renderer;
  Table() { renderer.add_instance(renderer.add_box(cell.table.size), {}, Pose(Eigen::Translation3d(cell.table.center))); }
  // A box that stands on the table.
  void add(double x, double y, const Eigen::Vector3d& size) {
    renderer.add_instance(renderer.add_box(size), {}, Pose(Eigen::Translation3d(x, y, size.z() / 2)));
  }
  std::vector<Push> pushes(const std::vector<Eigen::Vector3d>& objects) {
    const HeightMap heights(renderer.depth(cell.camera.color, cell.camera.T_base_color),
                            cell.camera.color, cell.camera.T_base_color, cell);
    return find_pushes(heights, objects, cell, config);
  }
};

TEST(Push, GoesAgainstTheObjectFromFreePlacesAndMovesItByTheDistance) {
  Table table;
  table.add(kMiddle.x(), kMiddle.y(), {0.10, 0.02, 0.02});
  const auto pushes = table.pushes({kMiddle});
  EXPECT_EQ(pushes.size(), 16u);
  for (const Push& push : pushes) {
    const Eigen::Vector2d from = push.from - kMiddle.head<2>(), way = push.to - push.from;
    // The tips, 26 mm square, stand beside the box and go through its centre.
    const Eigen::Vector2d outside = from.cwiseAbs() - Eigen::Vector2d(0.05, 0.01);
    EXPECT_GT(outside.maxCoeff(), 0.009) << from.transpose();
    EXPECT_NEAR(from.x() * way.y() - from.y() * way.x(), 0.0, 1e-6);
    EXPECT_LT(from.dot(way), 0.0);
    EXPECT_GE(way.norm(), table.config.distance - 1e-9);
    EXPECT_LE(way.norm(), table.config.distance + 0.045);  // from outside of the wider upper fingers
  }
}

TEST(Push, MovesAnObjectAwayFromItsNeighbour) {
  Table table;
  table.add(kMiddle.x(), kMiddle.y(), {0.10, 0.02, 0.02});
  table.add(kMiddle.x(), kMiddle.y() + 0.04, {0.10, 0.04, 0.03});
  const auto pushes = table.pushes({kMiddle});
  ASSERT_FALSE(pushes.empty());
  EXPECT_LE((pushes.front().to - pushes.front().from).normalized().y(), 0.4);
}

TEST(Push, KeepsTheObjectInTheWorkspaceAndTheGripperOffWhatIsHigh) {
  Table table;
  const double rim = table.cell.workspace_max.x() - 0.02;
  table.add(rim, 0.0, {0.02, 0.02, 0.02});
  const auto pushes = table.pushes({{rim, 0.0, 0.02}});
  ASSERT_FALSE(pushes.empty());
  for (const Push& push : pushes) EXPECT_LT((push.to - push.from).normalized().x(), 0.2);

  Table high;
  high.add(kMiddle.x(), kMiddle.y(), {0.02, 0.02, 0.08});
  high.config.tip_heights = {0.040, 0.007};  // at 7 mm the body would touch it
  EXPECT_FALSE(high.pushes({{0.5, 0.0, 0.08}}).empty());
  high.config.tip_heights = {0.007};
  EXPECT_TRUE(high.pushes({{0.5, 0.0, 0.08}}).empty());
  Table tower;
  tower.add(kMiddle.x(), kMiddle.y(), {0.02, 0.02, 0.15});
  EXPECT_TRUE(tower.pushes({{0.5, 0.0, 0.15}}).empty());
}

TEST(Push, KeepsNeighboursInTheWorkspaceAndBringsBackWhatIsOutside) {
  Table table;
  const double rim = table.cell.workspace_max.x() - 0.02, inner = rim - 0.06;
  table.add(inner, 0.0, {0.02, 0.02, 0.02});
  table.add(rim, 0.0, {0.02, 0.02, 0.02});
  const auto pushes = table.pushes({{inner, 0.0, 0.02}, {rim, 0.0, 0.02}});
  ASSERT_FALSE(pushes.empty());
  for (const Push& push : pushes) EXPECT_LT((push.to - push.from).normalized().x(), 0.2);

  Table lost;
  const double beyond = lost.cell.workspace_max.x() + 0.05;
  lost.add(beyond, 0.0, {0.02, 0.02, 0.02});
  const auto back = lost.pushes({{beyond, 0.0, 0.02}});
  ASSERT_FALSE(back.empty());
  for (const Push& push : back) EXPECT_LE((push.to - push.from).normalized().x(), 1e-9);
}

TEST(Push, LeavesWhatLiesBelowTheObject) {
  Table table;  // one bar across another
  table.add(kMiddle.x(), kMiddle.y(), {0.02, 0.16, 0.02});
  table.add(kMiddle.x(), kMiddle.y(), {0.16, 0.02, 0.04});
  table.config.tip_heights = {0.040, 0.025, 0.007};
  const auto upper = table.pushes({{kMiddle.x(), kMiddle.y(), 0.04}});
  const auto lower = table.pushes({{kMiddle.x(), kMiddle.y() + 0.05, 0.02}});
  ASSERT_FALSE(upper.empty());
  ASSERT_FALSE(lower.empty());
  for (const Push& push : upper) EXPECT_DOUBLE_EQ(push.tip_height, 0.025);
  for (const Push& push : lower) EXPECT_DOUBLE_EQ(push.tip_height, 0.007);
}

TEST(Push, MeetsTheObjectBelowItsTop) {
  Table table;
  table.add(kMiddle.x(), kMiddle.y(), {0.10, 0.02, 0.03});
  table.config.tip_heights = {0.025, 0.007};
  table.config.overlap = 0.010;
  for (const Push& push : table.pushes({{kMiddle.x(), kMiddle.y(), 0.03}}))
    EXPECT_DOUBLE_EQ(push.tip_height, 0.007);
  table.config.overlap = 0.003;
  for (const Push& push : table.pushes({{kMiddle.x(), kMiddle.y(), 0.03}}))
    EXPECT_DOUBLE_EQ(push.tip_height, 0.025);
}

TEST(Push, NeedsRoomForTheFingers) {
  Table table;
  table.add(kMiddle.x(), kMiddle.y(), {0.30, 0.30, 0.03});
  EXPECT_TRUE(table.pushes({kMiddle}).empty());
  EXPECT_TRUE(table.pushes({}).empty());
}

}  // namespace
}  // namespace iwgnet_grasp::grasping
