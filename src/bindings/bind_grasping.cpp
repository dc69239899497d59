#include <pybind11/stl.h>

#include "iwgnet_grasp/grasping/grasp_pose.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;
using grasping::GraspPose;
using grasping::GraspPoseConfig;
using grasping::GraspRectangle;
using grasping::HeightMap;

void bind_grasping(py::module_& m) {
  py::class_<HeightMap>(m, "HeightMap", "Heights in m over the table, from a depth image.")
      .def(py::init<>(), "Empty: everything at 0.")
      .def(py::init([](const FloatImage& depth, const PinholeIntrinsics& camera,
                       const Eigen::Matrix4d& T_base_camera, const CellConfig& cell,
                       double resolution, double border) {
             return HeightMap(to_mat(depth, "depth"), camera,
                              to_pose(T_base_camera, "T_base_camera"), cell, resolution, border);
           }),
           "depth"_a, "camera"_a, "T_base_camera"_a, "cell"_a, "resolution"_a = 0.002,
           "border"_a = 0.11,
           "depth: (H, W) float32 m of `camera`; resolution and border of the grid in m.")
      .def("at", &HeightMap::at, "x"_a, "y"_a, "Height in m at (x, y) m in base_link.")
      .def("max_in", &HeightMap::max_in, "center"_a, "yaw"_a, "half"_a,
           "Highest value within an oriented rectangle: centre (2,) m, yaw rad, half extents (2,) m.")
      .def_property_readonly(
          "grid", [](const HeightMap& h) { return to_numpy<float>(h.grid()); },
          "(rows = y, columns = x) float32 m")
      .def_property_readonly("origin", &HeightMap::origin, "(2,) m of cell (0, 0)")
      .def_property_readonly("resolution", &HeightMap::resolution, "m");

  py::class_<GraspRectangle>(m, "GraspRectangle", "A grasp in the image; see GraspRectangle.msg.")
      .def(py::init([](double x_px, double y_px, double theta_rad, double width_px, double quality,
                       double depth_m) {
             return GraspRectangle{x_px, y_px, theta_rad, width_px, quality, depth_m};
           }),
           "x_px"_a, "y_px"_a, "theta_rad"_a, "width_px"_a, "quality"_a, "depth_m"_a)
      .def_readonly("x_px", &GraspRectangle::x_px)
      .def_readonly("y_px", &GraspRectangle::y_px)
      .def_readonly("theta_rad", &GraspRectangle::theta_rad)
      .def_readonly("width_px", &GraspRectangle::width_px)
      .def_readonly("quality", &GraspRectangle::quality)
      .def_readonly("depth_m", &GraspRectangle::depth_m);

  py::class_<GraspPose>(m, "GraspPose", "A grasp in space; x closes, z approaches.")
      .def(py::init<>())
      .def_property(
          "T_base_tcp", [](const GraspPose& g) { return to_matrix(g.T_base_tcp); },
          [](GraspPose& g, const Eigen::Matrix4d& T) { g.T_base_tcp = to_pose(T, "T_base_tcp"); },
          "(4, 4)")
      .def_readwrite("width", &GraspPose::width, "m, expected gap on the object (Eq. 5)")
      .def_readwrite("opening", &GraspPose::opening, "m, gap to approach with")
      .def_readwrite("quality", &GraspPose::quality)
      .def_readonly("engagement", &GraspPose::engagement, "m, overlap of finger and object")
      .def_readonly("contact", &GraspPose::contact, "m, least gap at which both fingers stand free")
      .def_readonly("candidate", &GraspPose::candidate, "which of best_grasp_pose()'s grasps it is")
      .def_readwrite("feasible", &GraspPose::feasible)
      .def_readwrite("reason", &GraspPose::reason, "one line, when not feasible");

  py::class_<GraspPoseConfig>(m, "GraspPoseConfig", "config/grasping.yaml; lengths in m.")
      .def_readwrite("opening_margin", &GraspPoseConfig::opening_margin)
      .def_readwrite("max_opening", &GraspPoseConfig::max_opening)
      .def_readwrite("insertion_depth", &GraspPoseConfig::insertion_depth)
      .def_readwrite("min_engagement", &GraspPoseConfig::min_engagement)
      .def_readwrite("floor_clearance", &GraspPoseConfig::floor_clearance)
      .def_readwrite("finger_thickness", &GraspPoseConfig::finger_thickness);
  m.def("load_grasp_pose_config", &grasping::load_grasp_pose_config, "config_dir"_a);

  m.def("width_in_metres", &grasping::width_in_metres, "width_px"_a, "depth_m"_a, "fx_px"_a,
        "Eq. 5: gripper opening in m of a width in px at a depth.");
  m.def(
      "grasp_pose",
      [](const GraspRectangle& grasp, const PinholeIntrinsics& camera,
         const Eigen::Matrix4d& T_base_camera, const HeightMap& heights, const CellConfig& cell,
         const GraspPoseConfig& config) {
        return grasping::grasp_pose(grasp, camera, to_pose(T_base_camera, "T_base_camera"), heights,
                                    cell, config);
      },
      "grasp"_a, "camera"_a, "T_base_camera"_a, "heights"_a, "cell"_a, "config"_a,
      "Pixel -> camera -> base -> pose (section 2.2, Eq. 5), leaning with the object. Not "
      "feasible: GraspPose.reason.");
  m.def(
      "best_grasp_pose",
      [](const std::vector<GraspRectangle>& grasps, const PinholeIntrinsics& camera,
         const Eigen::Matrix4d& T_base_camera, const HeightMap& heights, const CellConfig& cell,
         const GraspPoseConfig& config, const std::optional<Eigen::Vector3d>& centroid) {
        return grasping::best_grasp_pose(grasps, camera, to_pose(T_base_camera, "T_base_camera"),
                                         heights, cell, config, centroid);
      },
      "grasps"_a, "camera"_a, "T_base_camera"_a, "heights"_a, "cell"_a, "config"_a,
      "centroid"_a = py::none(),
      "The best feasible pose at and beside the candidates; else the first with its reason.");
}

}  // namespace iwgnet_grasp::bindings
