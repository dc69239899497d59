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
  const float fx = to.fx, fy = to.fy, cx = to.cx, cy = to.cy;
  const Eigen::Vector3f across = R.col(0) / from.fx, diagonal = across + R.col(1) / from.fy;
  constexpr float kFar = std::numeric_limits<float>::infinity();
  cv::Mat aligned(to.height, to.width, CV_32FC1, cv::Scalar(kFar));
  for (int v = 0; v < depth.rows; ++v) {
    const float* row = depth.ptr<float>(v);
    const Eigen::Vector3f first = R * deproject(from, -0.5, v - 0.5, 1.0).cast<float>();
    for (int u = 0; u < depth.cols; ++u) {
      const float z = row[u];
      if (!(z > 0.0f) || z == kFar) continue;
      const Eigen::Vector3f a = (first + across * static_cast<float>(u)) * z + t;
      const Eigen::Vector3f b = a + diagonal * z;
      if (a.z() <= 0.0f || b.z() <= 0.0f) continue;
      const float a_inverse = 1.0f / a.z(), b_inverse = 1.0f / b.z();
      const float ax = fx * a.x() * a_inverse + cx, bx = fx * b.x() * b_inverse + cx;
      const float ay = fy * a.y() * a_inverse + cy, by = fy * b.y() * b_inverse + cy;
      const int left = std::max(0, cvCeil(std::min(ax, bx)));
      const int right = std::min(to.width - 1, cvFloor(std::max(ax, bx)));
      const int top = std::max(0, cvCeil(std::min(ay, by)));
      const int bottom = std::min(to.height - 1, cvFloor(std::max(ay, by)));
      const float seen = 0.5f * (a.z() + b.z());
      for (int y = top; y <= bottom; ++y) {
        float* out = aligned.ptr<float>(y);
        for (int x = left; x <= right; ++x) out[x] = std::min(out[x], seen);
      }
    }
  }
  for (int y = 0; y < to.height; ++y)
    for (float *p = aligned.ptr<float>(y), *end = p + to.width; p != end; ++p)
      if (*p == kFar) *p = kNaN;
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
