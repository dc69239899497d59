#include "iwgnet_grasp/physics/part.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <filesystem>

#include "iwgnet_grasp/core/yaml.h"

namespace iwgnet_grasp::physics {
namespace fs = std::filesystem;

PartModel load_part(const std::string& part_dir) {
  const YamlFile file(part_dir + "/part.yaml");
  PartModel part;
  part.name = file.get<std::string>("name");
  part.family = file.get<std::string>("family");
  part.mass = file.get<double>("mass");
  if (!(part.mass > 0)) file.fail("mass", "must be above 0 kg");
  const Eigen::VectorXd values = file.vector("inertia", 9);
  part.inertia = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(values.data());
  if (!part.inertia.isApprox(part.inertia.transpose(), 1e-6))
    file.fail("inertia", "must be symmetric");
  const Eigen::Vector3d moments =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(part.inertia).eigenvalues();
  const double slack = 1e-6 * moments[2];
  if (!(moments[0] > 0) || moments[0] + moments[1] < moments[2] - slack)
    file.fail("inertia", "belongs to no solid body (kg m^2 about the centre of mass)");
  part.mesh = load_stl(part_dir + "/" + file.get<std::string>("mesh"));
  for (const auto& piece : file.get<std::vector<std::string>>("pieces"))
    part.pieces.push_back(load_stl(part_dir + "/" + piece));
  if (part.pieces.empty()) file.fail("pieces", "needs at least one convex piece");
  return part;
}

std::vector<PartModel> load_parts(const std::string& library_dir,
                                  const std::vector<std::string>& families) {
  std::vector<std::string> dirs;
  std::error_code error;
  for (const auto& entry : fs::directory_iterator(library_dir, error))
    if (fs::exists(entry.path() / "part.yaml")) dirs.push_back(entry.path().string());
  if (dirs.empty())
    throw Error(library_dir + ": holds no parts; run scripts/setup to make them");
  std::vector<PartModel> parts;
  for (const auto& dir : dirs) {
    // The family is read first: a part that is not asked for need not be loaded.
    const auto family = YamlFile(dir + "/part.yaml").get<std::string>("family");
    if (families.empty() || std::find(families.begin(), families.end(), family) != families.end())
      parts.push_back(load_part(dir));
  }
  if (parts.empty()) {
    std::string wanted;
    for (const auto& family : families) wanted += (wanted.empty() ? "" : ", ") + family;
    throw Error(library_dir + ": holds no part of the families asked for (" + wanted + ")");
  }
  std::sort(parts.begin(), parts.end(),
            [](const PartModel& a, const PartModel& b) { return a.name < b.name; });
  return parts;
}

}  // namespace iwgnet_grasp::physics
