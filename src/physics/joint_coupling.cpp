#include "joint_coupling.h"

#include <BulletDynamics/ConstraintSolver/btContactSolverInfo.h>
#include <BulletDynamics/Featherstone/btMultiBodyLinkCollider.h>

namespace iwgnet_grasp::physics {

JointCoupling::JointCoupling(btMultiBody* body, Terms terms)
    : btMultiBodyConstraint(body, nullptr, terms.front().first, -1, 1, false,
                            MULTIBODY_CONSTRAINT_GEAR),
      terms_(std::move(terms)) {}

void JointCoupling::finalizeMultiDof() {
  allocateJacobiansMultiDof();
  constexpr int kBaseColumns = 6;  // present, though unused, for a fixed base too
  for (const auto& [link, coefficient] : terms_)
    jacobianA(0)[kBaseColumns + m_bodyA->getLink(link).m_dofOffset] = coefficient;
  m_numDofsFinalized = m_jacSizeBoth;
}

int JointCoupling::getIslandIdA() const {
  const auto* collider = m_bodyA->getLink(m_linkA).m_collider;
  return collider ? collider->getIslandTag() : -1;
}

void JointCoupling::createConstraintRows(btMultiBodyConstraintArray& rows,
                                         btMultiBodyJacobianData& data,
                                         const btContactSolverInfo& info) {
  if (m_numDofsFinalized != m_jacSizeBoth) finalizeMultiDof();
  double error = 0.0;
  for (const auto& [link, coefficient] : terms_)
    error += coefficient * m_bodyA->getJointPos(link);
  const double rate = rate_ - erp_ * error / info.m_timeStep;
  const btVector3 zero(0, 0, 0);
  auto& row = rows.expandNonInitializing();
  fillMultiBodyConstraint(row, data, jacobianA(0), nullptr, zero, zero, zero, zero, 0.0, info,
                          -m_maxAppliedImpulse, m_maxAppliedImpulse, false, 1.0, false, rate);
  row.m_orgConstraint = this;
  row.m_orgDofIndex = 0;
  row.m_contactNormal1.setZero();
  row.m_contactNormal2.setZero();
  row.m_relpos1CrossNormal.setZero();
  row.m_relpos2CrossNormal.setZero();
}

}  // namespace iwgnet_grasp::physics
