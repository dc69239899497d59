// Pinhole model and extrinsics (Eq. 3), alignment of depth to colour.
#pragma once

#include <opencv2/core.hpp>

#include "iwgnet_grasp/core/cell_config.h"

namespace iwgnet_grasp::sensing {

// Pixel at depth z (along the optical axis) -> point in the optical frame.
Eigen::Vector3d deproject(const PinholeIntrinsics& k, double u, double v, double z);
// Point in the optical frame -> pixel. z must be positive.
Eigen::Vector2d project(const PinholeIntrinsics& k, const Eigen::Vector3d& p);

// Depth image (CV_32FC1 m, NaN invalid) of `from` as seen by `to`: nearest surface wins,
// NaN where nothing falls. Throws Error when image and camera differ in size.
cv::Mat align_depth(const cv::Mat& depth, const PinholeIntrinsics& from,
                    const PinholeIntrinsics& to, const Pose& T_to_from);

// 16UC1 millimetres (0 invalid) or 32FC1 metres (NaN invalid) -> 32FC1 metres. Throws Error
// on any other type.
cv::Mat depth_in_metres(const cv::Mat& depth);

}  // namespace iwgnet_grasp::sensing
