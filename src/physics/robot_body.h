// Arm and gripper as one multibody in a world: servos, drive, colliders.
#pragma once

#include <BulletDynamics/Featherstone/btMultiBody.h>
#include <BulletDynamics/Featherstone/btMultiBodyLinkCollider.h>

#include <kdl/chainidsolver_recursive_newton_euler.hpp>
#include <memory>
#include <string>
#include <vector>

#include "iwgnet_grasp/physics/world.h"
#include "joint_coupling.h"
#include "robot_model.h"

class btMultiBodyDynamicsWorld;

namespace iwgnet_grasp::physics {

// What a collision object is called; its user pointer.
struct Tag {
  std::string name;
  int rank = -1;   // RobotLink::rank, -1: no part of the robot
  int part = -1;   // index of a part
};

class RobotBody {
 public:
  // At rest at q with the gripper open. The model must outlive the body.
  RobotBody(const RobotModel& model, const PhysicsConfig& config, const JointVector& q);

  void add_to(btMultiBodyDynamicsWorld& world);
  void remove_from(btMultiBodyDynamicsWorld& world);

  void set_arm_setpoint(const JointVector& q, const JointVector& qd);
  void set_gripper_setpoint(double gap, double max_speed, double max_force);
  void drive();  // torques and drive rows of the step that follows

  static double reachable_gap(double gap);

  ArmState arm() const;
  GripperState gripper() const;
  std::vector<LinkPose> link_poses() const;

 private:
  double finger_angle() const;

  const RobotModel& model_;
  const PhysicsConfig& config_;
  std::unique_ptr<btMultiBody> body_;
  std::vector<std::unique_ptr<btMultiBodyLinkCollider>> colliders_;
  std::vector<std::unique_ptr<btCollisionObject>> base_;
  std::vector<std::unique_ptr<Tag>> tags_;
  std::vector<std::unique_ptr<btMultiBodyConstraint>> couplings_;
  JointCoupling* drive_ = nullptr;  // one of the couplings
  std::vector<int> knuckles_;       // multibody links that the drive turns
  KDL::ChainIdSolver_RNE dynamics_;
  JointVector q_set_, qd_set_, qd_set_before_, torque_;
  double gap_set_, speed_limit_, force_limit_;
};

}  // namespace iwgnet_grasp::physics
