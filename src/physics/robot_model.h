// The robot of the URDF as physics sees it: which links move, what they weigh, what they touch with.
#pragma once

#include <kdl/chain.hpp>
#include <memory>
#include <string>
#include <vector>

#include "bullet_types.h"
#include "physics_config.h"
#include "pieces.h"

namespace urdf {
class Pose;
}

namespace iwgnet_grasp::physics {

Pose pose_of(const urdf::Pose& p);  // of an <origin>; its quaternion need not be of unit length
// File of a mesh's URI; package://NAME/ stands for package_dir. Throws Error.
std::string mesh_path(const std::string& uri, const std::string& package_dir);

struct RobotLink {
  std::string name;
  int parent = -1;                  // index of the parent link, -1 for the root
  Pose T_parent_joint = Pose::Identity();
  std::string joint;                // empty for the root
  bool movable = false;             // revolute about `axis`
  Eigen::Vector3d axis{0, 0, 1};    // in the link's frame
  int mimic = -1;                   // link whose joint this one copies: q = ratio q' + offset
  double ratio = 1.0, offset = 0.0;

  // Mass of this link and of those that were lumped into it, in its own frame.
  double mass = 0.0;
  Eigen::Vector3d com = Eigen::Vector3d::Zero();
  Eigen::Matrix3d inertia = Eigen::Matrix3d::Zero();  // about com

  int body = -1;   // index of its multibody link; -1: root, lumped into its owner or kinematic
  int rank = 0;    // arm joints between the root and this link; the gripper counts as one more
  bool pad = false;
  std::unique_ptr<PiecesShape> shape;                 // in the principal frame of the link
  Pose T_link_principal = Pose::Identity();
};

class RobotModel {
 public:
  // Throws Error when the XML is no robot, a mesh is missing or an arm joint is not there.
  RobotModel(const std::string& urdf_xml, const std::string& package_dir,
             const PhysicsConfig& config);
  ~RobotModel();

  const std::vector<RobotLink>& links() const { return links_; }  // parents before children
  const std::vector<int>& bodies() const { return bodies_; }      // multibody link -> link
  int arm_link(int joint) const { return arm_[joint]; }           // link moved by an arm joint
  int finger_link() const { return finger_; }                     // link moved by finger_joint
  const KDL::Chain& chain() const { return chain_; }              // base_link -> gripper as payload

  // Poses of all links for the joint angle of each link (mimic links that are not simulated are
  // filled in from what they copy).
  std::vector<Pose> poses(std::vector<double> q) const;

 private:
  std::vector<RobotLink> links_;
  std::vector<int> bodies_;
  int arm_[kJoints];
  int finger_ = -1;
  KDL::Chain chain_;
};

}  // namespace iwgnet_grasp::physics
