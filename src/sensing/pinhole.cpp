#include "iwgnet_grasp/sensing/pinhole.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace iwgnet_grasp::sensing {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kMetresPerMillimetre = 0.001f;

void require_size(const cv::Mat& image, const PinholeIntrinsics& k) {
  if (image.cols == k.width && image.rows == k.height) return;
  throw Error("depth image is " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
              ", its camera " + std::to_string(k.width) + "x" + std::to_string(k.height) +
              "; pass the image together with its own camera info");
}

// Within bounds that an int holds, and without a jump, so that loops over pixels are vectorised.
int ceil_within(float low, float high, float x) {
  const float inside = std::min(high, std::max(low, x));
  const int truncated = static_cast<int>(inside);
  return truncated + (truncated < inside);
}
int floor_within(float low, float high, float x) {
  const float inside = std::min(high, std::max(low, x));
  const int truncated = static_cast<int>(inside);
  return truncated - (truncated > inside);
}

}  // namespace

Eigen::Vector3d deproject(const PinholeIntrinsics& k, double u, double v, double z) {
  return {(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z};
}

Eigen::Vector2d project(const PinholeIntrinsics& k, const Eigen::Vector3d& p) {
  return {k.fx * p.x() / p.z() + k.cx, k.fy * p.y() / p.z() + k.cy};
}

cv::Mat align_depth(const cv::Mat& depth, const PinholeIntrinsics& from,
                    const PinholeIntrinsics& to, const Pose& T_to_from) {
  if (depth.type() != CV_32FC1) throw Error("align_depth: needs a 32FC1 depth image in metres");
  require_size(depth, from);
  // A pixel covers a square, not a point: its corners are mapped and all that lies between is
  // filled, or a camera with the finer grid would see holes.
  const Eigen::Matrix3f R = T_to_from.rotation().cast<float>();
  const Eigen::Vector3f t = T_to_from.translation().cast<float>();
  const float fx = to.fx, fy = to.fy, cx = to.cx, cy = to.cy, width = to.width, height = to.height;
  const Eigen::Vector3f across = R.col(0) / from.fx, diagonal = across + R.col(1) / from.fy;
  constexpr float kFar = std::numeric_limits<float>::infinity();
  constexpr int kRun = 64;  // px, whose corners are computed in one vectorised loop
  cv::Mat aligned(to.height, to.width, CV_32FC1, cv::Scalar(kNaN));
  for (int v = 0; v < depth.rows; ++v) {
    const Eigen::Vector3f first = R * deproject(from, -0.5, v - 0.5, 1.0).cast<float>();
    for (int start = 0; start < depth.cols; start += kRun) {
      const float* z = depth.ptr<float>(v) + start;
      const int count = std::min(kRun, depth.cols - start);
      float nearest[kRun], seen[kRun];
      int left[kRun], right[kRun], top[kRun], bottom[kRun];
      for (int i = 0; i < count; ++i) {
        const float u = static_cast<float>(start + i);
        const float ax = (first.x() + across.x() * u) * z[i] + t.x(), bx = ax + diagonal.x() * z[i];
        const float ay = (first.y() + across.y() * u) * z[i] + t.y(), by = ay + diagonal.y() * z[i];
        const float az = (first.z() + across.z() * u) * z[i] + t.z(), bz = az + diagonal.z() * z[i];
        const float a_inverse = 1.0f / az, b_inverse = 1.0f / bz;
        const float au = fx * ax * a_inverse + cx, bu = fx * bx * b_inverse + cx;
        const float av = fy * ay * a_inverse + cy, bv = fy * by * b_inverse + cy;
        left[i] = ceil_within(0.0f, width, std::min(au, bu));
        right[i] = floor_within(-1.0f, width - 1.0f, std::max(au, bu));
        top[i] = ceil_within(0.0f, height, std::min(av, bv));
        bottom[i] = floor_within(-1.0f, height - 1.0f, std::max(av, bv));
        nearest[i] = std::min(az, bz);
        seen[i] = 0.5f * (az + bz);
      }
      for (int i = 0; i < count; ++i) {
        if (!(z[i] > 0.0f && z[i] < kFar && nearest[i] > 0.0f)) continue;
        for (int y = top[i]; y <= bottom[i]; ++y) {
          float* out = aligned.ptr<float>(y);
          for (int x = left[i]; x <= right[i]; ++x)
            if (!(out[x] <= seen[i])) out[x] = seen[i];
        }
      }
    }
  }
  return aligned;
}

cv::Mat depth_in_metres(const cv::Mat& depth) {
  cv::Mat metres(depth.rows, depth.cols, CV_32FC1);
  if (depth.type() == CV_16UC1) {
    for (int v = 0; v < depth.rows; ++v) {
      const auto* in = depth.ptr<std::uint16_t>(v);
      float* out = metres.ptr<float>(v);
      for (int u = 0; u < depth.cols; ++u)
        out[u] = in[u] == 0 ? kNaN : in[u] * kMetresPerMillimetre;
    }
  } else if (depth.type() == CV_32FC1) {
    for (int v = 0; v < depth.rows; ++v) {
      const float* in = depth.ptr<float>(v);
      float* out = metres.ptr<float>(v);
      for (int u = 0; u < depth.cols; ++u)
        out[u] = in[u] > 0.0f && std::isfinite(in[u]) ? in[u] : kNaN;
    }
  } else {
    throw Error("depth image has type " + cv::typeToString(depth.type()) +
                "; accepted are 16UC1 (millimetres) and 32FC1 (metres)");
  }
  return metres;
}

}  // namespace iwgnet_grasp::sensing
