// The judge of a trial: watches ground truth every step and says what really happened.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "iwgnet_grasp/physics/world.h"

namespace iwgnet_grasp::physics {

struct PickVerdict {
  int part = -1;            // held part, -1 when none was
  bool success = false;     // gripped, carried without slip, drop or collision, ended in the tray
  std::string reason;       // "", missed, slipped, dropped, collided, not_in_tray
  double slip_mm = 0.0;     // largest motion of the part in the gripper from grip to release
  double slip_deg = 0.0;
  double grip_time = 0.0, release_time = 0.0;  // s
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  // m in base_link: where the part now is
};

struct Verdict {
  bool success = false;      // every part in the tray, one successful pick each, nothing else happened
  int parts = 0, in_tray = 0, on_table = 0, lost = 0;
  std::vector<PickVerdict> picks;          // in order of time, missed attempts included
  std::vector<std::string> collisions;     // "wrist_3_link - camera at 12.3 s, 80 N"
};

class Judge {
 public:
  // Limits are in config/judge.yaml: slip 5 mm / 5 deg, contact forces that count as a collision.
  Judge(const CellConfig& cell, const std::string& config_dir);

  void reset(const World& world);
  // To be called after each step with the gripper command now in force.
  void observe(const World& world, double commanded_gap);
  // The verdict on all that was seen; a part counts as in the tray by its centre of mass and rest.
  Verdict verdict(const World& world) const;

 private:
  struct Impl;
  std::shared_ptr<Impl> impl_;
};

std::string to_json(const Verdict& verdict);

}  // namespace iwgnet_grasp::physics
