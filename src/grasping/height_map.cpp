#include "iwgnet_grasp/grasping/height_map.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
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
  for (int r = 0; r < grid.rows; ++r) {
    const float* row = grid.ptr<float>(r);
    for (int c = 0; c < grid.cols; ++c)
      if (row[c] == kUnknown) open.emplace_back(c, r);
  }
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
  cv::minMaxLoc(grid_, nullptr, &highest_);
  cv::erode(grid_, around_, cv::getStructuringElement(cv::MORPH_CROSS, {3, 3}));
}

HeightMap HeightMap::seen_from(const Pose& T_base_view, const Eigen::Vector2d& half) const {
  HeightMap view;
  view.resolution_ = resolution_;
  view.outside_ = -std::numeric_limits<double>::infinity();
  // The origin is a cell's middle: what is asked for in whole cells from there lies on no border.
  const int right = static_cast<int>(std::ceil(half.x() / resolution_));
  const int up = static_cast<int>(std::ceil(half.y() / resolution_));
  view.origin_ = -resolution_ * Eigen::Vector2d(right, up);
  const int columns = 2 * right + 1, rows = 2 * up + 1, cells = rows * columns;
  view.grid_.create(rows, columns, CV_32FC1);
  // One more, for what lies outside.
  thread_local std::vector<float> highest_buffer;
  highest_buffer.assign(cells + 1, kUnknown);
  float* const highest = highest_buffer.data();
  const Pose T_view_base = T_base_view.inverse();
  // In cells of the view and, upwards, metres.
  const float scale = 1.0 / resolution_, step = resolution_;
  const Eigen::Vector3f units(scale, scale, 1.0f);
  const Eigen::Matrix3f R = units.asDiagonal() * T_view_base.linear().cast<float>();
  const Eigen::Vector3f along_column = R.col(0) * step, along_row = R.col(1) * step, upwards = R.col(2);
  const Eigen::Vector3f corner =
      units.cwiseProduct((T_view_base * Eigen::Vector3d(origin_.x(), origin_.y(), 0.0)).cast<float>()) +
      Eigen::Vector3f(right + 0.5f, up + 0.5f, 0.0f);
  const int last_column = grid_.cols - 1;
  thread_local std::vector<int> cell_buffer;
  thread_local std::vector<float> height_buffer;
  cell_buffer.resize(grid_.cols);
  height_buffer.resize(grid_.cols);
  int* const cell_of_top = cell_buffer.data();
  float* const height = height_buffer.data();
  // m down a wall from column to column and from row to row of the view
  const float per_column = 1.0f / std::max(std::abs(upwards.x()), 1e-6f);
  const float per_row = 1.0f / std::max(std::abs(upwards.y()), 1e-6f);
  const int i_step = upwards.x() > 0.0f ? -1 : 1, j_step = upwards.y() > 0.0f ? -1 : 1;
  for (int r = 0; r < grid_.rows; ++r) {
    const Eigen::Vector3f ground = corner + along_row * static_cast<float>(r);
    // The columns from which something between the table and `highest_` comes to lie in the view.
    float first = 0.0f, last = last_column;
    for (const int axis : {0, 1}) {
      const float rise = upwards[axis] * static_cast<float>(highest_);
      const float low = -ground[axis] - std::max(rise, 0.0f);
      const float high = (axis ? rows : columns) - ground[axis] - std::min(rise, 0.0f);
      const float slope = along_column[axis];
      if (std::abs(slope) < 1e-6f) {
        if (low > 0.0f || high < 0.0f) last = -1.0f;
        continue;
      }
      first = std::max(first, std::min(low / slope, high / slope));
      last = std::min(last, std::max(low / slope, high / slope));
    }
    const int begin = static_cast<int>(std::ceil(first)), end = static_cast<int>(last) + 1;
    const float *row = grid_.ptr<float>(r), *around = around_.ptr<float>(r);
    const auto cell_at = [&](float x, float y) {
      const bool inside = (x >= 0.0f) & (y >= 0.0f) & (x < columns) & (y < rows);
      const int cell = static_cast<int>(y) * columns + static_cast<int>(x);
      return inside ? cell : cells;
    };
    for (int c = begin; c < end; ++c) {  // without memory in common: four columns at a time
      const float column = c, z = row[c];
      cell_of_top[c] = cell_at(ground.x() + along_column.x() * column + upwards.x() * z,
                               ground.y() + along_column.y() * column + upwards.y() * z);
      height[c] = ground.z() + along_column.z() * column + upwards.z() * z;
    }
    for (int c = begin; c < end; ++c) {
      const float top = height[c];
      highest[cell_of_top[c]] = std::max(highest[cell_of_top[c]], top);
      // Down to the lowest neighbour: the wall of a step is seen from the side. Through the cells of
      // the view as by Amanatides and Woo (1987).
      const float wall = row[c] - around[c];
      if (wall < step) continue;
      const float x = ground.x() + along_column.x() * c + upwards.x() * row[c];
      const float y = ground.y() + along_column.y() * c + upwards.y() * row[c];
      int i = cvFloor(x), j = cvFloor(y);
      // m of the way down to the next column and to the next row
      float to_column = (upwards.x() > 0.0f ? x - i : i + 1 - x) * per_column;
      float to_row = (upwards.y() > 0.0f ? y - j : j + 1 - y) * per_row;
      for (float down; (down = std::min(to_column, to_row)) <= wall;) {
        if (to_column < to_row) {
          i += i_step;
          to_column += per_column;
        } else {
          j += j_step;
          to_row += per_row;
        }
        if (i < 0 || j < 0 || i >= columns || j >= rows) continue;
        float& there = highest[j * columns + i];
        there = std::max(there, top - upwards.z() * down);
      }
    }
  }
  std::copy_n(highest, cells, view.grid_.ptr<float>());
  fill_unknown(view.grid_, false);
  cv::minMaxLoc(view.grid_, nullptr, &view.highest_);
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
