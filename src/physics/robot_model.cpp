#include "robot_model.h"

#include <BulletCollision/CollisionShapes/btBoxShape.h>
#include <BulletCollision/CollisionShapes/btConvexHullShape.h>
#include <BulletCollision/CollisionShapes/btCylinderShape.h>
#include <BulletCollision/CollisionShapes/btSphereShape.h>
#include <urdf_model/model.h>
#include <urdf_parser/urdf_parser.h>

#include <functional>
#include <kdl/tree.hpp>
#include <kdl_parser/kdl_parser.hpp>
#include <map>

namespace iwgnet_grasp::physics {

Pose pose_of(const urdf::Pose& p) {
  Pose T = Pose::Identity();
  T.linear() = Eigen::Quaterniond(p.rotation.w, p.rotation.x, p.rotation.y, p.rotation.z)
                   .normalized()
                   .toRotationMatrix();
  T.translation() << p.position.x, p.position.y, p.position.z;
  return T;
}

std::string mesh_path(const std::string& uri, const std::string& package_dir) {
  const std::string scheme = "package://";
  if (uri.rfind(scheme, 0) != 0) return uri;
  const auto slash = uri.find('/', scheme.size());
  if (slash == std::string::npos)
    throw Error("URDF: mesh '" + uri + "' names no file; use package://NAME/PATH");
  return package_dir + uri.substr(slash);
}

namespace {

std::unique_ptr<btConvexInternalShape> collision_shape(const urdf::Geometry& geometry,
                                                       const std::string& package_dir,
                                                       double margin) {
  switch (geometry.type) {
    case urdf::Geometry::BOX: {
      const auto& d = static_cast<const urdf::Box&>(geometry).dim;
      auto box = std::make_unique<btBoxShape>(btVector3(d.x / 2, d.y / 2, d.z / 2));
      box->setMargin(margin);
      return box;
    }
    case urdf::Geometry::CYLINDER: {
      const auto& c = static_cast<const urdf::Cylinder&>(geometry);
      auto cylinder =
          std::make_unique<btCylinderShapeZ>(btVector3(c.radius, c.radius, c.length / 2));
      cylinder->setMargin(margin);
      return cylinder;
    }
    case urdf::Geometry::SPHERE:
      return std::make_unique<btSphereShape>(static_cast<const urdf::Sphere&>(geometry).radius);
    default: {
      const auto& mesh = static_cast<const urdf::Mesh&>(geometry);
      Pose scale = Pose::Identity();
      TriangleMesh triangles = load_stl(mesh_path(mesh.filename, package_dir));
      for (auto& v : triangles.vertices) {
        v.x() *= mesh.scale.x;
        v.y() *= mesh.scale.y;
        v.z() *= mesh.scale.z;
      }
      return reduced_hull(triangles, scale, margin);
    }
  }
}

// Adds a body's mass, given in a frame seen from the sum's frame, to the sum.
void add_mass(double& mass, Eigen::Vector3d& com, Eigen::Matrix3d& inertia, double m,
              const Eigen::Vector3d& c, const Eigen::Matrix3d& I, const Pose& T) {
  if (!(m > 0)) return;
  const auto about = [](double weight, const Eigen::Vector3d& d) -> Eigen::Matrix3d {
    return weight * (d.squaredNorm() * Eigen::Matrix3d::Identity() - d * d.transpose());
  };
  const Eigen::Vector3d point = T * c;
  const Eigen::Vector3d sum = (mass * com + m * point) / (mass + m);
  inertia += about(mass, com - sum);
  inertia += T.linear() * I * T.linear().transpose() + about(m, point - sum);
  com = sum;
  mass += m;
}

}  // namespace

RobotModel::~RobotModel() = default;

RobotModel::RobotModel(const std::string& urdf_xml, const std::string& package_dir,
                       const PhysicsConfig& config) {
  const urdf::ModelInterfaceSharedPtr urdf = urdf::parseURDF(urdf_xml);
  if (!urdf) throw Error("URDF: not a robot description; see the parser's message above");

  std::vector<urdf::LinkConstSharedPtr> sources;
  std::map<std::string, int> joint_link;
  const std::function<void(const urdf::LinkConstSharedPtr&, int)> visit =
      [&](const urdf::LinkConstSharedPtr& source, int parent) {
        RobotLink link;
        link.name = source->name;
        link.parent = parent;
        link.pad = link.name.find("finger_pad") != std::string::npos;
        if (source->parent_joint) {
          const auto& joint = *source->parent_joint;
          link.joint = joint.name;
          link.T_parent_joint = pose_of(joint.parent_to_joint_origin_transform);
          link.movable =
              joint.type == urdf::Joint::REVOLUTE || joint.type == urdf::Joint::CONTINUOUS;
          if (!link.movable && joint.type != urdf::Joint::FIXED)
            throw Error("URDF: joint '" + joint.name + "' is neither revolute nor fixed");
          link.axis = Eigen::Vector3d(joint.axis.x, joint.axis.y, joint.axis.z).normalized();
          joint_link[joint.name] = static_cast<int>(links_.size());
        }
        const int self = static_cast<int>(links_.size());
        links_.push_back(std::move(link));
        sources.push_back(source);
        for (const auto& child : source->child_links) visit(child, self);
      };
  visit(urdf->getRoot(), -1);

  for (int j = 0; j < kJoints; ++j) {
    const auto found = joint_link.find(kJointNames[j]);
    if (found == joint_link.end())
      throw Error(std::string("URDF: has no joint '") + kJointNames[j] + "'");
    arm_[j] = found->second;
  }
  if (!joint_link.count("finger_joint")) throw Error("URDF: has no joint 'finger_joint'");
  finger_ = joint_link.at("finger_joint");
  for (std::size_t i = 0; i < links_.size(); ++i) {
    const auto& joint = sources[i]->parent_joint;
    if (!joint || !joint->mimic) continue;
    const auto found = joint_link.find(joint->mimic->joint_name);
    if (found == joint_link.end())
      throw Error("URDF: joint '" + joint->name + "' mimics '" + joint->mimic->joint_name +
                  "', which is not there");
    links_[i].mimic = found->second;
    links_[i].ratio = joint->mimic->multiplier;
    links_[i].offset = joint->mimic->offset;
  }

  // Owner of a link's mass: itself when simulated, else the nearest simulated ancestor (or the
  // root). A fixed link that touches things is simulated as a fixed multibody link, so that its
  // contacts carry its name and friction; a mimic joint that carries nothing further (the 2F-85's
  // inner knuckles) bears no load of its own and only follows.
  std::vector<bool> grounded(links_.size());
  const std::vector<Pose> zero = poses(std::vector<double>(links_.size(), 0.0));
  for (std::size_t i = 0; i < links_.size(); ++i) {
    auto& link = links_[i];
    const auto& source = *sources[i];
    const bool root = link.parent < 0;
    grounded[i] = root || (!link.movable && grounded[link.parent]);
    link.rank = root ? 0 : links_[link.parent].rank;
    if (link.movable && link.mimic < 0 && static_cast<int>(i) != finger_) ++link.rank;
    if (link.name == "tool0") ++link.rank;
    const bool follower = link.mimic >= 0 && source.child_links.empty();
    const bool touches = !source.collision_array.empty() && !follower;
    if (link.movable && !follower && !touches)
      throw Error("URDF: link '" + link.name + "' moves but has no collision geometry");
    if (touches && !grounded[i]) {
      link.body = static_cast<int>(bodies_.size());
      bodies_.push_back(static_cast<int>(i));
    }
    if (source.inertial) {
      const auto& in = *source.inertial;
      const Pose T = pose_of(in.origin);
      Eigen::Matrix3d I;
      I << in.ixx, in.ixy, in.ixz, in.ixy, in.iyy, in.iyz, in.ixz, in.iyz, in.izz;
      int owner = static_cast<int>(i);
      while (links_[owner].body < 0 && links_[owner].parent >= 0) owner = links_[owner].parent;
      add_mass(links_[owner].mass, links_[owner].com, links_[owner].inertia, in.mass,
               Eigen::Vector3d::Zero(), I, zero[owner].inverse() * zero[i] * T);
    }
  }

  // Every arm joint and the gripper's own must have come out as bodies.
  for (std::size_t i = 0; i < links_.size(); ++i) {
    auto& link = links_[i];
    if (link.body >= 0) {
      Eigen::Matrix3d inertia = link.inertia;
      const bool knuckle = static_cast<int>(i) == finger_ ||
                           (link.mimic == finger_ && link.parent == links_[finger_].parent);
      if (knuckle) inertia += config.drive_inertia * link.axis * link.axis.transpose();
      else if (link.mimic == finger_) inertia += config.linkage_inertia * link.axis * link.axis.transpose();
      const Principal p = principal_axes(link.mass, link.com, inertia);
      link.T_link_principal = p.T_body_principal;
      link.inertia = p.moments.asDiagonal();
    }
    if (link.body < 0 && !grounded[i]) continue;
    if (sources[i]->collision_array.empty()) continue;
    link.shape = std::make_unique<PiecesShape>();
    for (const auto& collision : sources[i]->collision_array)
      link.shape->add(
          collision_shape(*collision->geometry, package_dir, config.margin),
          to_bullet(Pose(link.T_link_principal.inverse() * pose_of(collision->origin))));
  }

  KDL::Tree tree;
  if (!kdl_parser::treeFromUrdfModel(*urdf, tree) ||
      !tree.getChain(links_.front().name, "tool0", chain_) ||
      chain_.getNrOfJoints() != static_cast<unsigned>(kJoints))
    throw Error("URDF: no chain of six joints from '" + links_.front().name + "' to 'tool0'");
  double mass = 0;
  Eigen::Vector3d com = Eigen::Vector3d::Zero();
  Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();
  int tool0 = 0;
  while (links_[tool0].name != "tool0") ++tool0;
  for (std::size_t i = 0; i < links_.size(); ++i) {
    bool below = false;
    for (int k = static_cast<int>(i); k >= 0; k = links_[k].parent) below |= k == tool0;
    if (!below || !sources[i]->inertial) continue;
    const auto& in = *sources[i]->inertial;
    Eigen::Matrix3d I;
    I << in.ixx, in.ixy, in.ixz, in.ixy, in.iyy, in.iyz, in.ixz, in.iyz, in.izz;
    add_mass(mass, com, inertia, in.mass, Eigen::Vector3d::Zero(), I,
             zero[tool0].inverse() * zero[i] * pose_of(in.origin));
  }
  chain_.addSegment(KDL::Segment(
      "gripper", KDL::Joint(KDL::Joint::None), KDL::Frame::Identity(),
      KDL::RigidBodyInertia(mass, KDL::Vector(com.x(), com.y(), com.z()),
                            KDL::RotationalInertia(inertia(0, 0), inertia(1, 1), inertia(2, 2),
                                                   inertia(0, 1), inertia(0, 2), inertia(1, 2)))));
}

std::vector<Pose> RobotModel::poses(std::vector<double> q) const {
  std::vector<Pose> T(links_.size());
  for (std::size_t i = 0; i < links_.size(); ++i) {
    const auto& link = links_[i];
    if (link.mimic >= 0 && link.body < 0) q[i] = link.ratio * q[link.mimic] + link.offset;
    T[i] = link.parent < 0 ? Pose::Identity() : T[link.parent] * link.T_parent_joint;
    if (link.movable) T[i] = T[i] * Eigen::AngleAxisd(q[i], link.axis);
  }
  return T;
}

}  // namespace iwgnet_grasp::physics
