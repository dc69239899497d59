#include "robot_body.h"

#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>
#include <BulletDynamics/Featherstone/btMultiBodyJointLimitConstraint.h>

#include <algorithm>
#include <cmath>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kUnlimited = 1e6;  // N m s: couplings are stiff gears, not drives

// d(gap)/d(finger_joint), m/rad, negative.
double gap_slope(double finger_joint) {
  constexpr double h = 1e-5;
  return (kinematics::gap_from_joint(finger_joint + h) -
          kinematics::gap_from_joint(finger_joint - h)) /
         (2 * h);
}

}  // namespace

RobotBody::RobotBody(const RobotModel& model, const PhysicsConfig& config, const JointVector& q)
    : model_(model),
      config_(config),
      dynamics_(model.chain(), KDL::Vector(0, 0, -config.gravity)),
      q_set_(q),
      qd_set_(JointVector::Zero()),
      qd_set_before_(JointVector::Zero()),
      torque_(JointVector::Zero()),
      gap_set_(kinematics::max_gap()),
      speed_limit_(config.max_speed),
      force_limit_(config.min_force) {
  const auto& links = model.links();
  const int count = static_cast<int>(model.bodies().size());
  body_ = std::make_unique<btMultiBody>(count, 0.0, btVector3(0, 0, 0), true, false);
  body_->setBaseWorldTransform(btTransform::getIdentity());
  body_->setHasSelfCollision(true);  // neighbours are kept apart by the broadphase filter
  body_->setLinearDamping(0.0);
  body_->setAngularDamping(0.0);
  body_->setUseGyroTerm(true);

  const std::vector<Pose> zero = model.poses(std::vector<double>(links.size(), 0.0));
  for (int b = 0; b < count; ++b) {
    const int index = model.bodies()[b];
    const RobotLink& link = links[index];
    // Nearest simulated ancestor; the links between are fixed to it.
    int parent = link.parent;
    while (parent >= 0 && links[parent].body < 0) parent = links[parent].parent;
    const int parent_body = parent < 0 ? -1 : links[parent].body;
    const Pose T_parent_principal = parent < 0 ? Pose::Identity() : links[parent].T_link_principal;
    const Pose T_ancestor_joint =
        (parent < 0 ? Pose::Identity() : zero[parent].inverse()) * zero[index];
    const btTransform a = to_bullet(Pose(T_parent_principal.inverse() * T_ancestor_joint));
    const btTransform b_inverse = to_bullet(Pose(link.T_link_principal.inverse()));
    const btQuaternion parent_to_this = b_inverse.getRotation() * a.inverse().getRotation();
    const btVector3 pivot_to_com = -b_inverse.getOrigin();
    const btVector3 com_from_pivot = pivot_to_com;
    const btVector3 moments = to_bullet(Eigen::Vector3d(link.inertia.diagonal()));
    if (link.movable)
      body_->setupRevolute(b, link.mass, moments, parent_body, parent_to_this,
                           quatRotate(b_inverse.getRotation(), to_bullet(link.axis)),
                           a.getOrigin(), com_from_pivot, true);
    else
      body_->setupFixed(b, link.mass, moments, parent_body, parent_to_this, a.getOrigin(),
                        com_from_pivot);
  }
  body_->finalizeMultiDof();
  for (int j = 0; j < kJoints; ++j) {
    body_->setJointPos(links[model.arm_link(j)].body, q[j]);
    body_->setJointVel(links[model.arm_link(j)].body, 0.0);
  }

  const auto friction = [&](btCollisionObject& object, const RobotLink& link) {
    object.setFriction(link.pad ? config.pad_friction : config.robot_friction);
    object.setRestitution(config.restitution);
    if (link.pad) {
      // Rubber: yields, so that the load spreads over the patch, and shears before it slides. A
      // rigid pad may carry all its load on one corner and let the part turn about it.
      object.setContactStiffnessAndDamping(config.pad_stiffness, config.pad_damping);
      object.setCollisionFlags(object.getCollisionFlags() |
                               btCollisionObject::CF_HAS_FRICTION_ANCHOR);
    }
    object.setActivationState(DISABLE_DEACTIVATION);
    tags_.push_back(std::make_unique<Tag>(Tag{link.name, link.rank, -1}));
    object.setUserPointer(tags_.back().get());
  };
  for (int b = 0; b < count; ++b) {
    const RobotLink& link = links[model.bodies()[b]];
    auto collider = std::make_unique<btMultiBodyLinkCollider>(body_.get(), b);
    collider->setCollisionShape(link.shape.get());
    friction(*collider, link);
    body_->getLink(b).m_collider = collider.get();
    colliders_.push_back(std::move(collider));
  }
  for (std::size_t i = 0; i < links.size(); ++i) {
    if (links[i].body >= 0 || !links[i].shape) continue;
    auto object = std::make_unique<btCollisionObject>();
    object->setCollisionShape(links[i].shape.get());
    object->setWorldTransform(to_bullet(zero[i]));
    friction(*object, links[i]);
    object->forceActivationState(ISLAND_SLEEPING);
    base_.push_back(std::move(object));
  }
  btAlignedObjectArray<btQuaternion> rotations;
  btAlignedObjectArray<btVector3> origins;
  body_->forwardKinematics(rotations, origins);
  body_->updateCollisionObjectWorldTransforms(rotations, origins);

  // Couplings of the fingers. A joint that mimics finger_joint is tied to the nearest joint above
  // it that does so too, which hands the pad's load to its own knuckle.
  const int finger = model.finger_link();
  const auto couple = [&](JointCoupling::Terms terms) {
    couplings_.push_back(std::make_unique<JointCoupling>(body_.get(), std::move(terms)));
    auto* coupling = static_cast<JointCoupling*>(couplings_.back().get());
    coupling->set_limit(kUnlimited);
    coupling->set_position_erp(config.coupling_erp);
    return coupling;
  };
  JointCoupling::Terms driven;
  for (const int index : model.bodies()) {
    const RobotLink& link = links[index];
    if (!link.movable || (index != finger && link.mimic != finger)) continue;
    int above = link.parent;
    while (above >= 0 && above != finger && links[above].mimic != finger)
      above = links[above].parent;
    if (above < 0) {
      driven.emplace_back(link.body, 1.0);
      knuckles_.push_back(link.body);
      if (index != finger) couple({{link.body, 1.0}, {links[finger].body, -link.ratio}});
    } else {
      const double ratio = above == finger ? 1.0 : links[above].ratio;
      couple({{link.body, 1.0}, {links[above].body, -link.ratio / ratio}});
    }
  }
  drive_ = couple(driven);
  drive_->set_position_erp(0.0);
  for (const int knuckle : knuckles_)
    couplings_.push_back(std::make_unique<btMultiBodyJointLimitConstraint>(
        body_.get(), knuckle, 0.0, kinematics::kMaxFingerJoint));
  for (auto& coupling : couplings_) coupling->finalizeMultiDof();
}

