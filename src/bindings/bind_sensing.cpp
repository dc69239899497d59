#include "iwgnet_grasp/sensing/pinhole.h"
#include "iwgnet_grasp/sensing/stereo_depth.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;

void bind_sensing(py::module_& m) {
  py::class_<sensing::Material>(m, "Material",
                                "Surface: linear RGB albedo, metallic, roughness and texture in "
                                "[0, 1].")
      .def(py::init([](const Eigen::Vector3f& albedo, float metallic, float roughness,
                       float texture) {
             return sensing::Material{albedo, metallic, roughness, texture};
           }),
           "albedo"_a, "metallic"_a = 0.0f, "roughness"_a = 0.5f, "texture"_a = 0.0f);
  py::class_<sensing::Light>(m, "Light",
                             "Lamp: position (3,) m in base_link, intensity (3,) linear RGB, "
                             "ambient share of light without shadow.")
      .def(py::init([](const Eigen::Vector3f& position, const Eigen::Vector3f& intensity,
                       float ambient) { return sensing::Light{position, intensity, ambient}; }),
           "position"_a, "intensity"_a, "ambient"_a = 0.35f);

  m.def("depth_from_disparity", &sensing::depth_from_disparity, "disparity_px"_a, "fx_px"_a,
        "baseline_m"_a, "Eq. 4: Z = f b / (x1 - x2), m.");
  m.def(
      "stereo_depth",
      [](const FloatImage& left, const FloatImage& right, const CameraConfig& camera,
         std::uint64_t seed) {
        const cv::Mat l = to_mat(left, "ideal_left"), r = to_mat(right, "ideal_right");
        cv::Mat depth;
        {
          py::gil_scoped_release release;
          depth = sensing::stereo_depth(l, r, camera, seed);
        }
        return to_numpy<float>(depth);
      },
      "ideal_left"_a, "ideal_right"_a, "camera"_a, "seed"_a,
      "What the D455 measures, (H, W) float32 m with NaN, from the noise-free depths of its two "
      "imagers, (H, W) float32 m.");
  m.def(
      "align_depth",
      [](const FloatImage& depth, const PinholeIntrinsics& from, const PinholeIntrinsics& to,
         const Eigen::Matrix4d& T_to_from) {
        return to_numpy<float>(sensing::align_depth(to_mat(depth, "depth"), from, to,
                                                    to_pose(T_to_from, "T_to_from")));
      },
      "depth"_a, "from_camera"_a, "to_camera"_a, "T_to_from"_a,
      "Depth (H, W) float32 m of one camera as another sees it; NaN where nothing falls.");
  m.def(
      "deproject",
      [](const PinholeIntrinsics& k, double u, double v, double z) {
        return sensing::deproject(k, u, v, z);
      },
      "camera"_a, "u_px"_a, "v_px"_a, "z"_a, "Point (3,) m in the optical frame.");
  m.def(
      "project",
      [](const PinholeIntrinsics& k, const Eigen::Vector3d& p) { return sensing::project(k, p); },
      "camera"_a, "point"_a, "Pixel (2,) of a point (3,) m in the optical frame, z > 0.");
}

}  // namespace iwgnet_grasp::bindings
