#include "iwgnet_grasp/core/mesh.h"

#include <cmath>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <sstream>
#include <tuple>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp {
namespace {

constexpr std::size_t kHeader = 84, kFacet = 50;  // binary STL, bytes

class Builder {
 public:
  void add(const std::array<Eigen::Vector3f, 3>& corners) {
    std::array<std::uint32_t, 3> triangle;
    for (int i = 0; i < 3; ++i) triangle[i] = index(corners[i]);
    if (triangle[0] != triangle[1] && triangle[1] != triangle[2] && triangle[0] != triangle[2])
      mesh_.triangles.push_back(triangle);
  }
  TriangleMesh take() { return std::move(mesh_); }

 private:
  std::uint32_t index(const Eigen::Vector3f& v) {
    const auto [it, fresh] = indices_.try_emplace(std::make_tuple(v.x(), v.y(), v.z()),
                                                  static_cast<std::uint32_t>(mesh_.vertices.size()));
    if (fresh) mesh_.vertices.push_back(v);
    return it->second;
  }
  TriangleMesh mesh_;
  std::map<std::tuple<float, float, float>, std::uint32_t> indices_;
};

TriangleMesh parse_ascii(const std::string& text) {
  Builder builder;
  std::istringstream words(text);
  std::array<Eigen::Vector3f, 3> corners;
  int corner = 0;
  for (std::string word; words >> word;) {
    if (word != "vertex") continue;
    auto& v = corners[corner];
    if (!(words >> v.x() >> v.y() >> v.z())) break;
    if (++corner == 3) {
      builder.add(corners);
      corner = 0;
    }
  }
  return builder.take();
}

TriangleMesh parse_binary(const std::string& bytes, std::uint32_t facets) {
  Builder builder;
  for (std::uint32_t i = 0; i < facets; ++i) {
    float values[9];
    std::memcpy(values, bytes.data() + kHeader + i * kFacet + 12, sizeof values);  // skip the normal
    builder.add({Eigen::Vector3f(values), Eigen::Vector3f(values + 3), Eigen::Vector3f(values + 6)});
  }
  return builder.take();
}

}  // namespace

TriangleMesh load_stl(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw Error(path + ": cannot be read; run scripts/setup to make the meshes");
  const std::string bytes{std::istreambuf_iterator<char>(file), {}};
  TriangleMesh mesh;
  std::uint32_t facets = 0;
  if (bytes.size() >= kHeader) std::memcpy(&facets, bytes.data() + 80, sizeof facets);
  if (bytes.size() >= kHeader && bytes.size() == kHeader + kFacet * facets)
    mesh = parse_binary(bytes, facets);
  else if (bytes.rfind("solid", 0) == 0)
    mesh = parse_ascii(bytes);
  if (mesh.triangles.empty()) throw Error(path + ": not a complete STL file");
  for (const auto& v : mesh.vertices)
    if (!v.allFinite()) throw Error(path + ": has a vertex that is not a number");
  return mesh;
}

}  // namespace iwgnet_grasp