void RobotBody::add_to(btMultiBodyDynamicsWorld& world) {
  world.addMultiBody(body_.get());
  for (auto& object : base_)
    world.addCollisionObject(object.get(), kStaticGroup, kPartGroup | kRobotGroup);
  for (auto& collider : colliders_)
    world.addCollisionObject(collider.get(), kRobotGroup,
                             kStaticGroup | kPartGroup | kRobotGroup);
  for (auto& coupling : couplings_) world.addMultiBodyConstraint(coupling.get());
}

void RobotBody::remove_from(btMultiBodyDynamicsWorld& world) {
  for (auto& coupling : couplings_) world.removeMultiBodyConstraint(coupling.get());
  for (auto& collider : colliders_) world.removeCollisionObject(collider.get());
  for (auto& object : base_) world.removeCollisionObject(object.get());
  world.removeMultiBody(body_.get());
}

void RobotBody::set_arm_setpoint(const JointVector& q, const JointVector& qd) {
  q_set_ = q;
  qd_set_ = qd;
}

void RobotBody::set_gripper_setpoint(double gap, double max_speed, double max_force) {
  gap_set_ = reachable_gap(gap);
  speed_limit_ = std::clamp(max_speed, config_.min_speed, config_.max_speed);
  force_limit_ = std::clamp(max_force, config_.min_force, config_.max_force);
}

