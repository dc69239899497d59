#include "bullet_types.h"

#include <BulletCollision/CollisionShapes/btConvexHullShape.h>
#include <BulletCollision/CollisionShapes/btShapeHull.h>
#include <LinearMath/btConvexHullComputer.h>

#include <Eigen/Eigenvalues>

namespace iwgnet_grasp::physics {

Principal principal_axes(double mass, const Eigen::Vector3d& com, const Eigen::Matrix3d& inertia) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(inertia);
  Eigen::Matrix3d axes = solver.eigenvectors();
  if (axes.determinant() < 0) axes.col(0) = -axes.col(0);
  Principal p{mass, solver.eigenvalues(), Pose::Identity()};
  p.T_body_principal.linear() = axes;
  p.T_body_principal.translation() = com;
  return p;
}

std::unique_ptr<btConvexInternalShape> rounded_hull(const std::vector<Eigen::Vector3d>& points,
                                                    double margin) {
  btConvexHullComputer hull;
  constexpr double kClamp = 0.25;  // never by more than a quarter of the smallest half width
  const bool enough = points.size() >= 4;
  if (enough)
    hull.compute(points.data()->data(), sizeof(Eigen::Vector3d), static_cast<int>(points.size()),
                 margin, kClamp);
  if (!enough || hull.vertices.size() < 4)
    throw Error("a convex piece spans no volume; make the part's pieces again");
  auto shape = std::make_unique<btConvexHullShape>(
      reinterpret_cast<const btScalar*>(&hull.vertices[0]), hull.vertices.size(),
      sizeof(btVector3));
  shape->setMargin(margin);
  shape->recalcLocalAabb();  // made with Bullet's default margin of 40 mm until now
  return shape;
}

std::unique_ptr<btConvexInternalShape> reduced_hull(const TriangleMesh& mesh, const Pose& T_shape_mesh,
                                                    double margin) {
  btConvexHullShape full;
  for (const auto& v : mesh.vertices)
    full.addPoint(to_bullet(Eigen::Vector3d(T_shape_mesh * v.cast<double>())), false);
  full.recalcLocalAabb();
  full.setMargin(0.0);
  btShapeHull reduced(&full);
  reduced.buildHull(0.0);
  std::vector<Eigen::Vector3d> points;
  for (int i = 0; i < reduced.numVertices(); ++i)
    points.push_back(from_bullet(reduced.getVertexPointer()[i]));
  return rounded_hull(points, margin);
}

}  // namespace iwgnet_grasp::physics
