#include "iwgnet_grasp/core/cell_config.h"

#include "iwgnet_grasp/core/yaml.h"

namespace iwgnet_grasp {
namespace {

PinholeIntrinsics intrinsics(const YamlFile& file, const std::string& key) {
  PinholeIntrinsics k;
  k.width = file.get<int>(key + ".width");
  k.height = file.get<int>(key + ".height");
  k.fx = file.get<double>(key + ".fx");
  k.fy = file.get<double>(key + ".fy");
  k.cx = file.get<double>(key + ".cx");
  k.cy = file.get<double>(key + ".cy");
  if (k.width <= 0 || k.height <= 0 || k.fx <= 0 || k.fy <= 0)
    file.fail(key, "needs a positive size and focal length");
  return k;
}

CameraConfig load_camera(const std::string& path) {
  const YamlFile file(path);
  CameraConfig camera;
  camera.color = intrinsics(file, "color");
  camera.depth = intrinsics(file, "depth");
  camera.baseline = file.get<double>("baseline");
  if (camera.baseline <= 0) file.fail("baseline", "must be positive");
  camera.T_depth_color = Pose(Eigen::Translation3d(Eigen::Vector3d(file.vector("color_offset", 3))));
  // Optical axes (x right, y down, z forward) in camera_link (x forward, y left, z up).
  camera.T_camera_link_depth = Pose::Identity();
  camera.T_camera_link_depth.linear() << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  camera.body_size = file.vector("body_size", 3);
  camera.body_center = file.vector("body_center", 3);
  camera.T_base_color = file.pose("T_base_color");
  camera.subpixel_sigma_px = file.get<double>("noise.subpixel_sigma_px");
  camera.disparity_step_px = file.get<double>("noise.disparity_step_px");
  camera.lateral_sigma_px = file.get<double>("noise.lateral_sigma_px");
  camera.outlier_fraction = file.get<double>("noise.outlier_fraction");
  camera.min_depth = file.get<double>("noise.min_depth");
  camera.max_depth = file.get<double>("noise.max_depth");
  return camera;
}

}  // namespace

std::vector<Eigen::Vector3d> TrayConfig::slots() const {
  std::vector<Eigen::Vector3d> result;
  // Nearest row first would put parts between the arm and the empty far row: fill the far row first.
  for (int row = rows - 1; row >= 0; --row)
    for (int column = 0; column < columns; ++column)
      result.emplace_back(
          center.x() + inner_size.x() * ((column + 0.5) / columns - 0.5),
          center.y() + inner_size.y() * ((row + 0.5) / rows - 0.5), floor_height);
  return result;
}

std::vector<Box> TrayConfig::boxes() const {
  const double t = wall_thickness, w = wall_height;
  const Eigen::Vector3d c(center.x(), center.y(), 0.0);
  const double hx = inner_size.x() / 2 + t / 2, hy = inner_size.y() / 2 + t / 2;
  std::vector<Box> boxes;
  boxes.push_back({c + Eigen::Vector3d(0, 0, floor_height / 2),
                   {inner_size.x(), inner_size.y(), floor_height}});
  for (const double side : {-1.0, 1.0}) {
    boxes.push_back({c + Eigen::Vector3d(side * hx, 0, w / 2), {t, inner_size.y() + 2 * t, w}});
    boxes.push_back({c + Eigen::Vector3d(0, side * hy, w / 2), {inner_size.x(), t, w}});
  }
  return boxes;
}

CellConfig load_cell_config(const std::string& config_dir) {
  const YamlFile file(config_dir + "/cell.yaml");
  CellConfig cell;
  cell.workspace_min = file.vector("workspace.min", 2);
  cell.workspace_max = file.vector("workspace.max", 2);
  if ((cell.workspace_min.array() >= cell.workspace_max.array()).any())
    file.fail("workspace", "min must be below max");
  cell.table = {file.vector("table.center", 3), file.vector("table.size", 3)};
  cell.tray.center = file.vector("tray.center", 2);
  cell.tray.inner_size = file.vector("tray.inner_size", 2);
  cell.tray.floor_height = file.get<double>("tray.floor_height");
  cell.tray.wall_height = file.get<double>("tray.wall_height");
  cell.tray.wall_thickness = file.get<double>("tray.wall_thickness");
  cell.tray.columns = file.get<int>("tray.columns");
  cell.tray.rows = file.get<int>("tray.rows");
  if (cell.tray.columns < 1 || cell.tray.rows < 1) file.fail("tray", "needs at least one slot");
  for (const auto& mount : file.node("camera_mount")) {
    Box box;
    try {
      const auto c = mount["center"].as<std::vector<double>>();
      const auto s = mount["size"].as<std::vector<double>>();
      box = {Eigen::Vector3d(c.at(0), c.at(1), c.at(2)), Eigen::Vector3d(s.at(0), s.at(1), s.at(2))};
    } catch (const std::exception&) {
      file.fail("camera_mount", "needs entries {center: [x, y, z], size: [x, y, z]}");
    }
    cell.camera_mount.push_back(box);
  }
  cell.observe_joints = file.vector("observe_joints", kJoints);
  cell.camera = load_camera(config_dir + "/camera.yaml");
  return cell;
}

Pose load_camera_pose(const std::string& path) { return YamlFile(path).pose("T_base_color"); }

}  // namespace iwgnet_grasp
