#include "iwgnet_grasp/physics/world.h"

#include <BulletCollision/CollisionShapes/btBoxShape.h>
#include <BulletDynamics/Dynamics/btRigidBody.h>
#include <btBulletCollisionCommon.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "contact_solver.h"
#include "pieces.h"
#include "robot_body.h"

extern btScalar gDeactivationTime;
extern btScalar gContactBreakingThreshold;

namespace iwgnet_grasp::physics {
namespace {

constexpr double kGrips = 0.5;  // of the gripper's least force

// Groups as usual; of the robot's own links only those three arm joints apart may meet, the others
// are neighbours that overlap at their joints.
struct RobotFilter : btOverlapFilterCallback {
  bool needBroadphaseCollision(btBroadphaseProxy* a, btBroadphaseProxy* b) const override {
    if (!(a->m_collisionFilterGroup & b->m_collisionFilterMask) ||
        !(b->m_collisionFilterGroup & a->m_collisionFilterMask))
      return false;
    const auto rank = [](const btBroadphaseProxy* proxy) {
      const auto* object = static_cast<const btCollisionObject*>(proxy->m_clientObject);
      return static_cast<const Tag*>(object->getUserPointer())->rank;
    };
    const int ra = rank(a), rb = rank(b);
    return ra < 0 || rb < 0 || std::abs(ra - rb) >= 3;
  }
};

struct StaticBody {
  Tag tag;
  PiecesShape shape;
  btCollisionObject object;

  StaticBody(const std::string& name, const Eigen::Vector3d& size, const Pose& T_base_box,
             double friction, const PhysicsConfig& config)
      : tag{name} {
    auto box = std::make_unique<btBoxShape>(to_bullet(Eigen::Vector3d(size / 2)));
    box->setMargin(std::min(config.margin, size.minCoeff() / 4));
    shape.add(std::move(box), btTransform::getIdentity());
    object.setCollisionShape(&shape);
    object.setWorldTransform(to_bullet(T_base_box));
    object.setFriction(friction);
    object.setRestitution(config.restitution);
    object.setUserPointer(&tag);
    object.setActivationState(ISLAND_SLEEPING);  // else its pairs with sleeping parts cost time
  }
};

struct PartBody {
  Tag tag;
  int model;
  PiecesShape shape;
  std::unique_ptr<btRigidBody> body;
  Pose T_part_principal;
};

}  // namespace

struct World::Impl {
  Impl(const std::string& urdf_xml, const std::string& package_dir, const CellConfig& cell,
       const std::string& config_dir)
      : config(load_physics_config(config_dir)), model(urdf_xml, package_dir, config) {
    const auto box = [&](const std::string& name, const Box& b, double friction) {
      statics.push_back(std::make_unique<StaticBody>(
          name, b.size, Pose(Eigen::Translation3d(b.center)), friction, config));
    };
    box("table", cell.table, config.table_friction);
    for (const Box& b : cell.tray.boxes()) box("tray", b, config.tray_friction);
    for (const Box& b : cell.camera_mount) box("camera_mount", b, config.structure_friction);
    const Pose T_base_body =
        cell.camera.T_base_camera_link() * Eigen::Translation3d(cell.camera.body_center);
    statics.push_back(std::make_unique<StaticBody>("camera", cell.camera.body_size, T_base_body,
                                                   config.structure_friction, config));
    reset(cell.observe_joints);
  }
  ~Impl() { clear(); }

  void clear() {
    if (!world) return;
    for (auto& part : parts) world->removeRigidBody(part->body.get());
    parts.clear();
    if (robot && simulated) robot->remove_from(*world);
    robot.reset();
    for (auto& body : statics) world->removeCollisionObject(&body->object);
    world.reset();
  }

  // Everything of Bullet is made anew: caches and trees of an earlier scene must not show in the
  // bits of the next.
  void reset(const JointVector& q) {
    clear();
    gDeactivationTime = config.sleep_time;
    gContactBreakingThreshold = config.breaking_distance;
    collision = std::make_unique<PiecesConfiguration>();
    dispatcher = std::make_unique<btCollisionDispatcher>(collision.get());
    dispatcher->setDispatcherFlags(dispatcher->getDispatcherFlags() &
                                   ~btCollisionDispatcher::CD_USE_RELATIVE_CONTACT_BREAKING_THRESHOLD);
    broadphase = std::make_unique<btDbvtBroadphase>();
    broadphase->getOverlappingPairCache()->setOverlapFilterCallback(&filter);
    solver = std::make_unique<ContactSolver>();
    world = std::make_unique<ContactIslandWorld>(dispatcher.get(), broadphase.get(), solver.get(),
                                                 collision.get());
    world->setGravity(btVector3(0, 0, -config.gravity));
    world->setForceUpdateAllAabbs(false);
    auto& info = world->getSolverInfo();
    info.m_timeStep = config.timestep;
    info.m_solverMode = SOLVER_USE_WARMSTARTING | SOLVER_SIMD | SOLVER_USE_2_FRICTION_DIRECTIONS;
    info.m_erp2 = config.contact_erp;
    info.m_erp = config.contact_erp;
    info.m_linearSlop = config.linear_slop;
    info.m_splitImpulse = true;
    info.m_splitImpulsePenetrationThreshold = -config.linear_slop;
    for (auto& body : statics)
      world->addCollisionObject(&body->object, kStaticGroup, kPartGroup | kRobotGroup);
    robot = std::make_unique<RobotBody>(model, config, q);
    robot->add_to(*world);
    simulated = true;
    steps = 0;
  }

