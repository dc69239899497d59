#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "iwgnet_grasp/grasping/height_map.h"
#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::grasping {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

struct Table {
  CellConfig cell = load_cell_config(IWGNET_SOURCE_DIR "/config");
  sensing::Renderer renderer;
  Table() {
    add(cell.table.size, Pose(Eigen::Translation3d(cell.table.center)));
  }
  void add(const Eigen::Vector3d& size, const Pose& pose) {
    renderer.add_instance(renderer.add_box(size), {}, pose);
  }
  cv::Mat depth() { return renderer.depth(cell.camera.color, cell.camera.T_base_color); }
  HeightMap heights(const cv::Mat& depth) const {
    return HeightMap(depth, cell.camera.color, cell.camera.T_base_color, cell);
  }
};

TEST(HeightMap, EmptyMapIsTheTable) {
  const HeightMap heights;
  EXPECT_EQ(heights.at(0.5, 0.0), 0.0);
  EXPECT_EQ(heights.max_in({0.5, 0}, 0.3, {0.1, 0.1}), 0.0);
}

TEST(HeightMap, BoxesStandWhereTheyAre) {
  Table table;
  Pose turned(Eigen::Translation3d(0.55, -0.1, 0.02));
  turned.rotate(Eigen::AngleAxisd(0.6, Eigen::Vector3d::UnitZ()));
  table.add({0.10, 0.03, 0.04}, turned);
  const HeightMap heights = table.heights(table.depth());
  EXPECT_NEAR(heights.at(0.55, -0.1), 0.04, 1e-4);
  EXPECT_NEAR(heights.at(0.45, 0.1), 0.0, 1e-4);
  const Eigen::Vector2d along(std::cos(0.6), std::sin(0.6)), across(-along.y(), along.x());
  const Eigen::Vector2d center(0.55, -0.1);
  for (const double s : {-0.045, 0.045}) {
    EXPECT_NEAR(heights.at((center + s * along).x(), (center + s * along).y()), 0.04, 1e-4);
    EXPECT_NEAR(heights.at((center + s * across).x(), (center + s * across).y()), 0.0, 1e-4);
  }
  EXPECT_EQ(heights.at(5.0, 5.0), 0.0);
}

TEST(HeightMap, SeenFromAnotherFrameTheSurfaceIsTheSame) {
  Table table;
  table.add({0.10, 0.06, 0.04}, Pose(Eigen::Translation3d(0.5, 0.0, 0.02)));
  Pose T_base_view(Eigen::Translation3d(0.5, 0.0, 0.04));
  T_base_view.rotate(Eigen::AngleAxisd(0.7, Eigen::Vector3d::UnitZ()) *
                     Eigen::AngleAxisd(0.3, Eigen::Vector3d(1, 0.5, 0).normalized()));
  const HeightMap view = table.heights(table.depth()).seen_from(T_base_view, {0.05, 0.05});
  // Planes z = 40 mm and z = 0 along the lines parallel to the view's z axis.
  const auto plane = [&](double x, double y, double z) {
    const Eigen::Vector3d p = T_base_view * Eigen::Vector3d(x, y, 0);
    return (z - p.z()) / T_base_view.linear()(2, 2);
  };
  for (const double x : {-0.012, 0.0, 0.012})
    for (const double y : {-0.012, 0.0, 0.012}) EXPECT_NEAR(view.at(x, y), plane(x, y, 0.04), 0.0015);
  // Beside the box, on the side that leans away from it, the table; at its wall what is solid.
  const Eigen::Vector3d off = T_base_view.inverse() * Eigen::Vector3d(0.5, 0.045, 0.0);
  const Eigen::Vector3d far = T_base_view.inverse() * Eigen::Vector3d(0.5, -0.045, 0.0);
  EXPECT_NEAR(std::min(view.at(off.x(), off.y()) - off.z(), view.at(far.x(), far.y()) - far.z()), 0.0, 0.002);
  const Eigen::Vector3d wall = T_base_view.inverse() * Eigen::Vector3d(0.5, 0.0295, 0.02);
  EXPECT_GT(view.at(wall.x(), wall.y()), wall.z() - 0.003);
  EXPECT_TRUE(std::isinf(view.at(0.06, 0.0)));
}

