#include "iwgnet_grasp/grasping/height_map.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::grasping {
namespace {

constexpr float kUnknown = -std::numeric_limits<float>::infinity();
constexpr double kTallest = 0.35;  // m, what may lie on the table below the camera

// Pixels that can show points of the rectangle between the table and kTallest.
cv::Rect pixels_of(const Eigen::Vector2d& low, const Eigen::Vector2d& high,
                   const PinholeIntrinsics& camera, const Pose& T_camera_base) {
  const cv::Rect image(0, 0, camera.width, camera.height);
  Eigen::Vector2d from(image.width, image.height), to(0, 0);
  for (int corner = 0; corner < 8; ++corner) {
    const Eigen::Vector3d p =
        T_camera_base * Eigen::Vector3d(corner & 1 ? high.x() : low.x(),
                                        corner & 2 ? high.y() : low.y(), corner & 4 ? kTallest : 0);
    if (p.z() < 0.05) return image;  // beside or behind the camera
    const Eigen::Vector2d px = sensing::project(camera, p);
    from = from.cwiseMin(px);
    to = to.cwiseMax(px);
  }
  const cv::Rect seen(cv::Point(std::floor(std::max(from.x(), 0.0)), std::floor(std::max(from.y(), 0.0))),
                      cv::Point(std::ceil(std::min<double>(to.x() + 1, image.width)),
                                std::ceil(std::min<double>(to.y() + 1, image.height))));
  return seen & image;
}

// Fills unknown cells ring by ring with the lowest or the highest of their known neighbours.
void fill_unknown(cv::Mat& grid, bool lowest) {
  std::vector<cv::Point> open;
  for (int r = 0; r < grid.rows; ++r)
    for (int c = 0; c < grid.cols; ++c)
      if (grid.at<float>(r, c) == kUnknown) open.emplace_back(c, r);
  if (open.size() == grid.total()) {
    grid.setTo(0.0f);
    return;
  }
  std::vector<std::pair<cv::Point, float>> filled;
  std::vector<cv::Point> rest;
  while (!open.empty()) {
    filled.clear();
    rest.clear();
    for (const cv::Point& cell : open) {
      float extreme = kUnknown;
      for (int r = std::max(cell.y - 1, 0); r <= std::min(cell.y + 1, grid.rows - 1); ++r)
        for (int c = std::max(cell.x - 1, 0); c <= std::min(cell.x + 1, grid.cols - 1); ++c)
          if (const float height = grid.at<float>(r, c); height != kUnknown)
            extreme = extreme == kUnknown ? height
                      : lowest            ? std::min(extreme, height)
                                          : std::max(extreme, height);
      if (extreme == kUnknown)
        rest.push_back(cell);
      else
        filled.emplace_back(cell, extreme);
    }
    for (const auto& [cell, height] : filled) grid.at<float>(cell) = height;
    open.swap(rest);
  }
}

}  // namespace

HeightMap::HeightMap(const cv::Mat& depth, const PinholeIntrinsics& camera,
                     const Pose& T_base_camera, const CellConfig& cell, double resolution,
                     double border)
    : resolution_(resolution) {
  if (depth.type() != CV_32FC1) throw Error("height map: needs a 32FC1 depth image in metres");
  if (depth.cols != camera.width || depth.rows != camera.height)
    throw Error("height map: depth image and camera info differ in size");
  if (!(resolution > 0)) throw Error("height map: the resolution must be positive");
  const Eigen::Vector2d low = cell.workspace_min.array() - border;
  const Eigen::Vector2d high = cell.workspace_max.array() + border;
  const int columns = static_cast<int>(std::ceil((high.x() - low.x()) / resolution));
  const int rows = static_cast<int>(std::ceil((high.y() - low.y()) / resolution));
  origin_ = low.array() + resolution / 2;
  grid_.create(rows, columns, CV_32FC1);
  grid_.setTo(kUnknown);

  const cv::Rect seen = pixels_of(low, high, camera, T_base_camera.inverse());
  // In units of cells across the grid, metres upwards.
  const float scale = 1.0 / resolution;
  const Eigen::Matrix3f R =
      Eigen::Vector3f(scale, scale, 1.0f).asDiagonal() * T_base_camera.rotation().cast<float>();
  const float tx = (T_base_camera.translation().x() - low.x()) * scale;
  const float ty = (T_base_camera.translation().y() - low.y()) * scale;
  const float tz = T_base_camera.translation().z();
  const float ax = R(0, 0) / camera.fx, ay = R(1, 0) / camera.fx, az = R(2, 0) / camera.fx;
  for (int v = seen.y; v < seen.y + seen.height; ++v) {
    const float* row = depth.ptr<float>(v);
    const Eigen::Vector3f ray = R.col(2) + R.col(1) * static_cast<float>((v - camera.cy) / camera.fy) -
                                R.col(0) * static_cast<float>(camera.cx / camera.fx);
    for (int u = seen.x; u < seen.x + seen.width; ++u) {
      const float z = row[u];
      if (!(z > 0.0f)) continue;
      const float column = (ray.x() + ax * u) * z + tx, line = (ray.y() + ay * u) * z + ty;
      if (!(column >= 0.0f && line >= 0.0f && column < columns && line < rows)) continue;
      float& cell_height = grid_.ptr<float>(static_cast<int>(line))[static_cast<int>(column)];
      cell_height = std::max(cell_height, (ray.z() + az * u) * z + tz);
    }
  }
  fill_unknown(grid_, true);
}

