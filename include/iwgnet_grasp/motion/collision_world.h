// What the arm must not touch, and the check of a configuration against it.
//
// The arm, the gripper and a held part are covered by spheres; the cell is made of boxes, the parts
// on the table of columns of height. A check costs about a microsecond.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/grasping/height_map.h"

namespace iwgnet_grasp::motion {

// Part in the gripper, or a piece of it, as a capsule in the TCP frame of the present gap.
struct AttachedPart {
  Eigen::Vector3d a, b;  // m
  double radius;         // m
};

// The line along which the tool moves onto or off a part.
struct Column {
  Eigen::Vector3d point;                                // m, of tool0 in base_link
  Eigen::Vector3d axis = -Eigen::Vector3d::UnitZ();     // unit, tool0's z axis on it

  explicit Column(const Pose& T_base_tool)
      : point(T_base_tool.translation()), axis(T_base_tool.linear().col(2)) {}
};

class CollisionWorld {
 public:
  // The arm's bodies in chain order; kHeldPart only while a part is attached.
  enum Body { kBase, kShoulder, kUpperArm, kForearm, kWrist1, kWrist2, kWrist3, kGripper, kFingers,
              kHeldPart };
  static constexpr int kBodies = kHeldPart + 1;

  struct Sphere {
    Body body;
    Eigen::Vector3d center;  // m
    double radius;           // m
  };

  explicit CollisionWorld(const CellConfig& cell);

  // Heights of the parts on the table; an empty map removes them. Peaks narrower than three cells
  // are taken for noise.
  void set_heights(const grasping::HeightMap& heights);
  // Places the fingers. Default: wide open.
  void set_gripper_gap(double gap);
  void set_attached(const std::optional<AttachedPart>& part);
  void set_attached(const std::vector<AttachedPart>& pieces);
  // Within 3 mm of these lines, pointing along them, the gripper moves straight onto or off a part:
  // there its fingers and the held part are not checked against the heights, which the grasp pose
  // has cleared already, nor the held part against anything.
  void set_columns(const std::vector<Column>& columns);

  bool collides(const JointVector& q) const;
  // Names of what touches what, e.g. "wrist_3_link - camera"; empty when free.
  std::string describe(const JointVector& q) const;
  // The spheres at q in base_link.
  std::vector<Sphere> spheres(const JointVector& q) const;

 private:
  static constexpr int kCapacity = 160;  // spheres

  struct LocalSphere {
    Body body;
    int frame;               // 0 base_link, 1..6 DH frame of that joint
    Eigen::Vector3d center;  // in the frame
    double radius;
  };
  using Frames = std::array<Pose, kJoints>;
  struct BodySpheres {  // the spheres of a body and one around them all
    int first = 0, end = 0, frame = 0;
    Eigen::Vector3d center = Eigen::Vector3d::Zero();
    double radius = 0.0;
  };
  struct Placed {  // structure of arrays for the inner loops
    std::array<double, kCapacity> x, y, z, r;
  };
  struct Obstacle {
    std::string name;
    Eigen::Vector3d center, half;
  };
  struct Heights {  // with the highest value of each block of cells above it
    int columns = 0, rows = 0, block_columns = 0, block_rows = 0;
    double resolution = 0.0, max = 0.0;
    Eigen::Vector2d origin{0, 0};
    std::vector<float> cells, blocks;
  };

  void rebuild();
  bool in_column(const Pose& T_base_tool0) const;
  void place(Body body, const Frames& frames, Placed& placed) const;
  bool touches_heights(double x, double y, double z, double radius) const;
  // Calls report(name, name) for contacts until it returns true; returns whether it did.
  template <typename Report>
  bool check(const JointVector& q, Report&& report) const;

  std::vector<Obstacle> obstacles_;
  Heights heights_;
  double gap_;
  std::vector<AttachedPart> attached_;
  std::vector<Column> columns_;
  std::vector<LocalSphere> spheres_;  // in the order of Body
  std::array<BodySpheres, kBodies> bodies_;
};

}  // namespace iwgnet_grasp::motion
