#include <pybind11/stl.h>

#include "iwgnet_grasp/core/cell_config.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;

void bind_cell_config(py::module_& m) {
  py::class_<PinholeIntrinsics>(m, "PinholeIntrinsics",
                                "Pinhole model, px; the top left pixel's centre is (0, 0).")
      .def(py::init([](int width, int height, double fx, double fy, double cx, double cy) {
             return PinholeIntrinsics{width, height, fx, fy, cx, cy};
           }),
           "width"_a, "height"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a)
      .def_readwrite("width", &PinholeIntrinsics::width)
      .def_readwrite("height", &PinholeIntrinsics::height)
      .def_readwrite("fx", &PinholeIntrinsics::fx)
      .def_readwrite("fy", &PinholeIntrinsics::fy)
      .def_readwrite("cx", &PinholeIntrinsics::cx)
      .def_readwrite("cy", &PinholeIntrinsics::cy)
      .def("__copy__", [](const PinholeIntrinsics& k) { return k; });

  py::class_<CameraConfig>(m, "CameraConfig",
                           "config/camera.yaml. Attributes give copies: assign to change.")
      .def("__copy__", [](const CameraConfig& c) { return c; })
      .def_property(
          "color", [](const CameraConfig& c) { return c.color; },
          [](CameraConfig& c, const PinholeIntrinsics& k) { c.color = k; },
          "Intrinsics of the colour image and of the depth aligned to it.")
      .def_property(
          "depth", [](const CameraConfig& c) { return c.depth; },
          [](CameraConfig& c, const PinholeIntrinsics& k) { c.depth = k; },
          "Intrinsics of the left infrared imager.")
      .def_readwrite("baseline", &CameraConfig::baseline, "m")
      .def_property(
          "T_base_color", [](const CameraConfig& c) { return to_matrix(c.T_base_color); },
          [](CameraConfig& c, const Eigen::Matrix4d& T) {
            c.T_base_color = to_pose(T, "T_base_color");
          },
          "(4, 4) colour optical frame in base_link.")
      .def_property_readonly(
          "T_depth_color", [](const CameraConfig& c) { return to_matrix(c.T_depth_color); })
      .def_readwrite("subpixel_sigma_px", &CameraConfig::subpixel_sigma_px)
      .def_readwrite("disparity_step_px", &CameraConfig::disparity_step_px)
      .def_readwrite("lateral_sigma_px", &CameraConfig::lateral_sigma_px)
      .def_readwrite("outlier_fraction", &CameraConfig::outlier_fraction);

  py::class_<CellConfig>(m, "CellConfig", "config/cell.yaml and config/camera.yaml.")
      .def_property_readonly("camera", [](const CellConfig& c) { return c.camera; })
      .def_readonly("workspace_min", &CellConfig::workspace_min, "(2,) m, base_link")
      .def_readonly("workspace_max", &CellConfig::workspace_max, "(2,) m, base_link")
      .def_readonly("observe_joints", &CellConfig::observe_joints, "(6,) rad")
      .def_property_readonly(
          "tray_slots", [](const CellConfig& c) { return c.tray.slots(); },
          "Slot centres on the tray's floor in filling order, (3,) m each, base_link.");
  m.def("load_cell_config", &load_cell_config, "config_dir"_a,
        "Reads cell.yaml and camera.yaml of a folder.");
  m.def(
      "load_camera_pose", [](const std::string& path) { return to_matrix(load_camera_pose(path)); },
      "path"_a, "(4, 4) T_base_color of a camera.yaml or of a calibration's result.");
}

}  // namespace iwgnet_grasp::bindings
