// Which pixels of an image a moved object may have changed. Private to the renderer.
#pragma once

#include <opencv2/core.hpp>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"

namespace iwgnet_grasp::sensing {

using Points = std::vector<Eigen::Vector3d>;  // m, base_link

Points corners_of(const Eigen::AlignedBox3d& box);

class ChangedTiles {
 public:
  // tile: px, side of the squares that are marked.
  ChangedTiles(const PinholeIntrinsics& camera, const Pose& T_base_camera, int tile);

  // The tiles that may see the points' convex hull, and their neighbours.
  void mark(const Points& points);
  void mark_all() { all_ = true; }
  bool at(int tile_row, int tile_column) const {
    return all_ || tiles_.ptr<std::uint8_t>(tile_row)[tile_column];
  }

 private:
  PinholeIntrinsics camera_;
  Pose T_camera_base_;
  int tile_;
  bool all_ = false;
  cv::Mat tiles_;  // CV_8UC1, 0 or 255
};

// Points whose hull holds a box (its corners) and all that it can shade above z = lowest (m): by a
// lamp within `radius` of `lamp`, and within `range` of the box by keeping the room's light off.
// Empty where part of the box is as high as the lamp and the shadow has no end.
Points shaded(const Points& corners, const Eigen::Vector3d& lamp, double radius, double range,
              double lowest);

}  // namespace iwgnet_grasp::sensing
