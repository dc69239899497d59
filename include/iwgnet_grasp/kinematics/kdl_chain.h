// Kinematics of any URDF chain by KDL.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::kinematics {

class KdlChain {
 public:
  // Throws Error when the URDF cannot be parsed or holds no chain root -> tip.
  KdlChain(const std::string& urdf_xml, const std::string& root, const std::string& tip);
  ~KdlChain();
  KdlChain(KdlChain&&) noexcept;

  const std::vector<std::string>& joint_names() const;
  Eigen::VectorXd lower() const;  // rad; -+2 pi for continuous joints
  Eigen::VectorXd upper() const;

  Pose forward(const Eigen::VectorXd& q) const;  // tip -> root
  // A solution within 1e-6 (m, rad) and the limits, found from `seed` and up to `restarts`
  // random seeds (deterministic); nullopt when none was found.
  std::optional<Eigen::VectorXd> inverse(const Pose& T_root_tip, const Eigen::VectorXd& seed,
                                         int restarts = 50) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace iwgnet_grasp::kinematics
