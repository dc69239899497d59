#include "changed_tiles.h"

#include <algorithm>
#include <opencv2/imgproc.hpp>

#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr double kNear = 0.01;       // m, in front of the camera: hulls are cut off there
constexpr double kFarAway = 30000;   // px, drawn beyond the image's edges
constexpr double kBelowLamp = 0.05;  // m, least height of the lamp over what it shines on

}  // namespace

Points corners_of(const Eigen::AlignedBox3d& box) {
  Points corners;
  for (int i = 0; i < 8; ++i)
    corners.push_back(box.corner(static_cast<Eigen::AlignedBox3d::CornerType>(i)));
  return corners;
}

ChangedTiles::ChangedTiles(const PinholeIntrinsics& camera, const Pose& T_base_camera, int tile)
    : camera_(camera),
      T_camera_base_(T_base_camera.inverse()),
      tile_(tile),
      tiles_((camera.height + tile - 1) / tile, (camera.width + tile - 1) / tile, CV_8UC1,
             cv::Scalar(0)) {}

void ChangedTiles::mark(const Points& points) {
  Points in_front, behind;
  for (const Eigen::Vector3d& point : points) {
    const Eigen::Vector3d p = T_camera_base_ * point;
    (p.z() >= kNear ? in_front : behind).push_back(p);
  }
  // The edges of the hull that cross the near plane are among the lines between the two groups.
  Points cut;
  for (const Eigen::Vector3d& a : in_front)
    for (const Eigen::Vector3d& b : behind)
      cut.push_back(a + (b - a) * ((a.z() - kNear) / (a.z() - b.z())));
  in_front.insert(in_front.end(), cut.begin(), cut.end());
  if (in_front.empty()) return;
  std::vector<cv::Point> seen, hull;
  for (const Eigen::Vector3d& p : in_front) {
    const Eigen::Vector2d px = project(camera_, p) / tile_;
    seen.emplace_back(cvFloor(std::clamp(px.x(), -kFarAway, kFarAway)),
                      cvFloor(std::clamp(px.y(), -kFarAway, kFarAway)));
  }
  cv::convexHull(seen, hull);
  // A corner lies anywhere in its tile, so the hull may pass through the tile beside; and an image
  // filter looks at the neighbours.
  cv::Mat marked(tiles_.size(), CV_8UC1, cv::Scalar(0));
  cv::fillConvexPoly(marked, hull, 255);
  cv::polylines(marked, hull, true, 255);  // a hull without an area
  cv::dilate(marked, marked, cv::Mat::ones(5, 5, CV_8UC1));
  tiles_ |= marked;
}

Points shaded(const Points& corners, const Eigen::Vector3d& lamp, double radius, double range,
              double lowest) {
  Eigen::AlignedBox3d around;
  for (const Eigen::Vector3d& corner : corners) around.extend(corner);
  if (around.max().z() > lamp.z() - radius - kBelowLamp) return {};
  const Points reach = corners_of({Eigen::Vector3d::Constant(-range), Eigen::Vector3d::Constant(range)});
  Points points;
  for (const Eigen::Vector3d& corner : corners)
    for (const Eigen::Vector3d& by : reach) points.push_back(corner + by);
  const Eigen::AlignedBox3d lamps(Eigen::Vector3d(lamp.array() - radius),
                                  Eigen::Vector3d(lamp.array() + radius));
  for (const Eigen::Vector3d& from : corners_of(lamps))
    for (const Eigen::Vector3d& corner : corners) {
      const double way = (from.z() - lowest) / (from.z() - corner.z());
      points.push_back(from + (corner - from) * std::max(way, 1.0));
    }
  return points;
}

}  // namespace iwgnet_grasp::sensing
