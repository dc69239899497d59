// Eq. 3 and the alignment of depth to colour.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

CameraConfig camera() { return load_cell_config(IWGNET_SOURCE_DIR "/config").camera; }

TEST(Pinhole, ProjectionUndoesDeprojection) {
  const PinholeIntrinsics k = camera().color;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> u(0, k.width - 1), v(0, k.height - 1), z(0.2, 3.0);
  for (int i = 0; i < 1000; ++i) {
    const double x = u(random), y = v(random);
    const Eigen::Vector2d px = project(k, deproject(k, x, y, z(random)));
    EXPECT_NEAR(px.x(), x, 1e-9);
    EXPECT_NEAR(px.y(), y, 1e-9);
  }
}

TEST(Pinhole, WorldPointFallsOnThePixelOfEquation3) {
  // Nominal camera: 0.6 m above (0.5, 0), image x along base x, image y against base y.
  const CameraConfig c = camera();
  const Eigen::Vector3d world(0.53, -0.04, 0.1);
  const Eigen::Vector2d px = project(c.color, c.T_base_color.inverse() * world);
  EXPECT_NEAR(px.x(), c.color.cx + c.color.fx * 0.03 / 0.5, 1e-6);
  EXPECT_NEAR(px.y(), c.color.cy + c.color.fy * 0.04 / 0.5, 1e-6);
}

TEST(AlignDepth, PlaneKeepsItsDepthAndHasNoHoles) {
  const CameraConfig c = camera();
  const cv::Mat depth(c.depth.height, c.depth.width, CV_32FC1, cv::Scalar(0.6));
  const cv::Mat aligned = align_depth(depth, c.depth, c.color, c.T_depth_color.inverse());
  ASSERT_EQ(aligned.size(), cv::Size(c.color.width, c.color.height));
  int seen = 0;
  for (int v = 0; v < aligned.rows; ++v)
    for (int u = 0; u < aligned.cols; ++u) {
      // Where the depth imager looks at this pixel's point of the plane.
      const Eigen::Vector2d px =
          project(c.depth, c.T_depth_color * deproject(c.color, u, v, 0.6));
      const bool inside = px.x() > 0 && px.y() > 0 && px.x() < c.depth.width - 1 &&
                          px.y() < c.depth.height - 1;
      if (inside) {
        ++seen;
        ASSERT_NEAR(aligned.at<float>(v, u), 0.6, 1e-6) << u << ", " << v;
      }
    }
  EXPECT_GT(seen, aligned.rows * aligned.cols / 2);
  EXPECT_TRUE(std::isnan(aligned.at<float>(0, aligned.cols - 1)));  // beyond the depth image
}

TEST(AlignDepth, TiltedPlaneStaysInPlace) {
  // Plane z = 0.6 + 0.3 x in the depth frame, seen from a camera that is shifted and turned.
  const CameraConfig c = camera();
  Pose T_to_from = Pose(Eigen::Translation3d(-0.059, 0.01, 0.02));
  T_to_from.rotate(Eigen::AngleAxisd(0.05, Eigen::Vector3d(1, 2, 0.5).normalized()));
  const Eigen::Vector3d normal = Eigen::Vector3d(0.3, 0, -1).normalized();
  const double offset = -0.6 * normal.z();  // normal . p + offset = 0
  const auto depth_of = [&](const PinholeIntrinsics& k, int u, int v, const Eigen::Vector3d& n,
                            double d) { return -d / n.dot(deproject(k, u, v, 1.0)); };
  cv::Mat depth(c.depth.height, c.depth.width, CV_32FC1);
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u)
      depth.at<float>(v, u) = static_cast<float>(depth_of(c.depth, u, v, normal, offset));
  const cv::Mat aligned = align_depth(depth, c.depth, c.color, T_to_from);
  const Eigen::Vector3d n = T_to_from.rotation() * normal;
  const double d = offset - n.dot(T_to_from.translation());
  double worst = 0;
  for (int v = 100; v < aligned.rows - 100; ++v)
    for (int u = 200; u < aligned.cols - 200; ++u)
      if (const float z = aligned.at<float>(v, u); z > 0)
        worst = std::max(worst, std::abs(z - depth_of(c.color, u, v, n, d)));
  EXPECT_LT(worst, 0.001);  // one pixel on a plane that rises 0.3 mm a mm
  EXPECT_GT(worst, 0.0);
}

