// Shared by the physics tests: simple parts, and an arm that is led along straight lines.
#pragma once

#include <cmath>
#include <fstream>
#include <limits>
#include <memory>
#include <sstream>
#include <string>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/physics/controllers.h"
#include "iwgnet_grasp/physics/judge.h"
#include "iwgnet_grasp/physics/world.h"

namespace iwgnet_grasp::physics {

inline const std::string kSource = IWGNET_SOURCE_DIR;
inline const std::string kConfig = kSource + "/config";

inline std::string cell_urdf() {
  std::ifstream file(kSource + "/urdf/cell.urdf");
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

// A convex part with these corners; the inertia is a box's of the given size.
inline PartModel convex_part(const std::vector<Eigen::Vector3d>& corners,
                             const Eigen::Vector3d& size, double mass) {
  PartModel part;
  part.name = part.family = "block";
  part.mass = mass;
  const Eigen::Vector3d s = size.cwiseProduct(size);
  part.inertia =
      (mass / 12 * Eigen::Vector3d(s.y() + s.z(), s.x() + s.z(), s.x() + s.y())).asDiagonal();
  for (const auto& c : corners) part.mesh.vertices.push_back(c.cast<float>());
  part.mesh.triangles = {{0, 1, 2}};
  part.pieces = {part.mesh};
  return part;
}

inline PartModel block(const Eigen::Vector3d& size, double mass) {
  std::vector<Eigen::Vector3d> corners;
  for (int i = 0; i < 8; ++i)
    corners.push_back(
        (size / 2).cwiseProduct(Eigen::Vector3d(i & 1 ? 1 : -1, i & 2 ? 1 : -1, i & 4 ? 1 : -1)));
  return convex_part(corners, size, mass);
}

inline Pose at(double x, double y, double z) { return Pose(Eigen::Translation3d(x, y, z)); }

// tool0 with the tool straight down, its closing direction at `yaw`, the TCP of a gap at a point.
inline Pose tool_down(const Eigen::Vector3d& tcp, double yaw, double gap) {
  Pose T = Pose(Eigen::Translation3d(tcp)) * Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
           Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX());
  return T * kinematics::T_tool0_tcp(gap).inverse();
}

inline JointVector nearest_ik(const Pose& T_base_tool0, const JointVector& reference) {
  const auto solutions = kinematics::inverse(T_base_tool0);
  JointVector best = reference;
  double distance = std::numeric_limits<double>::infinity();
  for (int i = 0; i < solutions.count; ++i) {
    const JointVector q = kinematics::nearest_turn(solutions.q[i], reference);
    if ((q - reference).norm() < distance) {
      distance = (q - reference).norm();
      best = q;
    }
  }
  if (solutions.count == 0) throw Error("the test asks for a pose out of reach");
  return best;
}

// Leads arm and gripper, with the judge watching.
struct Rig {
  CellConfig cell = load_cell_config(kConfig);
  World world{cell_urdf(), kSource, cell, kConfig};
  Judge judge{cell, kConfig};
  GripperController gripper;
  JointVector q;
  double yaw = M_PI / 2;  // rad, of the closing direction: along base y
  Eigen::Vector3d tcp;
  double tcp_gap;  // gap at which `tcp` is the pads' midpoint

  // The arm stands with the pads' midpoint at `point` once they have closed to `gap`.
  Rig(const Eigen::Vector3d& point, double gap) : tcp(point), tcp_gap(gap) {
    JointVector reference = cell.observe_joints;
    reference[0] = 0.0;
    q = nearest_ik(tool_down(point, yaw, gap), reference);
    world.reset(q);
  }

  void step(const JointVector& set, const JointVector& speed) {
    world.set_arm_setpoint(set, speed);
    gripper.update(world, world.time());
    world.step();
    judge.observe(world, gripper.goal());
    q = set;
  }
  void hold(double seconds) {
    const int steps = static_cast<int>(std::lround(seconds / world.timestep()));
    const JointVector here = q;
    for (int i = 0; i < steps; ++i) step(here, JointVector::Zero());
  }
  void grip(double gap, double force, double seconds = 0.9) {
    gripper.start(gap, force, world.time());
    hold(seconds);
  }
  // Straight to `to` with a trapezoidal speed profile.
  void move(const Eigen::Vector3d& to, double speed, double acceleration) {
    const Eigen::Vector3d from = tcp;
    const double length = (to - from).norm(), dt = world.timestep();
    const double top = std::min(speed, std::sqrt(length * acceleration));
    const double ramp = top / acceleration, end = length / top + ramp;
    const int steps = static_cast<int>(std::ceil(end / dt));
    for (int i = 1; i <= steps; ++i) {
      const double t = std::min(i * dt, end);
      double s = top * (t - ramp / 2);
      if (t < ramp) s = acceleration * t * t / 2;
      else if (t > end - ramp) s = length - acceleration * (end - t) * (end - t) / 2;
      const JointVector next =
          nearest_ik(tool_down(from + (to - from) * (s / length), yaw, tcp_gap), q);
      step(next, (next - q) / dt);
    }
    tcp = to;
    hold(0.1);
  }
  // Turns the tool about its axis with a minimum-jerk profile.
  void turn(double angle, double duration) {
    const double from = yaw, dt = world.timestep();
    const int steps = static_cast<int>(std::ceil(duration / dt));
    for (int i = 1; i <= steps; ++i) {
      const double s = static_cast<double>(i) / steps;
      yaw = from + angle * s * s * s * (10 + s * (-15 + 6 * s));
      const JointVector next = nearest_ik(tool_down(tcp, yaw, tcp_gap), q);
      step(next, (next - q) / dt);
    }
    hold(0.1);
  }
  Pose tool() const { return kinematics::forward(world.arm().q); }
};

}  // namespace iwgnet_grasp::physics