HeightMap HeightMap::seen_from(const Pose& T_base_view, double half) const {
  HeightMap view;
  view.resolution_ = resolution_;
  view.outside_ = -std::numeric_limits<double>::infinity();
  view.origin_.setConstant(-half + resolution_ / 2);
  const int size = static_cast<int>(std::ceil(2 * half / resolution_));
  view.grid_.create(size, size, CV_32FC1);
  view.grid_.setTo(kUnknown);
  const Pose T_view_base = T_base_view.inverse();
  // A point that the view shows may lie this far beside it on the table.
  const Eigen::Vector2d center = T_base_view.translation().head<2>();
  const double reach = half * M_SQRT2 + kTallest * T_base_view.linear().col(2).head<2>().norm();
  const auto index = [&](double value, double origin, int last) {
    return std::clamp(static_cast<int>((value - origin) / resolution_), 0, last);
  };
  const int c0 = index(center.x() - reach, origin_.x(), grid_.cols - 1);
  const int c1 = index(center.x() + reach, origin_.x(), grid_.cols - 1);
  const int r0 = index(center.y() - reach, origin_.y(), grid_.rows - 1);
  const int r1 = index(center.y() + reach, origin_.y(), grid_.rows - 1);
  for (int r = r0; r <= r1 && !grid_.empty(); ++r)
    for (int c = c0; c <= c1; ++c) {
      const float top = grid_.at<float>(r, c);
      // Down to the lowest neighbour: the wall of a step is seen from the side.
      float low = top;
      for (const auto& [dr, dc] : {std::pair{-1, 0}, {1, 0}, {0, -1}, {0, 1}})
        if (r + dr >= 0 && r + dr < grid_.rows && c + dc >= 0 && c + dc < grid_.cols)
          low = std::min(low, grid_.at<float>(r + dr, c + dc));
      for (double z = top; z >= low; z -= resolution_) {
        const Eigen::Vector3d p = T_view_base * Eigen::Vector3d(origin_.x() + c * resolution_,
                                                                origin_.y() + r * resolution_, z);
        const int column = static_cast<int>(std::floor((p.x() + half) / resolution_));
        const int row = static_cast<int>(std::floor((p.y() + half) / resolution_));
        if (column < 0 || row < 0 || column >= size || row >= size) continue;
        float& height = view.grid_.at<float>(row, column);
        height = std::max(height, static_cast<float>(p.z()));
      }
    }
  fill_unknown(view.grid_, false);
  return view;
}

double HeightMap::max_in(const Eigen::Vector2d& center, double yaw,
                         const Eigen::Vector2d& half) const {
  const Eigen::Vector2d along(std::cos(yaw), std::sin(yaw)), across(-along.y(), along.x());
  const int nx = std::max(1, static_cast<int>(std::ceil(2 * half.x() / resolution_)));
  const int ny = std::max(1, static_cast<int>(std::ceil(2 * half.y() / resolution_)));
  double highest = outside_;
  for (int i = 0; i <= nx; ++i)
    for (int j = 0; j <= ny; ++j) {
      const Eigen::Vector2d p = center + along * (half.x() * (2.0 * i / nx - 1)) +
                                across * (half.y() * (2.0 * j / ny - 1));
      highest = std::max(highest, at(p.x(), p.y()));
    }
  return highest;
}

}  // namespace iwgnet_grasp::grasping