TEST(AlignDepth, NearerSurfaceWins) {
  const CameraConfig c = camera();
  cv::Mat depth(c.depth.height, c.depth.width, CV_32FC1, cv::Scalar(0.8));
  depth(cv::Rect(600, 300, 100, 100)).setTo(0.5);
  const cv::Mat aligned = align_depth(depth, c.depth, c.color, c.T_depth_color.inverse());
  const Eigen::Vector2d px =
      project(c.color, c.T_depth_color.inverse() * deproject(c.depth, 650, 350, 0.5));
  EXPECT_FLOAT_EQ(aligned.at<float>(cvRound(px.y()), cvRound(px.x())), 0.5f);
  // The colour imager looks past the box's right side less far than the depth imager: at the box's
  // left edge, points behind it that only the depth imager sees must not shine through.
  const Eigen::Vector2d edge =
      project(c.color, c.T_depth_color.inverse() * deproject(c.depth, 602, 350, 0.5));
  EXPECT_FLOAT_EQ(aligned.at<float>(cvRound(edge.y()), cvRound(edge.x())), 0.5f);
}

TEST(AlignDepth, InvalidPixelsGiveNothing) {
  const CameraConfig c = camera();
  cv::Mat depth(c.depth.height, c.depth.width, CV_32FC1, cv::Scalar(kNaN));
  depth.at<float>(10, 10) = -1.0f;
  depth.at<float>(11, 11) = std::numeric_limits<float>::infinity();
  const cv::Mat aligned = align_depth(depth, c.depth, c.color, c.T_depth_color.inverse());
  EXPECT_EQ(cv::countNonZero(aligned == aligned), 0);  // NaN differs from itself
}

TEST(AlignDepth, WrongSizeIsRefused) {
  const CameraConfig c = camera();
  EXPECT_THROW(align_depth(cv::Mat(480, 640, CV_32FC1), c.depth, c.color, Pose::Identity()), Error);
  EXPECT_THROW(align_depth(cv::Mat(720, 1280, CV_16UC1), c.depth, c.color, Pose::Identity()), Error);
}

TEST(DepthInMetres, MillimetresWithZeroInvalid) {
  const cv::Mat raw = (cv::Mat_<std::uint16_t>(1, 3) << 0, 600, 65535);
  const cv::Mat depth = depth_in_metres(raw);
  EXPECT_TRUE(std::isnan(depth.at<float>(0)));
  EXPECT_FLOAT_EQ(depth.at<float>(1), 0.6f);
  EXPECT_FLOAT_EQ(depth.at<float>(2), 65.535f);
}

TEST(DepthInMetres, MetresWithNaNInvalid) {
  const cv::Mat raw =
      (cv::Mat_<float>(1, 5) << kNaN, 0.6f, 0.0f, -1.0f, std::numeric_limits<float>::infinity());
  const cv::Mat depth = depth_in_metres(raw);
  EXPECT_FLOAT_EQ(depth.at<float>(1), 0.6f);
  for (const int i : {0, 2, 3, 4}) EXPECT_TRUE(std::isnan(depth.at<float>(i))) << i;
}

TEST(DepthInMetres, OtherTypesAreNamed) {
  try {
    depth_in_metres(cv::Mat(2, 2, CV_8UC1));
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("CV_8UC1"), std::string::npos);
  }
}

}  // namespace
}  // namespace iwgnet_grasp::sensing
