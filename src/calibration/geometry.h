// Steps of rigid transforms, shared by the estimators of this room.
#pragma once

#include <Eigen/Dense>
#include <algorithm>
#include <utility>
#include <vector>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::calibration {

using Vector6 = Eigen::Matrix<double, 6, 1>;

inline Eigen::Vector3d rotation_vector(const Eigen::Matrix3d& R) {
  const Eigen::AngleAxisd turn(R);
  return turn.angle() * turn.axis();
}

inline Eigen::Matrix3d cross(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

// T turned and moved by a small step (m, rad) in its own axes.
inline Pose moved(const Pose& T, const Vector6& step) {
  Pose result = T;
  const Eigen::Vector3d turn = step.tail<3>();
  const double angle = turn.norm();
  if (angle > 0) result.linear() = T.linear() * Eigen::AngleAxisd(angle, turn / angle);
  result.translation() += T.linear() * step.head<3>();
  return result;
}

inline double median(std::vector<double> values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Largest move (m, rad) of the camera's pose when one of the items is left out of `solve`, which
// makes a result with success and T_base_camera of the rest. A rest that cannot be solved counts for
// nothing.
template <class Item, class Solve>
std::pair<double, double> leave_one_out(const std::vector<Item>& items, const Pose& T_base_camera,
                                        const Solve& solve) {
  std::pair<double, double> spread{0.0, 0.0};
  for (std::size_t out = 0; out < items.size(); ++out) {
    std::vector<Item> rest = items;
    rest.erase(rest.begin() + static_cast<long>(out));
    const auto other = solve(rest);
    if (!other.success) continue;
    const Pose change = T_base_camera.inverse() * other.T_base_camera;
    spread.first = std::max(spread.first, change.translation().norm());
    spread.second = std::max(spread.second, rotation_vector(change.linear()).norm());
  }
  return spread;
}

}  // namespace iwgnet_grasp::calibration
