// Projected Gauss-Seidel over the rows of one multibody: what the gripper holds is most of the work
// of a simulation step.
#pragma once

#include <BulletDynamics/Featherstone/btMultiBodyConstraintSolver.h>

#include <Eigen/Core>
#include <vector>

namespace iwgnet_grasp::physics {

// btMultiBodyConstraintSolver with another inner loop. Rows, their order, limits and the friction
// cone are the same; results differ by rounding alone. Bullet takes each row's error from the speeds
// of all joints and hands its impulse back to them; here, with the rows' Delassus matrix
// A = J M^-1 J^T made once a step, an impulse changes the other rows' errors directly, with nothing
// to wait for between the two. Rows that this does not cover (a second multibody, a free base, rolling
// friction) are left to Bullet.
class ContactSolver : public btMultiBodyConstraintSolver {
 public:
  BT_DECLARE_ALIGNED_ALLOCATOR();

 protected:
  btScalar solveGroupCacheFriendlyIterations(btCollisionObject** bodies, int body_count,
                                             btPersistentManifold** manifolds, int manifold_count,
                                             btTypedConstraint** constraints, int constraint_count,
                                             const btContactSolverInfo& info,
                                             btIDebugDraw* drawer) override;
  btScalar solveSingleIteration(int iteration, btCollisionObject** bodies, int body_count,
                                btPersistentManifold** manifolds, int manifold_count,
                                btTypedConstraint** constraints, int constraint_count,
                                const btContactSolverInfo& info, btIDebugDraw* drawer) override;

 private:
  static constexpr int kMaxDofs = 12;  // six joints of the arm, six of the gripper

  // J v = rhs by an impulse in [lower, upper]. v: the multibody's speeds and a rigid body's.
  struct Row {
    Eigen::Matrix<double, kMaxDofs, 1> jacobian, response;  // response: M^-1 J^T
    Eigen::Vector4d linear, angular, linear_response, angular_response;  // the fourth is 0
    btSolverBody* body;         // nullptr: none that moves
    double rhs, cfm, inverse;   // inverse: 1 / (J M^-1 J^T + cfm)
    double lower, upper;
    double friction;            // coefficient, of a friction row
    int normal;                 // index of the row that bounds a friction row
    double impulse, given;      // given: what of it the rigid body has had
    btMultiBodySolverConstraint* source;
  };
  struct Body {
    btSolverBody* body;
    btVector3 linear, angular;  // change of its speed that speeds_ knows of
  };

  bool gather();
  bool gather(btMultiBodyConstraintArray& from, int first_normal);
  bool gather(btMultiBodySolverConstraint& from, Row& row);
  void take_from_bodies();
  void give_to_bodies();
  void give_back();
  double wanted(int row) const;  // impulse that makes the row true
  // These return the error of speed that they took away.
  double resolve(int row);
  double resolve_cone(int first);  // and the row behind it

  bool gathered_ = false;
  btMultiBody* multibody_ = nullptr;
  int first_speed_ = 0;    // of Bullet's array of all multibodies' changes of speed
  std::vector<Row> rows_;  // of joints, normals, and frictions in pairs
  int joints_ = 0, normals_ = 0;
  Eigen::MatrixXd delassus_;
  Eigen::VectorXd speeds_;  // J v of each row
  std::vector<Body> bodies_;
};

}  // namespace iwgnet_grasp::physics
