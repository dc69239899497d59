#include "node_setup.h"

#include <ros/package.h>

#include <cstdio>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::nodes {

std::string package_dir() {
  std::string dir = ros::param::param<std::string>("~package_dir", "");
  if (dir.empty()) dir = ros::package::getPath("iwgnet_grasp");
  if (dir.empty())
    throw Error("package iwgnet_grasp is not on ROS_PACKAGE_PATH: source scripts/env.sh first");
  return dir;
}

std::string config_dir() {
  const std::string dir = ros::param::param<std::string>("~config_dir", "");
  return dir.empty() ? package_dir() + "/config" : dir;
}

int run_node(int argc, char** argv, const std::string& name, const std::function<void()>& body) {
  try {
    ros::init(argc, argv, name);
    if (!ros::master::check())
      throw Error("no ROS master at " + ros::master::getURI() + ": start roscore, or roslaunch the "
                  "node");
    body();
    return 0;
  } catch (const std::exception& error) {
    // Not ROS_FATAL: the last node handle may be gone, and rosconsole with it.
    std::fprintf(stderr, "[FATAL] %s: %s\n", ros::this_node::getName().c_str(), error.what());
    return 1;
  }
}

}  // namespace iwgnet_grasp::nodes