  PhysicsConfig config;
  RobotModel model;
  std::vector<std::unique_ptr<StaticBody>> statics;
  RobotFilter filter;
  std::unique_ptr<PiecesConfiguration> collision;
  std::unique_ptr<btCollisionDispatcher> dispatcher;
  std::unique_ptr<btDbvtBroadphase> broadphase;
  std::unique_ptr<ContactSolver> solver;
  std::unique_ptr<ContactIslandWorld> world;
  std::unique_ptr<RobotBody> robot;
  bool simulated = true;
  std::vector<std::unique_ptr<PartBody>> parts;
  long steps = 0;
};

World::World(const std::string& urdf_xml, const std::string& package_dir, const CellConfig& cell,
             const std::string& config_dir)
    : impl_(std::make_unique<Impl>(urdf_xml, package_dir, cell, config_dir)) {}
World::~World() = default;

void World::reset(const JointVector& q) { impl_->reset(q); }

int World::add_part(const PartModel& model, const Pose& T_base_part) {
  const auto& config = impl_->config;
  auto part = std::make_unique<PartBody>();
  const int index = part_count();
  part->tag = {"part:" + std::to_string(index), -1, index};
  part->model = index;
  const Principal p = principal_axes(model.mass, Eigen::Vector3d::Zero(), model.inertia);
  part->T_part_principal = p.T_body_principal;
  const Pose T_principal_part = p.T_body_principal.inverse();
  for (const auto& piece : model.pieces) {
    std::vector<Eigen::Vector3d> points;
    for (const auto& v : piece.vertices) points.push_back(T_principal_part * v.cast<double>());
    part->shape.add(rounded_hull(points, config.margin), btTransform::getIdentity());
  }
  btRigidBody::btRigidBodyConstructionInfo info(p.mass, nullptr, &part->shape,
                                                to_bullet(p.moments));
  info.m_startWorldTransform = to_bullet(Pose(T_base_part * part->T_part_principal));
  info.m_friction = config.part_friction;
  info.m_restitution = config.restitution;
  info.m_linearSleepingThreshold = config.sleep_linear;
  info.m_angularSleepingThreshold = config.sleep_angular;
  part->body = std::make_unique<btRigidBody>(info);
  part->body->setUserPointer(&part->tag);
  impl_->world->addRigidBody(part->body.get(), kPartGroup,
                             kStaticGroup | kPartGroup | kRobotGroup);
  impl_->parts.push_back(std::move(part));
  return index;
}

void World::set_part_pose(int part, const Pose& T_base_part) {
  auto& entry = *impl_->parts.at(part);
  btRigidBody& body = *entry.body;
  const btTransform T = to_bullet(Pose(T_base_part * entry.T_part_principal));
  body.setWorldTransform(T);
  body.setInterpolationWorldTransform(T);
  body.setLinearVelocity(btVector3(0, 0, 0));
  body.setAngularVelocity(btVector3(0, 0, 0));
  body.clearForces();
  // What lay on it or against it must not stay asleep in the air.
  for (auto& other : impl_->parts) {
    other->body->forceActivationState(ACTIVE_TAG);
    other->body->setDeactivationTime(0.0);
  }
  impl_->broadphase->getOverlappingPairCache()->cleanProxyFromPairs(body.getBroadphaseProxy(),
                                                                    impl_->dispatcher.get());
  impl_->world->updateSingleAabb(&body);
}

void World::simulate_robot(bool on) {
  if (on == impl_->simulated) return;
  impl_->simulated = on;
  if (on)
    impl_->robot->add_to(*impl_->world);
  else
    impl_->robot->remove_from(*impl_->world);
}

void World::step() {
  if (impl_->simulated) impl_->robot->drive();
  const auto& config = impl_->config;
  const bool grips = impl_->simulated && impl_->robot->gripper().force > kGrips * config.min_force;
  impl_->world->getSolverInfo().m_numIterations = grips ? config.grip_iterations : config.iterations;
  impl_->world->stepSimulation(config.timestep, 0);
  if (impl_->simulated) ++impl_->steps;
}

double World::timestep() const { return impl_->config.timestep; }
double World::time() const { return impl_->steps * impl_->config.timestep; }

void World::set_arm_setpoint(const JointVector& q, const JointVector& qd) {
  impl_->robot->set_arm_setpoint(q, qd);
}
void World::set_gripper_setpoint(double gap, double max_speed, double max_force) {
  impl_->robot->set_gripper_setpoint(gap, max_speed, max_force);
}

double World::reachable_gap(double gap) const { return RobotBody::reachable_gap(gap); }

ArmState World::arm() const { return impl_->robot->arm(); }
GripperState World::gripper() const { return impl_->robot->gripper(); }
std::vector<LinkPose> World::link_poses() const { return impl_->robot->link_poses(); }

int World::part_count() const { return static_cast<int>(impl_->parts.size()); }

PartState World::part(int index) const {
  const auto& part = *impl_->parts.at(index);
  PartState state;
  state.model = part.model;
  state.T_base_part =
      from_bullet(part.body->getWorldTransform()) * part.T_part_principal.inverse();
  state.linear = from_bullet(part.body->getLinearVelocity());
  state.angular = from_bullet(part.body->getAngularVelocity());
  return state;
}

std::vector<Contact> World::contacts() const {
  std::vector<Contact> result;
  std::vector<std::pair<const btCollisionObject*, const btCollisionObject*>> pairs;
  std::vector<double> strongest;
  const int manifolds = impl_->dispatcher->getNumManifolds();
  for (int m = 0; m < manifolds; ++m) {
    const btPersistentManifold& manifold = *impl_->dispatcher->getManifoldByIndexInternal(m);
    const btCollisionObject *a = manifold.getBody0(), *b = manifold.getBody1();
    const auto resting = [](const btCollisionObject* o) {
      return o->isStaticOrKinematicObject() || !o->isActive();
    };
    if (resting(a) && resting(b)) continue;  // its impulses are of the step before it fell asleep
    double impulse = 0.0, most = -1.0;
    btVector3 point;
    for (int i = 0; i < manifold.getNumContacts(); ++i) {
      const btManifoldPoint& p = manifold.getContactPoint(i);
      if (p.getDistance() > 0 && p.getAppliedImpulse() <= 0) continue;
      impulse += p.getAppliedImpulse();
      if (p.getAppliedImpulse() > most) {
        most = p.getAppliedImpulse();
        point = p.getPositionWorldOnB();
      }
    }
    if (most < 0) continue;
    const auto pair = std::make_pair(a, b);
    std::size_t k = 0;
    while (k < pairs.size() && pairs[k] != pair &&
           pairs[k] != std::make_pair(pair.second, pair.first))
      ++k;
    if (k == pairs.size()) {
      pairs.push_back(pair);
      strongest.push_back(-1.0);
      result.push_back({static_cast<const Tag*>(a->getUserPointer())->name,
                        static_cast<const Tag*>(b->getUserPointer())->name, 0.0,
                        Eigen::Vector3d::Zero()});
    }
    result[k].normal_force += impulse / impl_->config.timestep;
    if (most > strongest[k]) {
      strongest[k] = most;
      result[k].point = from_bullet(point);
    }
  }
  return result;
}

std::vector<Support> World::supports() const {
  std::map<std::pair<int, int>, double> forces;  // N, above 0 where the first of the pair carries
  for (int m = 0; m < impl_->dispatcher->getNumManifolds(); ++m) {
    const btPersistentManifold& manifold = *impl_->dispatcher->getManifoldByIndexInternal(m);
    const int a = static_cast<const Tag*>(manifold.getBody0()->getUserPointer())->part;
    const int b = static_cast<const Tag*>(manifold.getBody1()->getUserPointer())->part;
    if (a < 0 || b < 0) continue;
    double lift = 0.0;  // of a by b
    for (int i = 0; i < manifold.getNumContacts(); ++i) {
      const btManifoldPoint& p = manifold.getContactPoint(i);
      lift += p.getAppliedImpulse() * p.m_normalWorldOnB.z() / impl_->config.timestep;
    }
    forces[a < b ? std::pair(a, b) : std::pair(b, a)] += a < b ? -lift : lift;
  }
  std::vector<Support> result;
  for (const auto& [pair, force] : forces) {
    if (force > 0) result.push_back({pair.first, pair.second, force});
    if (force < 0) result.push_back({pair.second, pair.first, -force});
  }
  return result;
}

bool World::parts_at_rest() const {
  return std::all_of(impl_->parts.begin(), impl_->parts.end(), [](const auto& part) {
    const btRigidBody& body = *part->body;
    return !body.isActive();
  });
}

}  // namespace iwgnet_grasp::physics
