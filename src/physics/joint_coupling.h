// One row on joint speeds of a multibody: J qd = rate, by impulses within +-limit.
#pragma once

#include <BulletDynamics/Featherstone/btMultiBody.h>
#include <BulletDynamics/Featherstone/btMultiBodyConstraint.h>

#include <utility>
#include <vector>

namespace iwgnet_grasp::physics {

// Bullet's own gear constraint takes a pair of joints for two separate bodies and so leaves their
// inertial coupling out of the effective mass; here both are columns of one Jacobian row.
class JointCoupling : public btMultiBodyConstraint {
 public:
  using Terms = std::vector<std::pair<int, double>>;  // link, coefficient

  JointCoupling(btMultiBody* body, Terms terms);

  void set_rate(double rate) { rate_ = rate; }             // rad/s, wanted value of J qd
  void set_limit(double impulse) { m_maxAppliedImpulse = impulse; }  // N m s
  // Holds J q = 0 as well, correcting this share of the error each step.
  void set_position_erp(double erp) { erp_ = erp; }
  double impulse() { return getAppliedImpulse(0); }        // of the last step

  void finalizeMultiDof() override;
  int getIslandIdA() const override;
  int getIslandIdB() const override { return getIslandIdA(); }
  void createConstraintRows(btMultiBodyConstraintArray& rows, btMultiBodyJacobianData& data,
                            const btContactSolverInfo& info) override;
  void debugDraw(btIDebugDraw*) override {}

 private:
  Terms terms_;
  double rate_ = 0.0, erp_ = 0.0;
};

}  // namespace iwgnet_grasp::physics
