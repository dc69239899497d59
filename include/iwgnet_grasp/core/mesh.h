// Triangle meshes on disk.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <string>
#include <vector>

namespace iwgnet_grasp {

struct TriangleMesh {
  std::vector<Eigen::Vector3f> vertices;             // m
  std::vector<std::array<std::uint32_t, 3>> triangles;  // counter-clockwise seen from outside
};

// Reads a binary or ASCII STL file; equal vertices are merged. Throws Error.
TriangleMesh load_stl(const std::string& path);

}  // namespace iwgnet_grasp
