// Node 1: takes one synchronised look (colour, aligned depth, camera info) when asked, and
// publishes it with the empty scene's depth. Listens to the camera only while a look is pending.
#include <cv_bridge/cv_bridge.h>
#include <iwgnet_grasp/Capture.h>
#include <iwgnet_grasp/Scene.h>
#include <iwgnet_grasp/Topics.h>
#include <message_filters/subscriber.h>
#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/synchronizer.h>
#include <sensor_msgs/image_encodings.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include "conversions.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

using sensor_msgs::CameraInfo;
using sensor_msgs::Image;
namespace encodings = sensor_msgs::image_encodings;

struct Frame {
  Image::ConstPtr color, depth;
  CameraInfo::ConstPtr info;
};

// One subscription to the three topics, for as long as it lives.
class FrameListener {
 public:
  explicit FrameListener(ros::NodeHandle& node)
      : color_(node, Topics::COLOR_IMAGE, 3, ros::TransportHints().tcpNoDelay()),
        depth_(node, Topics::ALIGNED_DEPTH_IMAGE, 3, ros::TransportHints().tcpNoDelay()),
        info_(node, Topics::COLOR_INFO, 10, ros::TransportHints().tcpNoDelay()),
        synchronizer_(Policy(10), color_, depth_, info_) {
    color_.registerCallback([this](const Image::ConstPtr&) { ++received_[0]; });
    depth_.registerCallback([this](const Image::ConstPtr&) { ++received_[1]; });
    info_.registerCallback([this](const CameraInfo::ConstPtr&) { ++received_[2]; });
    synchronizer_.setMaxIntervalDuration(ros::Duration(0.05));
    synchronizer_.registerCallback(&FrameListener::on_frame, this);
  }
  ~FrameListener() {  // no callback may run into a dying object
    color_.unsubscribe();
    depth_.unsubscribe();
    info_.unsubscribe();
  }

  // The first frame stamped at or after `not_before`. Throws Error that names what is missing.
  Frame wait(const ros::Time& not_before, double wall_seconds) {
    std::unique_lock lock(mutex_);
    const auto fresh = [&] {
      return !ros::ok() || (frame_.depth && frame_.depth->header.stamp >= not_before);
    };
    const bool got =
        changed_.wait_for(lock, std::chrono::duration<double>(wall_seconds), fresh) && ros::ok();
    if (got) return frame_;
    const std::string within = " within " + std::to_string(static_cast<int>(wall_seconds)) +
                               " s: is the camera's driver running";
    if (received_[0] == 0) throw Error("no colour image on " + Topics::COLOR_IMAGE + within + "?");
    if (received_[1] == 0)
      throw Error("no depth image on " + Topics::ALIGNED_DEPTH_IMAGE + within +
                  " with align_depth:=true?");
    if (received_[2] == 0) throw Error("no camera info on " + Topics::COLOR_INFO + within + "?");
    throw Error(frame_.depth ? "the camera's images are older than the request: do its clock and "
                               "this machine's agree?"
                             : "colour, depth and camera info arrive, but never within 50 ms of one "
                               "another: do their stamps come from one clock?");
  }

 private:
  using Policy = message_filters::sync_policies::ApproximateTime<Image, Image, CameraInfo>;

  void on_frame(const Image::ConstPtr& color, const Image::ConstPtr& depth,
                const CameraInfo::ConstPtr& info) {
    const std::lock_guard lock(mutex_);
    frame_ = {color, depth, info};
    changed_.notify_all();
  }

  std::mutex mutex_;
  std::condition_variable changed_;
  Frame frame_;
  std::atomic<int> received_[3] = {0, 0, 0};
  message_filters::Subscriber<Image> color_, depth_;
  message_filters::Subscriber<CameraInfo> info_;
  message_filters::Synchronizer<Policy> synchronizer_;
};

// A checked frame: rgb8, metres, no lens distortion.
struct Look {
  std_msgs::Header header;
  CameraInfo info;
  cv::Mat color;  // CV_8UC3 RGB
  cv::Mat depth;  // CV_32FC1 m, NaN invalid
};

std::string size_text(unsigned width, unsigned height) {
  return std::to_string(width) + "x" + std::to_string(height);
}

void undistort(const CameraInfo& info, Look& look) {
  const cv::Mat K(3, 3, CV_64F, const_cast<double*>(info.K.data()));
  const cv::Mat D(1, static_cast<int>(info.D.size()), CV_64F, const_cast<double*>(info.D.data()));
  cv::Mat map_x, map_y, color, depth;
  cv::initUndistortRectifyMap(K, D, cv::noArray(), K, look.color.size(), CV_32FC1, map_x, map_y);
  cv::remap(look.color, color, map_x, map_y, cv::INTER_LINEAR);
  cv::remap(look.depth, depth, map_x, map_y, cv::INTER_NEAREST, cv::BORDER_CONSTANT,
            std::numeric_limits<float>::quiet_NaN());
  look.color = color;
  look.depth = depth;
}

