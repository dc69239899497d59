// Images of the cell: ray-traced colour with light, shadow and materials (Embree); ideal depth and
// instances by a z-buffer.
#pragma once

#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/core/mesh.h"

namespace iwgnet_grasp::sensing {

struct Material {
  Eigen::Vector3f albedo{0.5f, 0.5f, 0.5f};
  float metallic = 0.0f;   // 0 dielectric .. 1 metal
  float roughness = 0.5f;  // 0 mirror .. 1 matt
  float texture = 0.0f;    // strength of a procedural grain in object coordinates, 0 none
};

struct Light {
  Eigen::Vector3f position{0.3f, -0.6f, 1.6f};  // m, base_link
  Eigen::Vector3f intensity{1.0f, 1.0f, 1.0f};  // linear RGB
  float ambient = 0.35f;                        // share of light that casts no shadow
  float radius = 0.10f;                         // m, of the lamp; 0 gives hard shadows
};

// A colour image after another of the same camera and light is traced anew only where an object that
// has changed, or has moved by more than 0.3 mm, is or was seen, or shades or shaded what is seen.
class Renderer {
 public:
  Renderer();
  ~Renderer();

  // A mesh is built once; instances place it. Handles are stable until clear_instances().
  int add_mesh(const TriangleMesh& mesh);
  int add_box(const Eigen::Vector3d& size);  // centred at its origin
  // A printed sheet: size (m) about the origin of its xy plane, seen from +z. print: CV_8UC1,
  // albedo in 1/255, first row at +y. A pixel sees the mean of what it covers.
  int add_sheet(const Eigen::Vector2d& size, const cv::Mat& print);
  int add_instance(int mesh, const Material& material, const Pose& T_base_instance);
  void set_pose(int instance, const Pose& T_base_instance);
  void set_material(int instance, const Material& material);
  void set_visible(int instance, bool visible);
  void clear_instances();  // keeps the meshes
  // From now on depth() and instances() draw only the pixels of the upright rectangle around the
  // image of this box (m, base_link); elsewhere nothing is seen. An empty box: all pixels.
  void set_region(const Eigen::AlignedBox3d& box);

  // CV_32FC1, m along the optical axis, NaN where no surface is seen. T_base_camera: optical -> base.
  // instances, where given, becomes what instances() returns.
  cv::Mat depth(const PinholeIntrinsics& camera, const Pose& T_base_camera,
                cv::Mat* instances = nullptr);
  // CV_32SC1: handle of the instance that each pixel sees, -1 for none.
  cv::Mat instances(const PinholeIntrinsics& camera, const Pose& T_base_camera);
  // CV_8UC3 RGB; noise_sigma: sensor noise in 8-bit steps, drawn from `seed`.
  cv::Mat color(const PinholeIntrinsics& camera, const Pose& T_base_camera, const Light& light,
                double noise_sigma, std::uint64_t seed);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace iwgnet_grasp::sensing
