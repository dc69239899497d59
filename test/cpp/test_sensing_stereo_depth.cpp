// Eq. 4 and the D455's noise against their formulas.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "iwgnet_grasp/sensing/pinhole.h"
#include "iwgnet_grasp/sensing/stereo_depth.h"

namespace iwgnet_grasp::sensing {
namespace {

CameraConfig camera() { return load_cell_config(IWGNET_SOURCE_DIR "/config").camera; }

cv::Mat plane(const CameraConfig& c, double z) {
  return cv::Mat(c.depth.height, c.depth.width, CV_32FC1, cv::Scalar(z));
}

bool valid(float z) { return z > 0; }

bool same(const cv::Mat& a, const cv::Mat& b) {  // NaN equals NaN
  return a.size() == b.size() && std::memcmp(a.data, b.data, a.total() * a.elemSize()) == 0;
}

TEST(StereoDepth, Equation4) {
  EXPECT_DOUBLE_EQ(depth_from_disparity(61.75, 650, 0.095), 1.0);
  const CameraConfig c = camera();
  const double z = 0.73, d = c.depth.fx * c.baseline / z;
  EXPECT_NEAR(depth_from_disparity(d, c.depth.fx, c.baseline), z, 1e-12);
}

class PlaneNoise : public testing::TestWithParam<double> {};

TEST_P(PlaneNoise, DeviationFollowsTheFormula) {
  // sigma_z = z^2 sigma_d / (f B), where rounding to a step adds step^2 / 12 to sigma_d^2.
  const CameraConfig c = camera();
  const double z = GetParam(), fB = c.depth.fx * c.baseline;
  const cv::Mat depth = stereo_depth(plane(c, z), plane(c, z), c, 7);
  double sum = 0, squares = 0;
  int n = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u)
      if (const double error = depth.at<float>(v, u) - z; valid(depth.at<float>(v, u))) {
        sum += error;
        squares += error * error;
        ++n;
      }
  ASSERT_GT(n, 500000);
  const double sigma_d = std::sqrt(std::pow(c.subpixel_sigma_px, 2) + std::pow(c.disparity_step_px, 2) / 12);
  const double expected = z * z * sigma_d / fB;
  const double measured = std::sqrt(squares / n - std::pow(sum / n, 2));
  EXPECT_NEAR(measured / expected, 1.0, 0.03);
  // No bias beyond the curvature of 1/d and half a rounding step.
  EXPECT_LT(std::abs(sum / n), 0.05 * expected + z * z * c.disparity_step_px / fB / 20);
}
INSTANTIATE_TEST_SUITE_P(Depths, PlaneNoise, testing::Values(0.5, 0.6, 1.0, 2.0, 4.0));

TEST(StereoDepth, DisparitiesLieOnTheSensorsSteps) {
  const CameraConfig c = camera();
  const cv::Mat depth = stereo_depth(plane(c, 0.6), plane(c, 0.6), c, 3);
  for (int u = 200; u < 1200; u += 7)
    if (const float z = depth.at<float>(300, u); valid(z)) {
      const double steps = c.depth.fx * c.baseline / z / c.disparity_step_px;
      EXPECT_NEAR(steps, std::round(steps), 0.01);
    }
}

TEST(StereoDepth, InvalidShareIsTheOutlierFraction) {
  CameraConfig c = camera();
  c.outlier_fraction = 0.07;
  const cv::Mat depth = stereo_depth(plane(c, 0.6), plane(c, 0.6), c, 5);
  // The left margin has no counterpart in the right image: its width is the disparity.
  const int margin = static_cast<int>(std::ceil(c.depth.fx * c.baseline / 0.6)) + 3;
  int holes = 0, n = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = margin; u < depth.cols; ++u, ++n) holes += !valid(depth.at<float>(v, u));
  EXPECT_NEAR(static_cast<double>(holes) / n, c.outlier_fraction, 0.002);
  int left = 0;
  for (int v = 0; v < depth.rows; ++v) left += valid(depth.at<float>(v, margin - 6 - 3));
  EXPECT_EQ(left, 0);
}