double RobotBody::reachable_gap(double gap) {
  return std::clamp(gap, kinematics::gap_from_joint(kinematics::kMaxFingerJoint),
                    kinematics::max_gap());
}

double RobotBody::finger_angle() const {
  double sum = 0.0;
  for (const int knuckle : knuckles_) sum += body_->getJointPos(knuckle);
  return sum / static_cast<double>(knuckles_.size());
}

void RobotBody::drive() {
  // Computed torque: tau = M(q) qdd + C(q, qd) qd + g(q) with qdd = the set point's acceleration
  // + 2 w (qd_set - qd) + w^2 (q_set - q), within the joints' torque limits.
  KDL::JntArray q(kJoints), qd(kJoints), qdd(kJoints), tau(kJoints);
  const double w = config_.bandwidth, limit = config_.max_acceleration;
  for (int j = 0; j < kJoints; ++j) {
    const int link = model_.links()[model_.arm_link(j)].body;
    q(j) = body_->getJointPos(link);
    qd(j) = body_->getJointVel(link);
    const double forward =
        std::clamp((qd_set_[j] - qd_set_before_[j]) / config_.timestep, -limit, limit);
    qdd(j) = forward + 2 * w * (qd_set_[j] - qd(j)) + w * w * (q_set_[j] - q(j));
  }
  qd_set_before_ = qd_set_;
  const KDL::Wrenches no_wrenches(model_.chain().getNrOfSegments(), KDL::Wrench::Zero());
  dynamics_.CartToJnt(q, qd, qdd, no_wrenches, tau);
  for (int j = 0; j < kJoints; ++j) {
    torque_[j] = std::clamp(tau(j), -config_.torque_limits[j], config_.torque_limits[j]);
    body_->addJointTorque(model_.links()[model_.arm_link(j)].body, torque_[j]);
  }

  // The drive turns all knuckles alike. By virtual work a squeeze F needs the torque
  // F |d(gap)/dq| / (number of knuckles) at each.
  const double angle = finger_angle();
  const double slope = gap_slope(angle);
  const double error = gap_set_ - kinematics::gap_from_joint(angle);
  const double gap_speed =
      std::clamp(config_.position_gain * error, -speed_limit_, speed_limit_);
  const double knuckles = static_cast<double>(knuckles_.size());
  drive_->set_rate(knuckles * gap_speed / slope);
  drive_->set_limit(force_limit_ * std::abs(slope) / knuckles * config_.timestep);
}

ArmState RobotBody::arm() const {
  ArmState state;
  for (int j = 0; j < kJoints; ++j) {
    const int link = model_.links()[model_.arm_link(j)].body;
    state.q[j] = body_->getJointPos(link);
    state.qd[j] = body_->getJointVel(link);
  }
  state.torque = torque_;
  return state;
}

GripperState RobotBody::gripper() const {
  GripperState state;
  state.finger_joint = finger_angle();
  state.gap = kinematics::gap_from_joint(state.finger_joint);
  const double slope = gap_slope(state.finger_joint);
  double speed = 0.0;
  for (const int knuckle : knuckles_) speed += body_->getJointVel(knuckle);
  const double knuckles = static_cast<double>(knuckles_.size());
  state.speed = slope * speed / knuckles;
  state.force = drive_->impulse() / config_.timestep * knuckles / std::abs(slope);
  return state;
}

std::vector<LinkPose> RobotBody::link_poses() const {
  const auto& links = model_.links();
  std::vector<double> q(links.size(), 0.0);
  for (std::size_t i = 0; i < links.size(); ++i)
    if (links[i].movable && links[i].body >= 0) q[i] = body_->getJointPos(links[i].body);
  const std::vector<Pose> poses = model_.poses(std::move(q));
  std::vector<LinkPose> result;
  result.reserve(links.size());
  for (std::size_t i = 0; i < links.size(); ++i) result.push_back({links[i].name, poses[i]});
  return result;
}

}  // namespace iwgnet_grasp::physics
