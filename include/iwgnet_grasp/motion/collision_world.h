// What the arm must not touch, and the check of a configuration against it.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/grasping/height_map.h"

namespace iwgnet_grasp::motion {

// Part in the gripper, as a capsule in the TCP frame.
struct AttachedPart {
  Eigen::Vector3d a, b;  // m
  double radius;         // m
};

class CollisionWorld {
 public:
  explicit CollisionWorld(const CellConfig& cell);

  // Heights of the parts on the table; an empty map removes them.
  void set_heights(const grasping::HeightMap& heights);
  void set_gripper_gap(double gap);
  void set_attached(const std::optional<AttachedPart>& part);

  bool collides(const JointVector& q) const;
  // Names of what touches what, e.g. "wrist_3_link - camera"; empty when free.
  std::string describe(const JointVector& q) const;

 private:
  struct Sphere;
  CellConfig cell_;
  std::vector<Box> boxes_;
  std::vector<std::string> box_names_;
  grasping::HeightMap heights_;
  double gap_ = 0.085;
  std::optional<AttachedPart> attached_;
  template <typename Report>
  bool check(const JointVector& q, Report&& report) const;
};

}  // namespace iwgnet_grasp::motion
