#include "physics_config.h"

#include "iwgnet_grasp/core/yaml.h"

namespace iwgnet_grasp::physics {

PhysicsConfig load_physics_config(const std::string& config_dir) {
  const YamlFile file(config_dir + "/physics.yaml");
  const auto positive = [&](const std::string& key) {
    const double value = file.get<double>(key);
    if (!(value > 0)) file.fail(key, "must be above 0");
    return value;
  };
  const auto friction = [&](const std::string& surface) {
    const std::string key = "friction." + surface;
    const double value = file.get<double>(key);
    if (!(value > 0 && value <= 1.5)) file.fail(key, "must lie in (0, 1.5]");
    return value;
  };
  PhysicsConfig c;
  c.timestep = 1.0 / positive("step_rate");
  c.gravity = positive("gravity");
  c.iterations = file.get<int>("solver.iterations");
  if (c.iterations < 1) file.fail("solver.iterations", "must be at least 1");
  c.grip_iterations = file.get<int>("solver.grip_iterations");
  if (c.grip_iterations < c.iterations)
    file.fail("solver.grip_iterations", "must not be fewer than solver.iterations");
  c.contact_erp = positive("solver.contact_erp");
  c.linear_slop = file.get<double>("solver.linear_slop");
  c.coupling_erp = positive("solver.coupling_erp");
  c.margin = positive("contact.margin");
  c.breaking_distance = positive("contact.breaking_distance");
  c.restitution = file.get<double>("contact.restitution");
  c.sleep_linear = positive("sleeping.linear");
  c.sleep_angular = positive("sleeping.angular");
  c.sleep_time = positive("sleeping.time");
  c.part_friction = friction("part");
  c.pad_friction = friction("pad");
  c.robot_friction = friction("robot");
  c.table_friction = friction("table");
  c.tray_friction = friction("tray");
  c.structure_friction = friction("structure");
  c.torque_limits = file.vector("arm.torque_limits", kJoints);
  c.bandwidth = positive("arm.bandwidth");
  c.max_acceleration = positive("arm.max_acceleration");
  c.max_speed = positive("gripper.max_speed");
  c.min_speed = positive("gripper.min_speed");
  c.min_force = positive("gripper.min_force");
  c.max_force = positive("gripper.max_force");
  c.position_gain = positive("gripper.position_gain");
  c.drive_inertia = positive("gripper.drive_inertia");
  c.linkage_inertia = positive("gripper.linkage_inertia");
  c.pad_stiffness = positive("gripper.pad_stiffness");
  c.pad_damping = positive("gripper.pad_damping");
  return c;
}

}  // namespace iwgnet_grasp::physics
