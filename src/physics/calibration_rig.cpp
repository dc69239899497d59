#include "iwgnet_grasp/physics/calibration_rig.h"

#include <random>

#include "iwgnet_grasp/core/yaml.h"

namespace iwgnet_grasp::physics {
namespace {

Offset load_offset(const YamlFile& file, const std::string& key) {
  const Offset offset{file.get<double>(key + ".translation"), file.get<double>(key + ".rotation")};
  if (!(offset.translation >= 0 && offset.rotation >= 0)) file.fail(key, "must not be negative");
  return offset;
}

template <typename Distribution>
Pose draw(const Offset& scale, Distribution distribution, std::mt19937_64& random) {
  const auto vector = [&] {
    const double x = distribution(random), y = distribution(random), z = distribution(random);
    return Eigen::Vector3d(x, y, z);
  };
  Pose T = Pose::Identity();
  T.translation() = scale.translation * vector();
  const Eigen::Vector3d turn = scale.rotation * vector();
  if (turn.norm() > 0) T.linear() = Eigen::AngleAxisd(turn.norm(), turn.normalized()).matrix();
  return T;
}

}  // namespace

CalibrationRig load_calibration_rig(const std::string& config_dir) {
  const YamlFile file(config_dir + "/calibration.yaml");
  CalibrationRig rig;
  rig.print_size = file.vector("board.print", 2);
  rig.plate = {file.vector("plate.center", 3), file.vector("plate.size", 3)};
  if (rig.print_size.minCoeff() <= 0 || rig.plate.size.minCoeff() <= 0)
    file.fail("plate", "sizes of plate and print must be positive");
  rig.T_tool_board = file.pose("rig.T_tool_board");
  rig.board_offset = load_offset(file, "rig.board_offset");
  rig.camera_offset = load_offset(file, "rig.camera_offset");
  rig.pose_noise = load_offset(file, "simulated_poses");
  rig.start_joints = file.vector("rig.start_joints", kJoints);
  return rig;
}

Pose draw_offset(const Offset& offset, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  return draw(offset, std::uniform_real_distribution<double>(-1.0, 1.0), random);
}

Pose draw_noise(const Offset& sigma, std::uint64_t seed, std::uint64_t index) {
  std::seed_seq both{seed, index};
  std::mt19937_64 random(both);
  return draw(sigma, std::normal_distribution<double>(), random);
}

}  // namespace iwgnet_grasp::physics
