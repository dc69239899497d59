// Steps of rigid transforms, shared by the estimators of this room.
#pragma once

#include <Eigen/Dense>
#include <algorithm>
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

}  // namespace iwgnet_grasp::calibration
