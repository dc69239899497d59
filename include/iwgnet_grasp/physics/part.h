// Parts as the library on disk describes them: assets/parts/NAME/{part.yaml,mesh.stl,piece_*.stl}.
#pragma once

#include <string>
#include <vector>

#include "iwgnet_grasp/core/mesh.h"
#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::physics {

struct PartModel {
  std::string name, family;
  double mass;                          // kg
  Eigen::Matrix3d inertia;              // kg m^2 about the centre of mass, mesh axes
  TriangleMesh mesh;                    // origin at the centre of mass; x along the longest axis,
                                        // z along the shortest
  std::vector<TriangleMesh> pieces;     // convex, same frame
};

PartModel load_part(const std::string& part_dir);  // Throws Error.
// All parts of a library whose family is in `families` (all when empty), ordered by name.
std::vector<PartModel> load_parts(const std::string& library_dir,
                                  const std::vector<std::string>& families = {});

}  // namespace iwgnet_grasp::physics