TEST(HeightMap, MaxInLooksIntoTheTurnedRectangleOnly) {
  Table table;
  table.add({0.02, 0.02, 0.05}, Pose(Eigen::Translation3d(0.55, 0.05, 0.025)));
  const HeightMap heights = table.heights(table.depth());
  const double yaw = M_PI / 4;  // the post lies on the rectangle's long axis
  EXPECT_NEAR(heights.max_in({0.5, 0.0}, yaw, {0.09, 0.01}), 0.05, 1e-3);
  EXPECT_NEAR(heights.max_in({0.5, 0.0}, -yaw, {0.09, 0.01}), 0.0, 1e-3);
}

TEST(HeightMap, HolesAreFilledFromAround) {
  Table table;
  table.add({0.08, 0.08, 0.03}, Pose(Eigen::Translation3d(0.5, 0.0, 0.015)));
  cv::Mat depth = table.depth();
  // A hole over the box's right rim, as wide on both sides of it.
  depth(cv::Rect(669, 380, 30, 40)).setTo(kNaN);
  const HeightMap heights = table.heights(depth);
  EXPECT_NEAR(heights.at(0.535, 0.0), 0.03, 1e-3);
  EXPECT_NEAR(heights.at(0.56, 0.0), 0.0, 1e-3);
}

TEST(HeightMap, AStereoShadowBesideAnEdgeLiesLow) {
  Table table;
  table.add({0.08, 0.08, 0.03}, Pose(Eigen::Translation3d(0.5, 0.0, 0.015)));
  cv::Mat depth = table.depth();
  // What the other imager does not see beside the right rim: one cell of the map.
  const HeightMap whole = table.heights(depth);
  double edge = 0.535;
  while (whole.at(edge, 0.0) > 0.015) edge += 0.001;
  for (int v = 380; v < 420; ++v)
    for (int u = 640; u < 720; ++u)
      if (depth.at<float>(v, u) > 0.59f && 0.5 + (u - 639.5) * 0.6 / 640.0 < edge + 0.002) depth.at<float>(v, u) = kNaN;
  EXPECT_NEAR(table.heights(depth).at(edge, 0.0), 0.0, 1e-3);
}

TEST(HeightMap, NothingMeasuredIsFlat) {
  Table table;
  const cv::Mat nothing(800, 1280, CV_32FC1, cv::Scalar(kNaN));
  EXPECT_EQ(table.heights(nothing).at(0.5, 0.0), 0.0);
}

TEST(HeightMap, TiltedCameraSeesTheSameHeights) {
  Table table;
  table.add({0.08, 0.08, 0.03}, Pose(Eigen::Translation3d(0.5, 0.0, 0.015)));
  CameraConfig& camera = table.cell.camera;
  camera.T_base_color.translate(Eigen::Vector3d(0.02, -0.03, -0.05));
  camera.T_base_color.rotate(Eigen::AngleAxisd(0.2, Eigen::Vector3d(1, 1, 0.3).normalized()));
  const HeightMap heights = table.heights(table.depth());
  EXPECT_NEAR(heights.at(0.5, 0.0), 0.03, 2e-4);
  EXPECT_NEAR(heights.at(0.40, 0.05), 0.0, 2e-4);
}

TEST(HeightMap, WrongImageIsRefused) {
  Table table;
  EXPECT_THROW(table.heights(cv::Mat(10, 10, CV_32FC1)), Error);
  EXPECT_THROW(table.heights(cv::Mat(800, 1280, CV_16UC1)), Error);
}

}  // namespace
}  // namespace iwgnet_grasp::grasping
