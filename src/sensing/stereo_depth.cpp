#include "iwgnet_grasp/sensing/stereo_depth.h"

#include <array>
#include <cmath>
#include <limits>

#include "parallel.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kQuantileBits = 14;
// A match is kept when both imagers agree on the disparity this well, as stereo matchers check.
constexpr float kLeftRightTolerance = 0.75f;  // px

// Quantiles of the standard normal distribution at (i + 1/2) / 2^14, by Newton's method on its
// distribution function: a table look-up a draw instead of a logarithm and a cosine.
const std::array<float, 1 << kQuantileBits>& normal_quantiles() {
  static const auto table = [] {
    std::array<float, 1 << kQuantileBits> quantiles{};
    constexpr int n = 1 << kQuantileBits;
    double x = 0.0;
    for (int i = n / 2; i < n; ++i) {
      const double p = (i + 0.5) / n;
      for (int step = 0; step < 20; ++step) {
        const double error = 0.5 * std::erfc(-x / std::sqrt(2.0)) - p;
        x -= error / (std::exp(-0.5 * x * x) / std::sqrt(2.0 * M_PI));
      }
      quantiles[i] = static_cast<float>(x);
      quantiles[n - 1 - i] = static_cast<float>(-x);
    }
    return quantiles;
  }();
  return table;
}

}  // namespace

double depth_from_disparity(double disparity_px, double fx_px, double baseline_m) {
  return fx_px * baseline_m / disparity_px;
}

cv::Mat stereo_depth(const cv::Mat& ideal_left, const cv::Mat& ideal_right,
                     const CameraConfig& camera, std::uint64_t seed) {
  if (ideal_left.type() != CV_32FC1 || ideal_right.type() != CV_32FC1 ||
      ideal_left.size() != ideal_right.size() || ideal_left.empty())
    throw Error("stereo_depth: needs two 32FC1 depth images of one size");
  const auto& normal = normal_quantiles();
  const int width = ideal_left.cols, height = ideal_left.rows;
  const float fB = camera.depth.fx * camera.baseline;
  const float step = camera.disparity_step_px, sigma = camera.subpixel_sigma_px;
  const float lateral = camera.lateral_sigma_px;
  const float min_disparity = std::max<float>(fB / camera.max_depth, step);
  const float max_disparity = std::min<float>(fB / camera.min_depth, kMaxDisparity);
  const auto outliers = static_cast<std::uint64_t>(camera.outlier_fraction * (1 << 22));
  const std::uint64_t stream = mix(seed);

  cv::Mat measured(height, width, CV_32FC1);
  parallel_rows(height, 16, [&](int first, int last) {
    for (int v = first; v < last; ++v) {
      float* out = measured.ptr<float>(v);
      for (int u = 0; u < width; ++u) {
        out[u] = kNaN;
        // 14 bits each for three normal draws, 22 bits for the outlier.
        const std::uint64_t bits = mix(stream + static_cast<std::uint64_t>(v) * width + u);
        const auto draw = [&](int i) {
          return normal[(bits >> (i * kQuantileBits)) & ((1 << kQuantileBits) - 1)];
        };
        if ((bits >> 42) < outliers) continue;
        const int us = std::clamp(static_cast<int>(std::lrint(u + lateral * draw(0))), 0, width - 1);
        const int vs = std::clamp(static_cast<int>(std::lrint(v + lateral * draw(1))), 0, height - 1);
        const float z = ideal_left.at<float>(vs, us);
        if (!(z > 0.0f)) continue;
        const float disparity = fB / z;
        // Shadow: the second imager must see the same point at u - d.
        const int ur = static_cast<int>(std::lrint(us - disparity));
        if (ur < 0) continue;
        const float z_right = ideal_right.at<float>(vs, ur);
        if (z_right > 0.0f && fB / z_right > disparity + kLeftRightTolerance) continue;
        const float noisy = disparity + sigma * draw(2);
        const float rounded = step > 0.0f ? std::nearbyint(noisy / step) * step : noisy;
        if (rounded < min_disparity || rounded > max_disparity) continue;
        out[u] = fB / rounded;
      }
    }
  });
  return measured;
}

cv::Mat capture_depth(Renderer& renderer, const CameraConfig& camera, std::uint64_t seed) {
  const Pose T_base_left = camera.T_base_depth();
  const Pose T_base_right = T_base_left * Eigen::Translation3d(camera.baseline, 0.0, 0.0);
  return stereo_depth(renderer.depth(camera.depth, T_base_left),
                      renderer.depth(camera.depth, T_base_right), camera, seed);
}

}  // namespace iwgnet_grasp::sensing
