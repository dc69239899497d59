#include "contact_solver.h"

#include <BulletDynamics/ConstraintSolver/btSolverBody.h>

#include <algorithm>
#include <cmath>

namespace iwgnet_grasp::physics {
namespace {

constexpr int kBaseColumns = 6;  // of every multibody's speeds, unused where the base is fixed

using Vector = Eigen::Map<Eigen::Vector4d>;

Vector of(btVector3& v) { return Vector(v.m_floats); }

Eigen::Vector4d of(const btVector3& v) { return {v.x(), v.y(), v.z(), 0.0}; }

}  // namespace

btScalar ContactSolver::solveGroupCacheFriendlyIterations(
    btCollisionObject** bodies, int body_count, btPersistentManifold** manifolds,
    int manifold_count, btTypedConstraint** constraints, int constraint_count,
    const btContactSolverInfo& info, btIDebugDraw* drawer) {
  gathered_ = gather();
  const btScalar residual = btMultiBodyConstraintSolver::solveGroupCacheFriendlyIterations(
      bodies, body_count, manifolds, manifold_count, constraints, constraint_count, info, drawer);
  if (gathered_) give_back();
  gathered_ = false;
  return residual;
}

btScalar ContactSolver::solveSingleIteration(int iteration, btCollisionObject** bodies,
                                             int body_count, btPersistentManifold** manifolds,
                                             int manifold_count, btTypedConstraint** constraints,
                                             int constraint_count, const btContactSolverInfo& info,
                                             btIDebugDraw* drawer) {
  if (!gathered_)
    return btMultiBodyConstraintSolver::solveSingleIteration(
        iteration, bodies, body_count, manifolds, manifold_count, constraints, constraint_count,
        info, drawer);
  double residual = 0.0;
  const bool among_bodies = m_tmpSolverContactConstraintPool.size() > 0 ||
                            m_tmpSolverNonContactConstraintPool.size() > 0;
  if (among_bodies) {
    residual = btSequentialImpulseConstraintSolver::solveSingleIteration(
        iteration, bodies, body_count, manifolds, manifold_count, constraints, constraint_count,
        info, drawer);
    take_from_bodies();
  }
  const auto note = [&](double error) { residual = std::max(residual, error * error); };
  for (int i = 0; i < joints_; ++i) note(resolve(iteration & 1 ? i : joints_ - 1 - i));
  const int count = static_cast<int>(rows_.size()), frictions = joints_ + normals_;
  for (int i = joints_; i < frictions; ++i) note(resolve(i));
  for (int i = frictions; i < count; i += 2) note(resolve_cone(i));
  if (among_bodies) give_to_bodies();
  return residual;
}

bool ContactSolver::gather() {
  multibody_ = nullptr;
  rows_.clear();
  bodies_.clear();
  if (m_multiBodyTorsionalFrictionContactConstraints.size() > 0 ||
      m_multiBodySpinningFrictionContactConstraints.size() > 0)
    return false;
  joints_ = m_multiBodyNonContactConstraints.size();
  normals_ = m_multiBodyNormalContactConstraints.size();
  if (!gather(m_multiBodyNonContactConstraints, 0) ||
      !gather(m_multiBodyNormalContactConstraints, 0) ||
      !gather(m_multiBodyFrictionContactConstraints, joints_) || !multibody_)
    return false;
  const int count = static_cast<int>(rows_.size());
  if ((count - joints_ - normals_) % 2 != 0) return false;
  for (int i = joints_ + normals_; i < count; i += 2)
    if (rows_[i].normal != rows_[i + 1].normal) return false;

  delassus_.resize(count, count);
  speeds_.resize(count);
  for (int j = 0; j < count; ++j) {
    const Row& cause = rows_[j];
    for (int i = 0; i < count; ++i) {
      const Row& row = rows_[i];
      double& entry = delassus_(i, j);
      entry = row.jacobian.dot(cause.response);
      if (row.body && row.body == cause.body)
        entry += row.linear.dot(cause.linear_response) + row.angular.dot(cause.angular_response);
    }
  }
  const int dofs = multibody_->getNumDofs();
  for (int i = 0; i < count; ++i) {
    speeds_[i] = 0.0;
    for (int k = 0; k < dofs; ++k)
      speeds_[i] += rows_[i].jacobian[k] * m_data.m_deltaVelocities[first_speed_ + kBaseColumns + k];
  }
  take_from_bodies();
  return true;
}

bool ContactSolver::gather(btMultiBodyConstraintArray& from, int first_normal) {
  for (int i = 0; i < from.size(); ++i) {
    rows_.emplace_back();
    if (!gather(from[i], rows_.back())) return false;
    rows_.back().normal += first_normal;
  }
  return true;
}

bool ContactSolver::gather(btMultiBodySolverConstraint& from, Row& row) {
  row.jacobian.setZero();
  row.response.setZero();
  row.body = nullptr;
  const auto side = [&](btMultiBody* multibody, int jacobian, int speed, int solver_body,
                        const btVector3& normal, const btVector3& moment,
                        const btVector3& angular_component) {
    if (!multibody) {
      if (solver_body < 0 || !m_tmpSolverBodyPool[solver_body].m_originalBody) return true;
      btSolverBody& body = m_tmpSolverBodyPool[solver_body];
      row.linear = of(normal);
      row.angular = of(moment);
      row.linear_response = of(normal * body.internalGetInvMass() * body.m_linearFactor);
      row.angular_response = of(angular_component * body.internalGetAngularFactor());
      row.body = &body;
      const auto known = [&](const Body& other) { return other.body == &body; };
      if (std::none_of(bodies_.begin(), bodies_.end(), known))
        bodies_.push_back({&body, btVector3(0, 0, 0), btVector3(0, 0, 0)});
      return true;
    }
    const int dofs = multibody->getNumDofs();
    if (dofs > kMaxDofs || !multibody->hasFixedBase()) return false;
    if (multibody_ && multibody != multibody_) return false;
    multibody_ = multibody;
    first_speed_ = speed;
    for (int i = 0; i < dofs; ++i) {  // both sides may be links of the same multibody
      row.jacobian[i] += m_data.m_jacobians[jacobian + kBaseColumns + i];
      row.response[i] += m_data.m_deltaVelocitiesUnitImpulse[jacobian + kBaseColumns + i];
    }
    return true;
  };
  if (!side(from.m_multiBodyA, from.m_jacAindex, from.m_deltaVelAindex, from.m_solverBodyIdA,
            from.m_contactNormal1, from.m_relpos1CrossNormal, from.m_angularComponentA) ||
      !side(from.m_multiBodyB, from.m_jacBindex, from.m_deltaVelBindex, from.m_solverBodyIdB,
            from.m_contactNormal2, from.m_relpos2CrossNormal, from.m_angularComponentB))
    return false;
  row.rhs = from.m_rhs;
  row.cfm = from.m_cfm;
  row.inverse = from.m_jacDiagABInv;
  row.impulse = row.given = btScalar(from.m_appliedImpulse);
  row.lower = from.m_lowerLimit;
  row.upper = from.m_upperLimit;
  row.friction = from.m_friction;
  row.normal = from.m_frictionIndex;
  row.source = &from;
  return true;
}

// What rows between rigid bodies have changed since the last time.
void ContactSolver::take_from_bodies() {
  for (Body& known : bodies_) {
    const btVector3 linear = known.body->internalGetDeltaLinearVelocity();
    const btVector3 angular = known.body->internalGetDeltaAngularVelocity();
    const Eigen::Vector4d by = of(linear - known.linear), turned = of(angular - known.angular);
    known.linear = linear;
    known.angular = angular;
    for (std::size_t i = 0; i < rows_.size(); ++i)
      if (rows_[i].body == known.body)
        speeds_[i] += rows_[i].linear.dot(by) + rows_[i].angular.dot(turned);
  }
}

void ContactSolver::give_to_bodies() {
  for (Row& row : rows_) {
    if (!row.body || row.impulse == row.given) continue;
    const double by = row.impulse - row.given;
    of(row.body->internalGetDeltaLinearVelocity()) += row.linear_response * by;
    of(row.body->internalGetDeltaAngularVelocity()) += row.angular_response * by;
    row.given = row.impulse;
  }
  for (Body& known : bodies_) {
    known.linear = known.body->internalGetDeltaLinearVelocity();
    known.angular = known.body->internalGetDeltaAngularVelocity();
  }
}

void ContactSolver::give_back() {
  give_to_bodies();
  const int dofs = multibody_->getNumDofs();
  std::vector<btScalar> change(kBaseColumns + dofs, 0.0);
  for (const Row& row : rows_) {
    const double by = row.impulse - btScalar(row.source->m_appliedImpulse);
    for (int i = 0; i < dofs; ++i) change[kBaseColumns + i] += row.response[i] * by;
    row.source->m_appliedImpulse = row.impulse;
  }
  for (int i = 0; i < kBaseColumns + dofs; ++i)
    m_data.m_deltaVelocities[first_speed_ + i] += change[i];
  multibody_->applyDeltaVeeMultiDof2(change.data(), 1.0);
  multibody_->setPosUpdated(false);
}

double ContactSolver::wanted(int index) const {
  const Row& row = rows_[index];
  return row.impulse + (row.rhs - row.impulse * row.cfm - speeds_[index] * row.inverse);
}

double ContactSolver::resolve(int index) {
  Row& row = rows_[index];
  const double impulse = std::clamp(wanted(index), row.lower, row.upper);
  const double by = impulse - row.impulse;
  row.impulse = impulse;
  speeds_ += delassus_.col(index) * by;
  return by / row.inverse;
}

double ContactSolver::resolve_cone(int index) {
  Row &first = rows_[index], &second = rows_[index + 1];
  double a = wanted(index), b = wanted(index + 1);
  const double normal = rows_[first.normal].impulse;
  const double limit_a = first.friction * normal, limit_b = second.friction * normal;
  const double length2 = a * a + b * b;
  if (length2 >= limit_a * limit_b) {
    const double inverse = length2 > 0 ? 1 / std::sqrt(length2) : 0.0;
    a *= inverse * limit_a;
    b *= inverse * limit_b;
  }
  const double by_a = a - first.impulse, by_b = b - second.impulse;
  first.impulse = a;
  second.impulse = b;
  speeds_ += delassus_.col(index) * by_a + delassus_.col(index + 1) * by_b;
  return std::max(std::abs(by_a / first.inverse), std::abs(by_b / second.inverse));
}

}  // namespace iwgnet_grasp::physics