TEST(StereoDepth, RangeEndsWhereTheDisparitySearchEnds) {
  const CameraConfig c = camera();
  const double nearest = c.depth.fx * c.baseline / kMaxDisparity;  // 0.49 m
  const auto share = [&](double z) {
    const cv::Mat depth = stereo_depth(plane(c, z), plane(c, z), c, 1);
    return cv::countNonZero(depth > 0) / static_cast<double>(depth.total());
  };
  EXPECT_EQ(share(nearest - 0.01), 0.0);
  EXPECT_GT(share(nearest + 0.01), 0.8);
  EXPECT_EQ(share(c.max_depth * 1.2), 0.0);
}

// A box with vertical faces below the depth camera, wide enough that rows in the middle see only
// its left and right edges.
struct Step {
  Renderer renderer;
  CameraConfig c = camera();
  double floor = 0.7, top = 0.55;  // m, depths
  Step() {
    c.T_base_color = Pose::Identity();  // the depth frame becomes the base frame up to a shift
    c.T_depth_color = Pose::Identity();
    const int far = renderer.add_box({4, 4, 0.01});
    renderer.add_instance(far, {}, Pose(Eigen::Translation3d(0, 0, floor + 0.005)));
    const int box = renderer.add_box({0.10, 0.6, 0.05});
    renderer.add_instance(box, {}, Pose(Eigen::Translation3d(0, 0, top + 0.025)));
  }
};

TEST(StereoDepth, ShadowIsAsWideAsTheDisparityStep) {
  Step step;
  step.c.outlier_fraction = 0;
  step.c.lateral_sigma_px = 0;
  const double fB = step.c.depth.fx * step.c.baseline;
  const double expected = fB * (1 / step.top - 1 / step.floor);
  const cv::Mat depth = capture_depth(step.renderer, step.c, 1);
  for (int v = 340; v < 380; v += 10) {
    // The shadow lies left of the box, where the right imager looks under its edge.
    const int edge = static_cast<int>(std::round(step.c.depth.cx - 0.05 / step.top * step.c.depth.fx));
    int width = 0;
    for (int u = edge - 60; u < edge + 5; ++u) width += !valid(depth.at<float>(v, u));
    EXPECT_NEAR(width, expected, 1.5);
    // On the other side both imagers see the floor right up to the box.
    const int right = static_cast<int>(std::round(step.c.depth.cx + 0.05 / step.top * step.c.depth.fx));
    for (int u = right - 20; u < right + 40; ++u) EXPECT_TRUE(valid(depth.at<float>(v, u))) << u;
  }
}

TEST(StereoDepth, DerivedRightViewAgreesWithARenderedOne) {
  Step step;
  const Pose T_left = step.c.T_base_depth();
  const Pose T_right = T_left * Eigen::Translation3d(step.c.baseline, 0, 0);
  const cv::Mat exact =
      stereo_depth(step.renderer.depth(step.c.depth, T_left),
                   step.renderer.depth(step.c.depth, T_right), step.c, 9);
  const cv::Mat derived = capture_depth(step.renderer, step.c, 9);
  int differ = 0;
  for (std::size_t i = 0; i < exact.total(); ++i)
    differ += valid(exact.at<float>(i)) != valid(derived.at<float>(i));
  EXPECT_LT(differ, 2 * exact.rows);  // at most the shadow's rim
}

TEST(StereoDepth, SameSeedSameImage) {
  Step step;
  const cv::Mat a = capture_depth(step.renderer, step.c, 42);
  EXPECT_TRUE(same(a, capture_depth(step.renderer, step.c, 42)));
  EXPECT_FALSE(same(a, capture_depth(step.renderer, step.c, 43)));
}

TEST(StereoDepth, ImagesThatDoNotMatchAreRefused) {
  const CameraConfig c = camera();
  EXPECT_THROW(stereo_depth(plane(c, 1), cv::Mat(10, 10, CV_32FC1), c, 1), Error);
  EXPECT_THROW(stereo_depth(cv::Mat(), cv::Mat(), c, 1), Error);
}

}  // namespace
}  // namespace iwgnet_grasp::sensing
