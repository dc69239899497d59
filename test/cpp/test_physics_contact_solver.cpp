// Against Bullet's own solver: a gripper of three sliders lifts a block off a floor with another
// block on it, so that rows of joints, of contact with the multibody and between rigid bodies meet.
#include <BulletDynamics/Featherstone/btMultiBodyDynamicsWorld.h>
#include <BulletDynamics/Featherstone/btMultiBodyJointMotor.h>
#include <BulletDynamics/Featherstone/btMultiBodyLinkCollider.h>
#include <btBulletDynamicsCommon.h>
#include <gtest/gtest.h>

#include <memory>

#include "../../src/physics/contact_solver.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kStep = 1.0 / 480;    // s
constexpr double kLift = 0.1;          // m/s
constexpr double kBlock = 0.04;        // m, side
constexpr double kFriction = 0.8;      // of each body; a pair's is the product
constexpr double kHand = 0.15;        // m, of the sliders above the fingers
constexpr double kSqueeze = 30.0;      // N

struct Lift {
  btDefaultCollisionConfiguration collision;
  btCollisionDispatcher dispatcher{&collision};
  btDbvtBroadphase broadphase;
  std::unique_ptr<btMultiBodyConstraintSolver> solver;
  std::unique_ptr<btMultiBodyDynamicsWorld> world;
  btBoxShape floor_shape{btVector3(1, 1, 0.1)}, block_shape{btVector3(1, 1, 1) * (kBlock / 2)};
  btBoxShape finger_shape{btVector3(0.005, 0.01, 0.01)};
  btRigidBody floor{{0, nullptr, &floor_shape}};
  btRigidBody block{{0.4, nullptr, &block_shape, btVector3(1, 1, 1) * 1e-4}};
  btRigidBody load{{0.2, nullptr, &block_shape, btVector3(1, 1, 1) * 5e-5}};
  btMultiBody gripper{3, 0.0, btVector3(0, 0, 0), true, false};
  std::vector<std::unique_ptr<btMultiBodyLinkCollider>> fingers;
  std::vector<std::unique_ptr<btMultiBodyJointMotor>> motors;

  explicit Lift(std::unique_ptr<btMultiBodyConstraintSolver> by) : solver(std::move(by)) {
    world = std::make_unique<btMultiBodyDynamicsWorld>(&dispatcher, &broadphase, solver.get(),
                                                       &collision);
    world->setGravity(btVector3(0, 0, -9.81));
    auto& info = world->getSolverInfo();
    info.m_timeStep = kStep;
    info.m_numIterations = 100;
    info.m_solverMode = SOLVER_USE_WARMSTARTING | SOLVER_SIMD | SOLVER_USE_2_FRICTION_DIRECTIONS;
    const auto add = [&](btRigidBody& body, double z) {
      body.setWorldTransform(btTransform(btQuaternion::getIdentity(), btVector3(0, 0, z)));
      body.setFriction(kFriction);
      body.setActivationState(DISABLE_DEACTIVATION);
      world->addRigidBody(&body);
    };
    add(floor, -0.1);
    add(block, kBlock / 2);
    add(load, 1.5 * kBlock);

    const btQuaternion straight = btQuaternion::getIdentity();
    const btVector3 moments = btVector3(1, 1, 1) * 1e-4, origin(0, 0, 0);
    gripper.setupPrismatic(0, 1.0, moments, -1, straight, btVector3(0, 0, 1),
                           btVector3(0, 0, kBlock / 2 + kHand), origin, true);
    for (const int side : {-1, 1})
      gripper.setupPrismatic(side < 0 ? 1 : 2, 0.2, moments, 0, straight, btVector3(-side, 0, 0),
                             btVector3(side * 0.03, 0, -kHand), origin, true);
    gripper.finalizeMultiDof();
    gripper.setHasSelfCollision(false);
    world->addMultiBody(&gripper);
    for (const int link : {0, 1, 2}) {
      fingers.push_back(std::make_unique<btMultiBodyLinkCollider>(&gripper, link));
      fingers.back()->setCollisionShape(&finger_shape);
      fingers.back()->setFriction(kFriction);
      world->addCollisionObject(fingers.back().get());
      gripper.getLink(link).m_collider = fingers.back().get();
    }
    btAlignedObjectArray<btQuaternion> rotations;
    btAlignedObjectArray<btVector3> origins;
    gripper.forwardKinematics(rotations, origins);
    gripper.updateCollisionObjectWorldTransforms(rotations, origins);
    for (const int link : {0, 1, 2}) {
      const double force = link == 0 ? 500.0 : kSqueeze;
      motors.push_back(std::make_unique<btMultiBodyJointMotor>(
          &gripper, link, link == 0 ? 0.0 : 0.05, force * kStep));
      motors.back()->finalizeMultiDof();
      world->addMultiBodyConstraint(motors.back().get());
    }
  }
  ~Lift() {
    for (auto& motor : motors) world->removeMultiBodyConstraint(motor.get());
    for (auto& finger : fingers) world->removeCollisionObject(finger.get());
    world->removeMultiBody(&gripper);
    for (auto* body : {&floor, &block, &load}) world->removeRigidBody(body);
  }

  void run(double seconds) {
    for (int i = 0; i < std::lround(seconds / kStep); ++i) world->stepSimulation(kStep, 0);
  }
  void squeeze_and_lift() {
    run(0.3);
    motors[0]->setVelocityTarget(kLift);
    run(0.5);
  }
};

TEST(ContactSolver, DoesWhatBulletsOwnDoes) {
  Lift ours(std::make_unique<ContactSolver>());
  Lift bullets(std::make_unique<btMultiBodyConstraintSolver>());
  ours.squeeze_and_lift();
  bullets.squeeze_and_lift();
  EXPECT_NEAR(ours.block.getWorldTransform().getOrigin().z(), kBlock / 2 + 0.5 * kLift, 2e-3);
  for (auto body : {&Lift::block, &Lift::load}) {
    const btTransform a = (ours.*body).getWorldTransform(), b = (bullets.*body).getWorldTransform();
    EXPECT_LT((a.getOrigin() - b.getOrigin()).length(), 1e-7);
    EXPECT_LT(a.getRotation().angleShortestPath(b.getRotation()), 1e-6);
  }
  for (int link = 0; link < 3; ++link) {
    EXPECT_NEAR(ours.gripper.getJointPos(link), bullets.gripper.getJointPos(link), 1e-7);
    EXPECT_NEAR(ours.motors[link]->getAppliedImpulse(0), bullets.motors[link]->getAppliedImpulse(0),
                1e-6);
  }
}

TEST(ContactSolver, LeavesRollingFrictionToBullet) {
  Lift ours(std::make_unique<ContactSolver>());
  Lift bullets(std::make_unique<btMultiBodyConstraintSolver>());
  for (Lift* lift : {&ours, &bullets}) {
    lift->block.setRollingFriction(0.01);
    for (auto& finger : lift->fingers) finger->setRollingFriction(0.01);
    lift->squeeze_and_lift();
  }
  EXPECT_EQ(ours.block.getWorldTransform().getOrigin().z(),
            bullets.block.getWorldTransform().getOrigin().z());
}

}  // namespace
}  // namespace iwgnet_grasp::physics
