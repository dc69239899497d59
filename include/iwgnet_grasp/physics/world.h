// The physical cell in Bullet (float64, 1/480 s): arm and gripper as multibodies, parts, contacts.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/physics/part.h"

namespace iwgnet_grasp::physics {

struct ArmState {
  JointVector q, qd, torque;  // rad, rad/s, N m
};

struct GripperState {
  double gap = 0.0;           // m
  double speed = 0.0;         // m/s, negative when closing
  double force = 0.0;         // N, squeezed between the pads by the drive
  double finger_joint = 0.0;  // rad
};

struct PartState {
  int model = 0;  // index into the parts that were added
  Pose T_base_part = Pose::Identity();
  Eigen::Vector3d linear = Eigen::Vector3d::Zero();   // m/s
  Eigen::Vector3d angular = Eigen::Vector3d::Zero();  // rad/s
};

// Who touches whom in the last step. Names: URDF links, "table", "tray", "camera",
// "camera_mount", "part:INDEX".
struct Contact {
  std::string a, b;
  double normal_force;    // N, summed over the pair's contact points
  Eigen::Vector3d point;  // m, base_link, of the strongest
};

// A part that rests on another.
struct Support {
  int under, over;  // parts
  double force;     // N, the vertical part of the contacts' normal forces
};

struct LinkPose {
  std::string link;
  Pose T_base_link;
};

class World {
 public:
  // urdf_xml: cell description with package:// meshes resolved below package_dir.
  // config_dir: physics.yaml. Throws Error.
  World(const std::string& urdf_xml, const std::string& package_dir, const CellConfig& cell,
        const std::string& config_dir);
  ~World();

  // Removes all parts, puts the arm at rest at q with the gripper open, time to 0.
  void reset(const JointVector& q);
  // Index of the new part. Friction is physics.yaml's; a pair's coefficient is the product.
  int add_part(const PartModel& model, const Pose& T_base_part);
  void set_part_pose(int part, const Pose& T_base_part);  // at rest; for building scenes only
  // Takes the robot out of the simulation, or puts it back as it was: scenes settle without it, and
  // time() stands still meanwhile.
  void simulate_robot(bool on);

  void step();  // one step of timestep()
  double timestep() const;
  double time() const;

  // Servo set points; torques and forces are limited as physics.yaml says.
  void set_arm_setpoint(const JointVector& q, const JointVector& qd);
  void set_gripper_setpoint(double gap, double max_speed, double max_force);

  double reachable_gap(double gap) const;  // nearest gap within the gripper's stroke, m

  ArmState arm() const;
  GripperState gripper() const;
  std::vector<LinkPose> link_poses() const;  // every URDF link, mimic joints included

  // Ground truth.
  int part_count() const;
  PartState part(int index) const;
  std::vector<Contact> contacts() const;
  std::vector<Support> supports() const;  // of parts by parts; those asleep as they fell asleep
  bool parts_at_rest() const;  // all asleep: below the sleeping thresholds for their time

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace iwgnet_grasp::physics
