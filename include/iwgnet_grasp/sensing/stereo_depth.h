// Depth as an active stereo camera measures it (Eq. 4).
#pragma once

#include <cstdint>

#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::sensing {

// Disparity search range of the D4xx ASIC; the nearest depth is f B / 126 px.
inline constexpr double kMaxDisparity = 126.0;  // px

// Eq. 4: Z = f b / (x1 - x2). Disparity in px, f in px, b in m.
double depth_from_disparity(double disparity_px, double fx_px, double baseline_m);

// D455 depth image, CV_32FC1 m, NaN invalid: lateral shift and disparity noise, rounding to the
// sensor's step, the shadow that the second imager cannot see, outliers, range limits. Pixels
// draw from `seed`, whatever the number of threads.
// ideal_left, ideal_right: noise-free depth (CV_32FC1 m) of the left and the right imager.
// Throws Error when the images do not match.
cv::Mat stereo_depth(const cv::Mat& ideal_left, const cv::Mat& ideal_right,
                     const CameraConfig& camera, std::uint64_t seed);

// Renders the left imager, derives the right one's view from it and measures.
cv::Mat capture_depth(Renderer& renderer, const CameraConfig& camera, std::uint64_t seed);

}  // namespace iwgnet_grasp::sensing
