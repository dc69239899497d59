// What every roscpp node of the package does first and last.
#pragma once

#include <ros/ros.h>

#include <functional>
#include <string>

namespace iwgnet_grasp::nodes {

// The package's folder: parameter ~package_dir, else what rospack says. Throws Error.
std::string package_dir();
// Parameter ~config_dir, else config/ of the package.
std::string config_dir();

// ros::init, then `body`. An Error, of the core or of ROS, becomes one fatal line and exit status 1.
int run_node(int argc, char** argv, const std::string& name, const std::function<void()>& body);

}  // namespace iwgnet_grasp::nodes
