// The whole simulated cell: physics, controllers, camera and judge behind one door. It is what the
// simulator node serves over ROS and what in-process trials and data generation drive directly.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "iwgnet_grasp/motion/pick_and_place.h"
#include "iwgnet_grasp/physics/controllers.h"
#include "iwgnet_grasp/physics/judge.h"
#include "iwgnet_grasp/physics/scene.h"
#include "iwgnet_grasp/sensing/stereo_depth.h"

namespace iwgnet_grasp::physics {

class SimulatedCell {
 public:
  // package_dir: the checkout (urdf/, config/, assets/). config_dir empty: package_dir/config.
  // Throws Error.
  explicit SimulatedCell(const std::string& package_dir, const std::string& config_dir = "");
  ~SimulatedCell();

  const CellConfig& config() const;

  // Arm to the observing pose, time to 0 (parts settle from there on), judge reset. An empty name
  // leaves the table bare. Returns the number of parts. Throws Error for an unknown scene.
  int load_scene(const std::string& scene, std::uint64_t seed);
  int load_scene(const SceneSpec& spec, std::uint64_t seed);
  void step(int steps = 1);  // controllers, physics, judge
  // Calls `watcher` about every `period` seconds of simulated time from within step(), whoever
  // steps: for films. An empty function ends it.
  void watch(double period, std::function<void()> watcher);
  double time() const;
  double timestep() const;

  // Driver side.
  ArmState arm() const;
  GripperState gripper() const;
  TrajectoryController& arm_controller();
  std::string start_trajectory(const motion::Trajectory& trajectory,
                               const TrajectoryTolerances& tolerances);
  void command_gripper(double gap, double force);
  GripperStatus gripper_status() const;
  double commanded_gap() const;

  // Camera. Noise is drawn from the scene's seed and the number of frames taken since.
  cv::Mat color();          // CV_8UC3 RGB
  cv::Mat depth();          // CV_32FC1 m, depth frame, NaN invalid
  cv::Mat aligned_depth(const cv::Mat& depth) const;  // in the colour frame
  // The camera that the images are taken with; config().camera until set. Its body and mount are
  // drawn where it is, the physics keeps them where config() says.
  const CameraConfig& camera() const;
  void set_camera(const CameraConfig& camera);
  // From now on, in every scene, the camera hangs where hands have mounted it: off its nominal pose
  // by what the seed draws from config/calibration.yaml.
  void offset_camera(std::uint64_t seed);

  // Bolts the calibration rig to the gripper, from the next scene on: a plate with this print (see
  // Renderer::add_sheet), off its nominal pose by what the seed draws. Scenes then begin with the
  // arm at the rig's start_joints. The plate is drawn; it has no mass and no contacts.
  void hold_board(const cv::Mat& print, std::uint64_t seed);
  bool has_board() const;
  // Pose of the board in the colour camera with the noise of simulated target poses; each index is
  // a draw of its own. Throws Error without a board.
  Pose measure_board(std::uint64_t index) const;

  // Ground truth: for the judge, for labels and for pictures only.
  Pose T_tool_board() const;              // Throws Error without a board.
  World& world();
  sensing::Renderer& renderer();          // poses brought up to date by sync_renderer()
  void sync_renderer();
  int part_instance(int part) const;      // renderer handle of a part
  const std::vector<PartModel>& models() const;  // of the scene's parts, by index
  cv::Mat ideal_depth();                  // CV_32FC1 m, colour frame, no noise
  cv::Mat part_mask();                    // CV_32SC1, colour frame: index of the part seen, or -1
  std::pair<cv::Mat, cv::Mat> ideal_view();  // both, at the price of one
  // Pixels that each part would cover in the colour image with nothing before it (its outline
  // within the image), counted at a quarter of the resolution.
  std::vector<double> unoccluded_areas();
  // Moves a part into a slot of the tray at once: for data of half-cleared tables, not for trials.
  void lay_in_tray(int part, int slot);
  // The scene's parts at rest in these poses, the arm at the observing pose, time 0, judge reset:
  // the same settled scene for one try after another. Camera, light and materials stay as they
  // are. Throws Error for another number of poses than of parts.
  void lay_parts(const std::vector<Pose>& T_base_part);
  void show_parts(bool shown);            // to the camera; the physics keeps them
  // From now on depth() and the ideal images hold only what lies this far (m) around the parts that
  // are not in the tray, NaN and -1 elsewhere: samples are cut out there. nullopt: all.
  void view_around_parts(std::optional<double> margin);
  void set_light(const sensing::Light& light);
  void set_part_material(int part, const sensing::Material& material);
  void set_table_material(const sensing::Material& material);
  Verdict verdict() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// Robot interface of pick and place on the simulated cell; time passes while it blocks.
class SimulatedRobot : public motion::Robot {
 public:
  explicit SimulatedRobot(SimulatedCell& cell) : cell_(cell) {}
  JointVector joints() override;
  motion::ExecutionResult execute(const motion::Trajectory& trajectory) override;
  motion::ExecutionResult execute_until_contact(const motion::Trajectory& trajectory,
                                                const JointVector& path_tolerance) override;
  motion::GripResult grip(double gap_m, double force_n) override;
  motion::GripResult preset(double gap_m, double force_n) override;
  double gap() override;

 private:
  motion::ExecutionResult follow(const motion::Trajectory& trajectory,
                                 const TrajectoryTolerances& tolerances);

  SimulatedCell& cell_;
};

}  // namespace iwgnet_grasp::physics
