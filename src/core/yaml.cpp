#include "iwgnet_grasp/core/yaml.h"

#include <sstream>

namespace iwgnet_grasp {

YamlFile::YamlFile(std::string path) : path_(std::move(path)) {
  try {
    root_ = YAML::LoadFile(path_);
  } catch (const YAML::BadFile&) {
    throw Error(path_ + ": cannot be read; check the path and its permissions");
  } catch (const YAML::Exception& error) {
    std::ostringstream text;
    text << path_ << ":" << error.mark.line + 1 << ": not valid YAML (" << error.msg << ")";
    throw Error(text.str());
  }
  if (!root_.IsMap()) throw Error(path_ + ": expected 'key: value' lines at the top level");
}

bool YamlFile::has(const std::string& key) const {
  try {
    node(key);
    return true;
  } catch (const Error&) {
    return false;
  }
}

YAML::Node YamlFile::node(const std::string& key) const {
  YAML::Node current = YAML::Clone(root_);
  std::istringstream parts(key);
  for (std::string part; std::getline(parts, part, '.');) {
    if (!current.IsMap() || !current[part]) fail(key, "is missing");
    current.reset(current[part]);
  }
  return current;
}

Eigen::VectorXd YamlFile::vector(const std::string& key, int size) const {
  const auto values = get<std::vector<double>>(key);
  if (static_cast<int>(values.size()) != size)
    fail(key, "needs " + std::to_string(size) + " numbers, has " + std::to_string(values.size()));
  return Eigen::Map<const Eigen::VectorXd>(values.data(), size);
}

Pose YamlFile::pose(const std::string& key) const {
  const auto rows = get<std::vector<std::vector<double>>>(key + ".rotation");
  Eigen::Matrix3d rotation;
  if (rows.size() != 3) fail(key + ".rotation", "needs 3 rows of 3 numbers");
  for (int r = 0; r < 3; ++r) {
    if (rows[r].size() != 3) fail(key + ".rotation", "needs 3 rows of 3 numbers");
    for (int c = 0; c < 3; ++c) rotation(r, c) = rows[r][c];
  }
  const bool orthonormal = (rotation * rotation.transpose()).isIdentity(1e-3);
  if (!orthonormal || rotation.determinant() < 0)
    fail(key + ".rotation", "is not a rotation matrix");
  Pose T = Pose::Identity();
  // Rounded digits in the file must not leak into the frames.
  T.linear() = Eigen::Quaterniond(rotation).normalized().toRotationMatrix();
  T.translation() = vector(key + ".translation", 3);
  return T;
}

void YamlFile::fail(const std::string& key, const std::string& what) const {
  throw Error(path_ + ": key '" + key + "' " + what);
}

}  // namespace iwgnet_grasp
