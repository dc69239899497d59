// Heights of the surface over the table, measured from a depth image.
#pragma once

#include <opencv2/core.hpp>

#include "iwgnet_grasp/core/cell_config.h"

namespace iwgnet_grasp::grasping {

class HeightMap {
 public:
  // Empty map: everything at z = 0.
  HeightMap() = default;
  // depth: CV_32FC1 m, NaN invalid; the highest point of each cell counts; cells without any
  // measurement take the lowest of their measured neighbours: a stereo camera sees least beside a
  // high edge, in the shadow that it throws on what lies below. Points outside the workspace
  // rectangle (widened by `border`) are left out: it lets the fingers of a grasp at the rim be
  // checked. Throws Error when image and camera do not match.
  HeightMap(const cv::Mat& depth, const PinholeIntrinsics& camera, const Pose& T_base_camera,
            const CellConfig& cell, double resolution = 0.002, double border = 0.11);

  // The same surface over the xy plane of another frame, `half` (m, along x and y) around its
  // origin, as heights along its z axis. What lies below a point of the surface is taken for solid.
  // Outside: -infinity.
  HeightMap seen_from(const Pose& T_base_view, const Eigen::Vector2d& half) const;

  // m above base_link's z = 0; 0 outside the map.
  double at(double x, double y) const {
    const double column = (x - origin_.x()) / resolution_ + 0.5;
    const double row = (y - origin_.y()) / resolution_ + 0.5;
    if (!(column >= 0.0 && row >= 0.0 && column < grid_.cols && row < grid_.rows)) return outside_;
    return grid_.ptr<float>(static_cast<int>(row))[static_cast<int>(column)];
  }
  // Highest value within an oriented rectangle: centre, yaw, half extents (m).
  double max_in(const Eigen::Vector2d& center, double yaw, const Eigen::Vector2d& half) const;

  double highest() const { return highest_; }  // m, of all cells
  const cv::Mat& grid() const { return grid_; }  // CV_32FC1, row = y, column = x
  Eigen::Vector2d origin() const { return origin_; }  // of cell (0, 0), m
  double resolution() const { return resolution_; }

 private:
  cv::Mat grid_;
  cv::Mat around_;  // of a map from an image: the lowest of each cell and its four neighbours
  Eigen::Vector2d origin_{0, 0};
  double resolution_ = 0.002, outside_ = 0.0;
  double highest_ = 0.0;
};

}  // namespace iwgnet_grasp::grasping
