// The cell: config/cell.yaml and config/camera.yaml read into values.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp {

struct Box {              // axis-aligned in base_link
  Eigen::Vector3d center;  // m
  Eigen::Vector3d size;    // m, full extents
};

struct TrayConfig {
  Eigen::Vector2d center;      // m, base_link, of the inner floor
  Eigen::Vector2d inner_size;  // m, along base x and y
  double floor_height;         // m above the table top
  double wall_height;          // m above the table top
  double wall_thickness;       // m
  int columns, rows;           // slots along x and y

  // Whether a point (m, base_link, seen from above) lies within the walls.
  bool covers(const Eigen::Vector2d& p) const {
    return ((p - center).cwiseAbs().array() <= inner_size.array() / 2).all();
  }
  // Slot centres on the floor in filling order, the far row first.
  std::vector<Eigen::Vector3d> slots() const;
  // Floor and four walls as collision boxes.
  std::vector<Box> boxes() const;
};

struct PinholeIntrinsics {
  int width = 0, height = 0;  // px
  double fx = 0, fy = 0;      // px
  double cx = 0, cy = 0;      // px; the centre of the top left pixel is (0, 0)
};

struct CameraConfig {
  PinholeIntrinsics color;   // also of the depth aligned to colour
  PinholeIntrinsics depth;   // left infrared imager
  double baseline;           // m, between the infrared imagers
  Pose T_depth_color;        // colour optical -> depth optical
  Pose T_camera_link_depth;  // depth optical -> camera_link
  Pose T_base_color;         // nominal colour optical -> base_link (Eq. 22)
  Eigen::Vector3d body_size, body_center;  // m, in camera_link
  // Noise of the depth image, see config/camera.yaml.
  double subpixel_sigma_px, disparity_step_px, lateral_sigma_px, outlier_fraction;
  double min_depth, max_depth;  // m

  Pose T_base_depth() const { return T_base_color * T_depth_color.inverse(); }
  Pose T_base_camera_link() const { return T_base_depth() * T_camera_link_depth.inverse(); }
};

struct CellConfig {
  Eigen::Vector2d workspace_min, workspace_max;  // m, base_link: where parts may lie
  Box table;                                      // top at z = 0
  TrayConfig tray;
  CameraConfig camera;
  std::vector<Box> camera_mount;  // pole and beam that hold the camera
  JointVector observe_joints;     // rad: arm out of the camera's view, beside the tray
};

// Reads cell.yaml and camera.yaml of a folder. Throws Error naming file, key and remedy.
CellConfig load_cell_config(const std::string& config_dir);
// Key T_base_color {rotation, translation} of a camera.yaml or a calibration result. Throws Error.
Pose load_camera_pose(const std::string& path);

}  // namespace iwgnet_grasp
