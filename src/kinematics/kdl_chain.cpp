#include "iwgnet_grasp/kinematics/kdl_chain.h"

#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <kdl/chain.hpp>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/chainiksolverpos_lma.hpp>
#include <kdl/tree.hpp>
#include <kdl_parser/kdl_parser.hpp>
#include <limits>
#include <random>

namespace iwgnet_grasp::kinematics {
namespace {

constexpr double kTolerance = 1e-6;  // m, rad: what counts as a solution
constexpr double kLmaEps = 1e-9;     // a looser one stops LMA short of kTolerance
constexpr int kLmaIterations = 200;
constexpr unsigned kSeed = 1;        // of the restarts

KDL::Frame to_kdl(const Pose& T) {
  KDL::Frame frame;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) frame.M(r, c) = T(r, c);
    frame.p[r] = T(r, 3);
  }
  return frame;
}

Pose from_kdl(const KDL::Frame& frame) {
  Pose T = Pose::Identity();
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) T(r, c) = frame.M(r, c);
    T(r, 3) = frame.p[r];
  }
  return T;
}

bool same_pose(const KDL::Frame& a, const KDL::Frame& b) {
  const KDL::Twist difference = KDL::diff(a, b);
  return difference.vel.Norm() < kTolerance && difference.rot.Norm() < kTolerance;
}

}  // namespace

struct KdlChain::Impl {
  KDL::Chain chain;
  std::vector<std::string> names;
  std::vector<bool> turns;  // revolute: any multiple of 2 pi is the same
  Eigen::VectorXd lower, upper;

  // Turned by 2 pi into the limits; false when that is not possible.
  bool into_limits(Eigen::VectorXd& q) const {
    for (int i = 0; i < q.size(); ++i) {
      if (turns[i]) {
        q[i] = std::remainder(q[i], 2 * M_PI);
        if (q[i] < lower[i]) q[i] += 2 * M_PI;
        if (q[i] > upper[i]) q[i] -= 2 * M_PI;
      }
      if (!(q[i] >= lower[i] && q[i] <= upper[i])) return false;
    }
    return true;
  }
};

KdlChain::KdlChain(const std::string& urdf_xml, const std::string& root, const std::string& tip)
    : impl_(std::make_unique<Impl>()) {
  const auto model = urdf::parseURDF(urdf_xml);
  if (!model) throw Error("URDF: cannot be parsed; check that it is a complete <robot> element");
  for (const std::string& link : {root, tip})
    if (!model->getLink(link)) throw Error("URDF '" + model->getName() + "' has no link '" + link + "'");
  KDL::Tree tree;
  if (!kdl_parser::treeFromUrdfModel(*model, tree))
    throw Error("URDF '" + model->getName() + "' is not a tree of supported joints");
  if (!tree.getChain(root, tip, impl_->chain) || impl_->chain.getNrOfJoints() == 0)
    throw Error("URDF '" + model->getName() + "' has no movable chain from '" + root + "' to '" +
                tip + "'");

  const int joints = static_cast<int>(impl_->chain.getNrOfJoints());
  impl_->lower.resize(joints);
  impl_->upper.resize(joints);
  for (const KDL::Segment& segment : impl_->chain.segments) {
    if (segment.getJoint().getType() == KDL::Joint::None) continue;
    const int i = static_cast<int>(impl_->names.size());
    const auto joint = model->getJoint(segment.getJoint().getName());
    impl_->names.push_back(joint->name);
    impl_->turns.push_back(joint->type != urdf::Joint::PRISMATIC);
    const bool limited = joint->type != urdf::Joint::CONTINUOUS && joint->limits;
    impl_->lower[i] = limited ? joint->limits->lower : -2 * M_PI;
    impl_->upper[i] = limited ? joint->limits->upper : 2 * M_PI;
  }
}

KdlChain::~KdlChain() = default;
KdlChain::KdlChain(KdlChain&&) noexcept = default;

const std::vector<std::string>& KdlChain::joint_names() const { return impl_->names; }
Eigen::VectorXd KdlChain::lower() const { return impl_->lower; }
Eigen::VectorXd KdlChain::upper() const { return impl_->upper; }

Pose KdlChain::forward(const Eigen::VectorXd& q) const {
  if (q.size() != impl_->lower.size())
    throw Error("KdlChain::forward: " + std::to_string(q.size()) + " joint values for " +
                std::to_string(impl_->lower.size()) + " joints");
  KDL::ChainFkSolverPos_recursive solver(impl_->chain);
  KDL::JntArray joints(q.size());
  joints.data = q;
  KDL::Frame frame;
  solver.JntToCart(joints, frame);
  return from_kdl(frame);
}

std::optional<Eigen::VectorXd> KdlChain::inverse(const Pose& T_root_tip, const Eigen::VectorXd& seed,
                                                 int restarts) const {
  if (seed.size() != impl_->lower.size())
    throw Error("KdlChain::inverse: " + std::to_string(seed.size()) + " joint values for " +
                std::to_string(impl_->lower.size()) + " joints");
  if (!T_root_tip.matrix().allFinite()) return std::nullopt;
  const KDL::Frame goal = to_kdl(T_root_tip);
  // LMA weighs rotation 100 times less by default; here 1 rad counts as 1 m.
  KDL::ChainIkSolverPos_LMA solver(impl_->chain, Eigen::Matrix<double, 6, 1>::Ones(), kLmaEps,
                                   kLmaIterations);
  KDL::ChainFkSolverPos_recursive check(impl_->chain);
  std::mt19937 random(kSeed);
  KDL::JntArray start(seed.size()), found(seed.size());
  start.data = seed;
  for (int attempt = 0; attempt <= restarts; ++attempt) {
    // The return code is not asked: LMA also ends well on a vanishing step; the pose decides.
    solver.CartToJnt(start, goal, found);
    Eigen::VectorXd q = found.data;
    if (q.allFinite() && impl_->into_limits(q)) {
      KDL::Frame reached;
      found.data = q;
      check.JntToCart(found, reached);
      if (same_pose(reached, goal)) return q;
    }
    for (int i = 0; i < seed.size(); ++i) {
      const double low = std::max(impl_->lower[i], -M_PI), high = std::min(impl_->upper[i], M_PI);
      start(i) = std::uniform_real_distribution<double>(std::min(low, high), std::max(low, high))(random);
    }
  }
  return std::nullopt;
}

}  // namespace iwgnet_grasp::kinematics
