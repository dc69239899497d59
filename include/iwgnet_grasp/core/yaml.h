// YAML with errors a person can act on: "FILE: key 'tray.columns': expected an integer".
#pragma once

#include <yaml-cpp/yaml.h>

#include <string>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp {

class YamlFile {
 public:
  // Throws Error when the file is missing or malformed (with its line).
  explicit YamlFile(std::string path);

  // The value at a dotted key, e.g. get<double>("tray.wall_height"). Throws Error.
  template <typename T>
  T get(const std::string& key) const {
    try {
      return node(key).as<T>();
    } catch (const YAML::BadConversion&) {
      fail(key, "has a value of the wrong type");
    }
  }
  bool has(const std::string& key) const;
  YAML::Node node(const std::string& key) const;  // Throws Error when absent.
  Eigen::VectorXd vector(const std::string& key, int size) const;
  Pose pose(const std::string& key) const;  // {rotation: 3 rows of 3, translation: 3}
  [[noreturn]] void fail(const std::string& key, const std::string& what) const;
  const YAML::Node& root() const { return root_; }

 private:
  std::string path_;
  YAML::Node root_;
};

}  // namespace iwgnet_grasp
