#include "iwgnet_grasp/sensing/stereo_depth.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "parallel.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kQuantileBits = 14;
// A match is kept when both imagers agree on the disparity this well, as stereo matchers check.
constexpr float kLeftRightTolerance = 0.75f;  // px

// What the right imager sees of the surfaces that the left one sees. An occluder that the left
// imager cannot see at all is missing; it would have to stand in another part's shadow.
cv::Mat right_view(const cv::Mat& left, float fB) {
  cv::Mat right(left.size(), CV_32FC1);
  const int width = left.cols;
  parallel_rows(left.rows, 16, [&](int first, int last) {
    std::vector<float> nearest(width);  // disparity, px; 0 where nothing was seen
    for (int v = first; v < last; ++v) {
      const float* in = left.ptr<float>(v);
      std::fill(nearest.begin(), nearest.end(), 0.0f);
      int before = -1;
      float disparity_before = 0.0f;
      for (int u = 0; u < width; ++u) {
        if (!(in[u] > 0.0f)) continue;
        const float disparity = fB / in[u];
        const int seen = cvRound(u - disparity);
        if (seen < 0 || seen >= width) continue;
        nearest[seen] = std::max(nearest[seen], disparity);
        // A slanted surface that the right imager sees wider leaves no gap.
        if (seen == before + 2 && std::abs(disparity - disparity_before) < 1.5f)
          nearest[seen - 1] = std::max(nearest[seen - 1], std::min(disparity, disparity_before));
        before = seen;
        disparity_before = disparity;
      }
      float* out = right.ptr<float>(v);
      for (int u = 0; u < width; ++u) out[u] = nearest[u] > 0.0f ? fB / nearest[u] : kNaN;
    }
  });
  return right;
}

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

// The rectangle of all pixels with a depth.
cv::Rect known(const cv::Mat& depth) {
  cv::Rect known;
  for (int v = 0; v < depth.rows; ++v) {
    const float *row = depth.ptr<float>(v), *end = row + depth.cols;
    const auto is_depth = [](float z) { return z > 0.0f; };
    const float* first = std::find_if(row, end, is_depth);
    if (first == end) continue;
    const float* last = end - 1;
    while (!is_depth(*last)) --last;
    known |= cv::Rect(static_cast<int>(first - row), v, static_cast<int>(last - first) + 1, 1);
  }
  return known;
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

  cv::Mat measured(height, width, CV_32FC1, kNaN);
  // Beside it nothing is measured: the renderer may have drawn a part of the image only.
  const int off = cvCeil(lateral * normal.back());
  cv::Rect seen = known(ideal_left);
  seen = cv::Rect(seen.tl() - cv::Point(off, off), seen.br() + cv::Point(off, off)) &
         cv::Rect(0, 0, width, height);
  parallel_rows(seen.height, 16, [&](int first, int last) {
    for (int v = seen.y + first; v < seen.y + last; ++v) {
      float* out = measured.ptr<float>(v);
      for (int u = seen.x; u < seen.br().x; ++u) {
        // 14 bits each for three normal draws, 22 bits for the outlier.
        const std::uint64_t bits = mix(stream + static_cast<std::uint64_t>(v) * width + u);
        const auto draw = [&](int i) {
          return normal[(bits >> (i * kQuantileBits)) & ((1 << kQuantileBits) - 1)];
        };
        if ((bits >> 42) < outliers) continue;
        const int us = std::clamp(cvRound(u + lateral * draw(0)), 0, width - 1);
        const int vs = std::clamp(cvRound(v + lateral * draw(1)), 0, height - 1);
        const float z = ideal_left.at<float>(vs, us);
        if (!(z > 0.0f)) continue;
        const float disparity = fB / z;
        // Shadow: the second imager must see the same point at u - d.
        const int ur = cvRound(us - disparity);
        if (ur < 0) continue;
        const float z_right = ideal_right.at<float>(vs, ur);
        if (z_right > 0.0f && fB / z_right > disparity + kLeftRightTolerance) continue;
        const float noisy = disparity + sigma * draw(2);
        const float rounded = step > 0.0f ? cvRound(noisy / step) * step : noisy;
        if (rounded < min_disparity || rounded > max_disparity) continue;
        out[u] = fB / rounded;
      }
    }
  });
  return measured;
}

cv::Mat capture_depth(Renderer& renderer, const CameraConfig& camera, std::uint64_t seed) {
  const cv::Mat left = renderer.depth(camera.depth, camera.T_base_depth());
  const float fB = camera.depth.fx * camera.baseline;
  return stereo_depth(left, right_view(left, fB), camera, seed);
}

}  // namespace iwgnet_grasp::sensing