// Throws Error.
Look checked(const Frame& frame) {
  const Image& color = *frame.color;
  if (color.encoding != encodings::RGB8 && color.encoding != encodings::BGR8)
    throw Error(Topics::COLOR_IMAGE + ": encoding '" + color.encoding + "', expected rgb8");
  if (color.width == 0 || color.height == 0 || color.step < color.width * 3 ||
      color.data.size() != static_cast<std::size_t>(color.step) * color.height)
    throw Error(Topics::COLOR_IMAGE + ": an image of " + size_text(color.width, color.height) +
                " px cannot have " + std::to_string(color.data.size()) + " bytes");
  Look look;
  look.depth = depth_image(*frame.depth, Topics::ALIGNED_DEPTH_IMAGE);
  const std::string size = size_text(color.width, color.height);
  if (size_text(look.depth.cols, look.depth.rows) != size)
    throw Error(Topics::ALIGNED_DEPTH_IMAGE + ": " + size_text(look.depth.cols, look.depth.rows) +
                " px, but colour has " + size + " px: depth must be aligned to colour");
  if (size_text(frame.info->width, frame.info->height) != size)
    throw Error(Topics::COLOR_INFO + ": " + size_text(frame.info->width, frame.info->height) +
                " px, but colour has " + size + " px");
  from_message(*frame.info);  // throws when it is not calibrated
  if (cv::countNonZero(look.depth == look.depth) == 0)  // NaN differs from itself
    throw Error(Topics::ALIGNED_DEPTH_IMAGE + ": no pixel holds a valid depth: is the view blocked?");

  look.color = cv_bridge::toCvCopy(color, encodings::RGB8)->image;
  look.header = frame.depth->header;
  look.header.frame_id = color.header.frame_id;
  look.info = *frame.info;
  const auto& D = look.info.D;
  if (std::any_of(D.begin(), D.end(), [](double d) { return d != 0.0; })) {
    undistort(*frame.info, look);
    std::fill(look.info.D.begin(), look.info.D.end(), 0.0);
  }
  return look;
}

class VisualAcquisition {
 public:
  VisualAcquisition() {
    timeout_ = ros::param::param("~timeout", 10.0);
    scene_ = node_.advertise<Scene>(Topics::SCENE, 1, true);
    service_ = node_.advertiseService(Topics::CAPTURE, &VisualAcquisition::capture, this);
  }

 private:
  bool capture(Capture::Request& request, Capture::Response& response) {
    const std::lock_guard lock(mutex_);  // one look at a time
    try {
      const ros::Time now = ros::Time::now();
      Frame frame;
      {
        FrameListener listener(node_);
        frame = listener.wait(now, timeout_);
      }
      Look look = checked(frame);
      if (request.empty_scene)
        keep_empty(look);
      else
        publish(look);
      response.success = true;
      response.scene_id = scene_id_;
    } catch (const Error& error) {
      response.message = error.what();
      ROS_ERROR("visual_acquisition: %s", error.what());
    }
    return true;
  }

  void keep_empty(const Look& look) {
    empty_depth_ = look.depth;
    ROS_INFO("visual_acquisition: empty scene kept, %.1f %% of its depth valid",
             100.0 * cv::countNonZero(look.depth == look.depth) / look.depth.total());
  }

  void publish(const Look& look) {
    if (empty_depth_.empty())
      throw Error("no empty scene to compare with: clear the table and call " + Topics::CAPTURE +
                  " with empty_scene: true first");
    if (empty_depth_.size() != look.depth.size())
      throw Error("the empty scene has " + size_text(empty_depth_.cols, empty_depth_.rows) +
                  " px, this look " + size_text(look.depth.cols, look.depth.rows) +
                  ": take the empty scene again");
    Scene scene;
    scene.header = look.header;
    scene.scene_id = ++scene_id_;
    scene.camera_info = look.info;
    scene.camera_info.header = look.header;
    cv_bridge::CvImage(look.header, encodings::RGB8, look.color).toImageMsg(scene.color);
    cv_bridge::CvImage(look.header, encodings::TYPE_32FC1, look.depth).toImageMsg(scene.depth);
    cv_bridge::CvImage(look.header, encodings::TYPE_32FC1, empty_depth_)
        .toImageMsg(scene.empty_depth);
    scene_.publish(scene);
    ROS_INFO("visual_acquisition: scene %u", scene_id_);
  }

  ros::NodeHandle node_;
  double timeout_;  // wall s for a frame
  std::mutex mutex_;
  cv::Mat empty_depth_;
  std::uint32_t scene_id_ = 0;
  ros::Publisher scene_;
  ros::ServiceServer service_;
};

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "visual_acquisition", [] {
    iwgnet_grasp::nodes::VisualAcquisition node;
    ros::AsyncSpinner spinner(3);  // the service waits while images come in
    spinner.start();
    ros::waitForShutdown();
  });
}
