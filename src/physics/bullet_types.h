// Between Eigen and Bullet, and what Bullet bodies are called.
#pragma once

#include <LinearMath/btTransform.h>

#include <memory>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/mesh.h"
#include "iwgnet_grasp/core/types.h"

class btConvexInternalShape;

namespace iwgnet_grasp::physics {

inline btVector3 to_bullet(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }
inline Eigen::Vector3d from_bullet(const btVector3& v) { return {v.x(), v.y(), v.z()}; }

inline btTransform to_bullet(const Pose& T) {
  const Eigen::Matrix3d R = T.linear();
  return btTransform(btMatrix3x3(R(0, 0), R(0, 1), R(0, 2), R(1, 0), R(1, 1), R(1, 2), R(2, 0),
                                 R(2, 1), R(2, 2)),
                     to_bullet(Eigen::Vector3d(T.translation())));
}

inline Pose from_bullet(const btTransform& T) {
  Pose pose = Pose::Identity();
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) pose.linear()(r, c) = T.getBasis()[r][c];
  pose.translation() = from_bullet(T.getOrigin());
  return pose;
}

// Mass properties turned to the principal axes that Bullet wants.
struct Principal {
  double mass;                // kg
  Eigen::Vector3d moments;    // kg m^2
  Pose T_body_principal;      // body frame of the model <- principal axes at the centre of mass
};
Principal principal_axes(double mass, const Eigen::Vector3d& com, const Eigen::Matrix3d& inertia);

// Convex hull of the points, its faces moved inwards by `margin` and rounded by as much, so that
// the outer size stays. Throws Error when the points span no volume.
std::unique_ptr<btConvexInternalShape> rounded_hull(const std::vector<Eigen::Vector3d>& points,
                                                    double margin);
// The same of at most 42 of the points, the extreme ones: for links of the robot.
std::unique_ptr<btConvexInternalShape> reduced_hull(const TriangleMesh& mesh, const Pose& T_shape_mesh,
                                                    double margin);

// Collision groups.
enum Group : int { kStaticGroup = 1, kPartGroup = 2, kRobotGroup = 4 };

}  // namespace iwgnet_grasp::physics
