#include "camera_transform.h"

#include <iwgnet_grasp/Topics.h>
#include <ros/ros.h>
#include <tf2_eigen/tf2_eigen.h>

namespace iwgnet_grasp::nodes {

Pose camera_transform(const tf2_ros::Buffer& buffer, const std::string& optical_frame) {
  // Not Buffer's own time-out: it runs on ROS time, which may stand still. The camera is fixed, so
  // the newest transform is right whatever the image's stamp.
  const ros::WallTime start = ros::WallTime::now();
  while (true) {
    try {
      return tf2::transformToEigen(
          buffer.lookupTransform(Topics::BASE_FRAME, optical_frame, ros::Time(0)));
    } catch (const tf2::TransformException& error) {
      if (!ros::ok() || ros::WallTime::now() - start > ros::WallDuration(5.0))
        throw Error("tf knows no way from '" + optical_frame + "' to '" + Topics::BASE_FRAME +
                    "' (" + error.what() + "): is camera_pose running?");
    }
    ros::WallDuration(0.01).sleep();
  }
}

}  // namespace iwgnet_grasp::nodes
