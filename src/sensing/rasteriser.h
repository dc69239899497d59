// Which surface each pixel of a pinhole camera sees first, by a z-buffer. Private to the renderer.
#pragma once

#include <Eigen/Geometry>
#include <opencv2/core.hpp>
#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/core/mesh.h"

namespace iwgnet_grasp::sensing {

class Rasteriser {
 public:
  // Writes the pixels of `region` (px, within the image). depth: CV_32FC1, m along the optical axis,
  // NaN where nothing is seen. ids: CV_32SC1, of the draw() that is seen, -1 for none.
  Rasteriser(const PinholeIntrinsics& camera, const Pose& T_base_camera, const cv::Rect& region,
             const cv::Mat& depth, const cv::Mat& ids);

  // Both sides of the triangles. box: around the mesh. Of equally near surfaces the first is seen.
  void draw(const TriangleMesh& mesh, const Eigen::AlignedBox3d& box,
            const Pose& T_base_mesh, int id);
  void finish();  // when all is drawn

 private:
  // homogeneous: (u z, v z, z), z in m; u, v: px, its image where z > 0.
  struct Vertex {
    Eigen::Vector3d homogeneous;
    double u, v;
  };
  void draw(const Vertex& a, const Vertex& b, const Vertex& c, int id);

  Eigen::Affine3d to_pixels_;  // base_link -> homogeneous pixel
  cv::Rect region_;
  cv::Mat depth_, ids_;  // depth: until finish() its inverse, 1/m, 0 for nothing
  std::vector<Vertex> vertices_;
};

}  // namespace iwgnet_grasp::sensing
