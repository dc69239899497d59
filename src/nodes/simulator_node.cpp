// The simulated cell behind the interfaces of the real drivers (ur_robot_driver, the Robotiq
// gripper's action, realsense2_camera), with its own services to load a scene, step and judge.
// One thread: between two chunks of physics it serves callbacks, so none of them needs a lock.
#include <actionlib/server/action_server.h>
#include <control_msgs/FollowJointTrajectoryAction.h>
#include <control_msgs/GripperCommandAction.h>
#include <control_msgs/JointTrajectoryControllerState.h>
#include <cv_bridge/cv_bridge.h>
#include <geometry_msgs/PoseStamped.h>
#include <iwgnet_grasp/CalibrationTruth.h>
#include <iwgnet_grasp/Judge.h>
#include <iwgnet_grasp/LoadScene.h>
#include <iwgnet_grasp/Step.h>
#include <iwgnet_grasp/Topics.h>
#include <ros/callback_queue.h>
#include <rosgraph_msgs/Clock.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/image_encodings.h>
#include <sensor_msgs/point_cloud2_iterator.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <visualization_msgs/MarkerArray.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <opencv2/imgcodecs.hpp>
#include <optional>

#include "conversions.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/physics/simulated_cell.h"
#include "iwgnet_grasp/sensing/pinhole.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

using control_msgs::FollowJointTrajectoryAction;
using control_msgs::FollowJointTrajectoryResult;
using control_msgs::GripperCommandAction;
using physics::TrajectoryStatus;
namespace encodings = sensor_msgs::image_encodings;

constexpr double kSubscribingTime = 0.03;  // wall s

struct Settings {
  double speed;           // x real time while the robot works; 0: as fast as the machine allows
  double idle_speed;      // x real time while it waits for the other nodes
  double joint_rate;      // Hz of simulated time
  double gripper_rate;    // Hz
  double state_rate;      // Hz
  double camera_rate;     // Hz, frames while somebody listens
  double camera_wall_rate;  // Hz of wall time: rendering must not slow the physics to a crawl
  int points_step;        // px between two points of the cloud
};

Settings load_settings() {
  const auto get = [](const char* name, double fallback, double least) {
    const double value = ros::param::param(std::string("~") + name, fallback);
    if (!std::isfinite(value) || value < least)
      throw Error("parameter ~" + std::string(name) + " is " + std::to_string(value) +
                  ", expected at least " + std::to_string(least));
    return value;
  };
  Settings s;
  const bool real_time = ros::param::param("~real_time", false);
  s.speed = real_time ? 1.0 : get("max_speed", 20.0, 0.0);
  s.idle_speed = real_time ? 1.0 : get("idle_speed", 1.0, 0.01);
  s.joint_rate = get("joint_state_rate", 125.0, 1.0);
  s.gripper_rate = get("gripper_state_rate", 25.0, 1.0);
  s.state_rate = get("controller_state_rate", 25.0, 1.0);
  s.camera_rate = get("camera_rate", 10.0, 0.1);
  s.camera_wall_rate = get("camera_wall_rate", 5.0, 0.1);
  s.points_step = static_cast<int>(get("points_step", 2, 1));
  return s;
}

// Says once a period of simulated time that something is due.
class Periodic {
 public:
  explicit Periodic(double rate) : period_(1.0 / rate) {}
  bool due(double time) {
    if (time + 1e-9 < next_) return false;
    next_ = std::max(next_ + period_, time);  // no bursts after a pause
    return true;
  }
  void restart() { next_ = 0.0; }

 private:
  double period_, next_ = 0.0;
};

trajectory_msgs::JointTrajectoryPoint to_point(const JointVector& q, const JointVector& qd) {
  trajectory_msgs::JointTrajectoryPoint point;
  point.positions.assign(q.data(), q.data() + kJoints);
  point.velocities.assign(qd.data(), qd.data() + kJoints);
  return point;
}

// Depth in the driver's 16UC1 millimetres, 0 = invalid.
sensor_msgs::ImagePtr millimetres(const cv::Mat& depth, const std_msgs::Header& header) {
  cv::Mat mm(depth.size(), CV_16UC1);
  for (int r = 0; r < depth.rows; ++r) {
    const float* in = depth.ptr<float>(r);
    auto* out = mm.ptr<std::uint16_t>(r);
    for (int c = 0; c < depth.cols; ++c) {
      const float value = in[c] * 1000.0f;  // NaN fails the comparison
      out[c] = value > 0.0f && value < 65535.0f ? static_cast<std::uint16_t>(value + 0.5f) : 0;
    }
  }
  return cv_bridge::CvImage(header, encodings::TYPE_16UC1, mm).toImageMsg();
}

class Simulator {
 public:
  Simulator()
      : settings_(load_settings()),
        cell_(package_dir(), config_dir()),
        joint_states_due_(settings_.joint_rate),
        gripper_state_due_(settings_.gripper_rate),
        controller_state_due_(settings_.state_rate),
        frame_due_(settings_.camera_rate),
        arm_server_(node_, Topics::ARM_ACTION, [this](ArmGoal goal) { on_arm_goal(goal); },
                    [this](ArmGoal goal) { on_arm_cancel(goal); }, false),
        gripper_server_(node_, Topics::GRIPPER_ACTION,
                        [this](GripperGoal goal) { on_gripper_goal(goal); },
                        [this](GripperGoal goal) { on_gripper_cancel(goal); }, false) {
    // The seed of what is mounted by hand is apart from that of the scenes, which change.
    const int camera_seed = ros::param::param("~camera_offset_seed", -1);
    if (camera_seed >= 0) cell_.offset_camera(camera_seed);
    const auto print = ros::param::param<std::string>("~board_print", "");
    if (!print.empty()) {
      const cv::Mat image = cv::imread(print, cv::IMREAD_GRAYSCALE);
      if (image.empty()) throw Error("parameter ~board_print: '" + print + "' is no readable image");
      cell_.hold_board(image, ros::param::param("~seed", 0));
    }
    load(ros::param::param<std::string>("~scene", ""), ros::param::param("~seed", 0));
    clock_ = node_.advertise<rosgraph_msgs::Clock>("/clock", 10);
    publish_clock();  // before anything with a stamp
    joint_states_ = node_.advertise<sensor_msgs::JointState>(Topics::JOINT_STATES, 50);
    state_ = node_.advertise<control_msgs::JointTrajectoryControllerState>(Topics::ARM_STATE, 10);
    color_ = node_.advertise<sensor_msgs::Image>(Topics::COLOR_IMAGE, 2);
    color_info_ = node_.advertise<sensor_msgs::CameraInfo>(Topics::COLOR_INFO, 2);
    depth_ = node_.advertise<sensor_msgs::Image>(Topics::DEPTH_IMAGE, 2);
    depth_info_ = node_.advertise<sensor_msgs::CameraInfo>(Topics::DEPTH_INFO, 2);
    aligned_ = node_.advertise<sensor_msgs::Image>(Topics::ALIGNED_DEPTH_IMAGE, 2);
    aligned_info_ = node_.advertise<sensor_msgs::CameraInfo>(Topics::ALIGNED_DEPTH_INFO, 2);
    points_ = node_.advertise<sensor_msgs::PointCloud2>(Topics::POINTS, 1);
    target_pose_ = node_.advertise<geometry_msgs::PoseStamped>(Topics::TARGET_POSE, 1);
    markers_ = node_.advertise<visualization_msgs::MarkerArray>(Topics::CELL_MARKERS, 1, true);
    command_ = node_.subscribe(Topics::ARM_COMMAND, 5, &Simulator::on_command, this);
    services_ = {node_.advertiseService(Topics::LOAD_SCENE, &Simulator::on_load_scene, this),
                 node_.advertiseService(Topics::RESET, &Simulator::on_reset, this),
                 node_.advertiseService(Topics::STEP, &Simulator::on_step, this),
                 node_.advertiseService(Topics::JUDGE, &Simulator::on_judge, this),
                 node_.advertiseService(Topics::CALIBRATION_TRUTH, &Simulator::on_truth, this)};
    publish_camera_frames();
    publish_cell_markers();
    arm_server_.start();
    gripper_server_.start();
  }

  void run() {
    ros::CallbackQueue& queue = *ros::getGlobalCallbackQueue();
    Pace pace{ros::WallTime::now(), cell_.time(), 0.0};
    while (ros::ok()) {
      queue.callAvailable(ros::WallDuration(0.0));
      if (paused_) {
        publish_clock();
        publish_frames();
        queue.callAvailable(ros::WallDuration(0.01));
        pace.speed = 0.0;  // start anew when it goes on
        continue;
      }
      const bool busy = arm_goal_ || gripper_goal_ || commanded_;
      const double speed = busy ? settings_.speed : settings_.idle_speed;
      if (speed != pace.speed || cell_.time() < pace.start_time)
        pace = {ros::WallTime::now(), cell_.time(), speed};
      advance(4);
      if (speed == 0.0) continue;
      const double ahead = (cell_.time() - pace.start_time) / speed -
                           (ros::WallTime::now() - pace.start_wall).toSec();
      if (ahead > 0.0)
        queue.callAvailable(ros::WallDuration(ahead));  // returns at once when something came in
      else if (ahead < -0.1)
        pace = {ros::WallTime::now(), cell_.time(), speed};  // too slow a machine: no catching up
      sleep_rest(pace);
    }
  }

 private:
  using ArmServer = actionlib::ActionServer<FollowJointTrajectoryAction>;
  using ArmGoal = ArmServer::GoalHandle;
  using GripperServer = actionlib::ActionServer<GripperCommandAction>;
  using GripperGoal = GripperServer::GoalHandle;

  struct Pace {
    ros::WallTime start_wall;
    double start_time, speed;
  };

  void sleep_rest(const Pace& pace) {
    const double ahead = (cell_.time() - pace.start_time) / pace.speed -
                         (ros::WallTime::now() - pace.start_wall).toSec();
    if (ahead > 0.0) ros::WallDuration(std::min(ahead, 0.005)).sleep();
  }

  // The clock never goes back, whatever scene is loaded.
  ros::Time now() const { return ros::Time(clock_offset_ + cell_.time()); }

  std_msgs::Header header(const std::string& frame) const {
    std_msgs::Header header;
    header.stamp = now();
    header.frame_id = frame;
    return header;
  }

  void advance(int steps) {
    for (int i = 0; i < steps; ++i) {
      cell_.step();
      const double time = cell_.time();
      if (joint_states_due_.due(time)) publish_arm_joints();
      if (gripper_state_due_.due(time)) publish_gripper_joint();
      if (controller_state_due_.due(time)) {
        publish_controller_state();
        publish_target_pose();
      }
    }
    publish_clock();
    check_arm();
    check_gripper();
    publish_frames();
  }

  // Every tick of the clock costs each Python node a callback, so ticks are rationed by wall time.
  void publish_clock() {
    const ros::WallTime wall = ros::WallTime::now();
    if (wall - clock_wall_ < ros::WallDuration(0.004)) return;
    clock_wall_ = wall;
    rosgraph_msgs::Clock message;
    message.clock = now();
    clock_.publish(message);
  }

  // --- arm ---------------------------------------------------------------------------------

  void publish_arm_joints() {
    if (joint_states_.getNumSubscribers() == 0) return;
    // ur_robot_driver lists the joints by the alphabet, so nobody may rely on the kinematic order.
    static const std::vector<int> order = [] {
      std::vector<int> indices(kJoints);
      std::iota(indices.begin(), indices.end(), 0);
      std::sort(indices.begin(), indices.end(), [](int a, int b) {
        return std::string(kJointNames[a]) < kJointNames[b];
      });
      return indices;
    }();
    const physics::ArmState arm = cell_.arm();
    sensor_msgs::JointState state;
    state.header = header("");
    for (const int j : order) {
      state.name.emplace_back(kJointNames[j]);
      state.position.push_back(arm.q[j]);
      state.velocity.push_back(arm.qd[j]);
      state.effort.push_back(arm.torque[j]);
    }
    joint_states_.publish(state);
  }

  control_msgs::JointTrajectoryControllerState controller_state() {
    const physics::ArmState arm = cell_.arm();
    const motion::TrajectoryPoint& desired = cell_.arm_controller().desired();
    control_msgs::JointTrajectoryControllerState state;
    state.header = header("");
    state.joint_names.assign(std::begin(kJointNames), std::end(kJointNames));
    state.desired = to_point(desired.q, desired.qd);
    state.actual = to_point(arm.q, arm.qd);
    state.error = to_point(desired.q - arm.q, desired.qd - arm.qd);
    return state;
  }

  void publish_controller_state() {
    if (state_.getNumSubscribers() == 0 && !arm_goal_) return;
    const auto state = controller_state();
    state_.publish(state);
    if (!arm_goal_) return;
    control_msgs::FollowJointTrajectoryFeedback feedback;
    feedback.header = state.header;
    feedback.joint_names = state.joint_names;
    feedback.desired = state.desired;
    feedback.actual = state.actual;
    feedback.error = state.error;
    arm_goal_->publishFeedback(feedback);
  }

  // The pose of the calibration board as a detector would report it, with the noise of
  // config/calibration.yaml.
  void publish_target_pose() {
    if (target_pose_.getNumSubscribers() == 0) return;
    geometry_msgs::PoseStamped pose;
    pose.header = header(Topics::COLOR_FRAME);
    try {
      pose.pose = to_message(cell_.measure_board(target_poses_++));
    } catch (const Error& error) {
      ROS_ERROR_ONCE("simulator: %s: %s", Topics::TARGET_POSE.c_str(), error.what());
      return;
    }
    target_pose_.publish(pose);
  }

  // Tolerances of a goal on top of the driver's: 0 keeps the default, negative lifts the limit.
  static physics::TrajectoryTolerances tolerances_of(
      const control_msgs::FollowJointTrajectoryGoal& goal) {
    physics::TrajectoryTolerances tolerances = physics::default_tolerances();
    const auto apply = [](const std::vector<control_msgs::JointTolerance>& changes,
                          JointVector& limits) {
      for (const auto& change : changes) {
        const auto joint = std::find(std::begin(kJointNames), std::end(kJointNames), change.name);
        if (joint == std::end(kJointNames))
          throw JointsError("a tolerance names the unknown joint '" + change.name + "'");
        if (change.position != 0.0) limits[joint - std::begin(kJointNames)] = change.position;
      }
    };
    apply(goal.path_tolerance, tolerances.path);
    apply(goal.goal_tolerance, tolerances.goal);
    const double goal_time = goal.goal_time_tolerance.toSec();
    if (goal_time > 0.0) tolerances.goal_time = goal_time;
    if (goal_time < 0.0) tolerances.goal_time = std::numeric_limits<double>::infinity();
    return tolerances;
  }

  static FollowJointTrajectoryResult result_of(int code, const std::string& message) {
    FollowJointTrajectoryResult result;
    result.error_code = code;
    result.error_string = message;
    return result;
  }

  void on_arm_goal(ArmGoal goal) {
    try {
      const auto trajectory =
          from_message(goal.getGoal()->trajectory, cell_.arm().q, now());
      const auto tolerances = tolerances_of(*goal.getGoal());
      if (trajectory.empty()) {
        const bool past = !goal.getGoal()->trajectory.points.empty();
        goal.setRejected(
            result_of(past ? FollowJointTrajectoryResult::OLD_HEADER_TIMESTAMP
                           : FollowJointTrajectoryResult::INVALID_GOAL,
                      past ? "the whole trajectory lies in the past" : "the trajectory is empty"),
            "no points");
        return;
      }
      end_arm_goal("a newer goal took over");
      const std::string refused = cell_.start_trajectory(trajectory, tolerances);
      if (!refused.empty()) throw Error(refused);
      goal.setAccepted();
      arm_goal_ = goal;
      commanded_ = false;
    } catch (const JointsError& error) {
      ROS_ERROR("simulator: trajectory refused: %s", error.what());
      goal.setRejected(result_of(FollowJointTrajectoryResult::INVALID_JOINTS, error.what()),
                       error.what());
    } catch (const Error& error) {
      ROS_ERROR("simulator: trajectory refused: %s", error.what());
      goal.setRejected(result_of(FollowJointTrajectoryResult::INVALID_GOAL, error.what()),
                       error.what());
    }
  }

  void on_arm_cancel(ArmGoal goal) {
    if (!arm_goal_ || *arm_goal_ != goal) return;
    end_arm_goal("cancelled");
  }

  // Holds the arm where it is.
  void end_arm_goal(const std::string& why) {
    if (!arm_goal_ && !commanded_) return;
    cell_.arm_controller().cancel(cell_.arm());
    commanded_ = false;
    if (!arm_goal_) return;
    arm_goal_->setCanceled(result_of(FollowJointTrajectoryResult::SUCCESSFUL, why), why);
    arm_goal_.reset();
  }

  // Topic 5 without an action: as with the real controller, an empty trajectory stops the arm.
  void on_command(const trajectory_msgs::JointTrajectory::ConstPtr& message) {
    try {
      end_arm_goal("a trajectory on " + Topics::ARM_COMMAND + " took over");
      if (message->points.empty()) return;
      const auto trajectory = from_message(*message, cell_.arm().q, now());
      if (trajectory.empty()) throw Error("the whole trajectory lies in the past");
      const std::string refused =
          cell_.start_trajectory(trajectory, physics::default_tolerances());
      if (!refused.empty()) throw Error(refused);
      commanded_ = true;
    } catch (const Error& error) {
      ROS_ERROR("simulator: %s: trajectory refused: %s", Topics::ARM_COMMAND.c_str(), error.what());
    }
  }

  void check_arm() {
    const TrajectoryStatus status = cell_.arm_controller().status();
    if (status == TrajectoryStatus::kActive) return;
    commanded_ = false;
    if (!arm_goal_) return;
    const auto result = result_of(static_cast<int>(status), cell_.arm_controller().message());
    if (status == TrajectoryStatus::kSucceeded)
      arm_goal_->setSucceeded(result, "");
    else
      arm_goal_->setAborted(result, result.error_string);
    arm_goal_.reset();
  }

  // --- gripper -----------------------------------------------------------------------------

  void publish_gripper_joint() {
    if (joint_states_.getNumSubscribers() == 0) return;
    const physics::GripperState gripper = cell_.gripper();
    sensor_msgs::JointState state;
    state.header = header("");
    state.name = {"finger_joint"};
    state.position = {gripper.finger_joint};
    joint_states_.publish(state);
    if (!gripper_goal_) return;
    control_msgs::GripperCommandFeedback feedback;
    feedback.position = gripper.gap;
    feedback.effort = gripper.force;
    gripper_goal_->publishFeedback(feedback);
  }

  control_msgs::GripperCommandResult gripper_result() const {
    const physics::GripperState gripper = cell_.gripper();
    const physics::GripperStatus status = cell_.gripper_status();
    control_msgs::GripperCommandResult result;
    result.position = gripper.gap;
    result.effort = gripper.force;
    result.stalled = status.stalled;
    result.reached_goal = status.reached;
    return result;
  }

  // ROS-Industrial's convention: position is the gap between the pads in metres, max_effort newtons.
  void on_gripper_goal(GripperGoal goal) {
    const control_msgs::GripperCommand& command = goal.getGoal()->command;
    if (!std::isfinite(command.position) || !std::isfinite(command.max_effort) ||
        command.max_effort < 0.0) {
      const std::string why = "gripper command needs a finite gap (m) and an effort (N) of 0 or more";
      ROS_ERROR("simulator: %s", why.c_str());
      goal.setRejected(gripper_result(), why);
      return;
    }
    if (gripper_goal_) gripper_goal_->setCanceled(gripper_result(), "a newer goal took over");
    goal.setAccepted();
    gripper_goal_ = goal;
    cell_.command_gripper(std::clamp(command.position, 0.0, kinematics::max_gap()),
                          command.max_effort);
  }

  void on_gripper_cancel(GripperGoal goal) {
    if (!gripper_goal_ || *gripper_goal_ != goal) return;
    const physics::GripperState gripper = cell_.gripper();
    cell_.command_gripper(gripper.gap, gripper.force);  // stays where it is
    gripper_goal_->setCanceled(gripper_result(), "cancelled");
    gripper_goal_.reset();
  }

  void check_gripper() {
    if (!gripper_goal_) return;
    const physics::GripperStatus status = cell_.gripper_status();
    if (!status.reached && !status.stalled) return;
    gripper_goal_->setSucceeded(gripper_result(), status.stalled ? "stalled on an object" : "");
    gripper_goal_.reset();
  }

  // --- camera ------------------------------------------------------------------------------

  void publish_frames() {
    const std::array<const ros::Publisher*, 7> publishers = {
        &color_, &color_info_, &depth_, &depth_info_, &aligned_, &aligned_info_, &points_};
    unsigned listeners = 0;
    for (const ros::Publisher* publisher : publishers) listeners += publisher->getNumSubscribers();
    const ros::WallTime wall = ros::WallTime::now();
    // A newcomer need not wait for the next frame, but for the other topics that it is about to
    // subscribe to: one frame then serves them all.
    if (listeners > listeners_) newcomer_wall_ = wall;
    listeners_ = listeners;
    if (listeners == 0) return;
    if (!newcomer_wall_.isZero()) {
      if ((wall - newcomer_wall_).toSec() < kSubscribingTime) return;
      newcomer_wall_ = ros::WallTime();
    } else {
      if ((wall - frame_wall_).toSec() < 1.0 / settings_.camera_wall_rate) return;
      if (!paused_ && !frame_due_.due(cell_.time())) return;
    }
    frame_wall_ = wall;

    const CameraConfig& camera = cell_.camera();
    const auto wanted = [](const ros::Publisher& publisher) {
      return publisher.getNumSubscribers() > 0;
    };
    const std_msgs::Header color_header = header(Topics::COLOR_FRAME);
    const std_msgs::Header depth_header = header(Topics::DEPTH_FRAME);
    cv::Mat color, depth;
    if (wanted(color_) || wanted(points_)) color = cell_.color();
    if (wanted(depth_) || wanted(aligned_) || wanted(points_)) depth = cell_.depth();
    if (wanted(color_))
      color_.publish(cv_bridge::CvImage(color_header, encodings::RGB8, color).toImageMsg());
    color_info_.publish(to_message(camera.color, color_header));
    if (wanted(depth_)) depth_.publish(millimetres(depth, depth_header));
    depth_info_.publish(to_message(camera.depth, depth_header));
    if (wanted(aligned_)) aligned_.publish(millimetres(cell_.aligned_depth(depth), color_header));
    aligned_info_.publish(to_message(camera.color, color_header));
    if (wanted(points_)) points_.publish(point_cloud(depth, color, depth_header));
  }

  sensor_msgs::PointCloud2 point_cloud(const cv::Mat& depth, const cv::Mat& color,
                                       const std_msgs::Header& cloud_header) const {
    const CameraConfig& camera = cell_.camera();
    const Pose T_color_depth = camera.T_depth_color.inverse();
    std::vector<std::pair<Eigen::Vector3f, cv::Vec3b>> points;
    points.reserve(depth.total() / (settings_.points_step * settings_.points_step));
    for (int v = 0; v < depth.rows; v += settings_.points_step)
      for (int u = 0; u < depth.cols; u += settings_.points_step) {
        const float z = depth.at<float>(v, u);
        if (!std::isfinite(z)) continue;
        const Eigen::Vector3d p = sensing::deproject(camera.depth, u, v, z);
        const Eigen::Vector2d pixel = sensing::project(camera.color, T_color_depth * p);
        const int x = static_cast<int>(std::lround(pixel.x()));
        const int y = static_cast<int>(std::lround(pixel.y()));
        const bool seen = x >= 0 && y >= 0 && x < color.cols && y < color.rows;
        points.emplace_back(p.cast<float>(),
                            seen ? color.at<cv::Vec3b>(y, x) : cv::Vec3b(128, 128, 128));
      }
    sensor_msgs::PointCloud2 cloud;
    cloud.header = cloud_header;
    cloud.is_dense = true;
    sensor_msgs::PointCloud2Modifier modifier(cloud);
    modifier.setPointCloud2FieldsByString(2, "xyz", "rgb");
    modifier.resize(points.size());
    sensor_msgs::PointCloud2Iterator<float> xyz(cloud, "x");
    sensor_msgs::PointCloud2Iterator<std::uint8_t> bgr(cloud, "rgb");
    for (const auto& [p, rgb] : points) {
      xyz[0] = p.x(), xyz[1] = p.y(), xyz[2] = p.z();
      bgr[0] = rgb[2], bgr[1] = rgb[1], bgr[2] = rgb[0];
      ++xyz, ++bgr;
    }
    return cloud;
  }

  // The frames of realsense2_camera below camera_link; camera_pose says where camera_link is.
  void publish_camera_frames() {
    const CameraConfig& camera = cell_.camera();
    Pose T_body_optical = Pose::Identity();  // x forward, y left, z up <- x right, y down, z forward
    T_body_optical.linear() = camera.T_camera_link_depth.linear();
    const Pose T_link_color_optical = camera.T_camera_link_depth * camera.T_depth_color;
    const std::vector<std::tuple<std::string, std::string, Pose>> frames = {
        {Topics::CAMERA_FRAME, "camera_depth_frame",
         camera.T_camera_link_depth * T_body_optical.inverse()},
        {"camera_depth_frame", Topics::DEPTH_FRAME, T_body_optical},
        {Topics::CAMERA_FRAME, "camera_color_frame",
         T_link_color_optical * T_body_optical.inverse()},
        {"camera_color_frame", Topics::COLOR_FRAME, T_body_optical}};
    std::vector<geometry_msgs::TransformStamped> transforms;
    for (const auto& [parent, child, T] : frames) {
      geometry_msgs::TransformStamped transform;
      transform.header = header(parent);
      transform.child_frame_id = child;
      transform.transform = to_transform_message(T);
      transforms.push_back(transform);
    }
    broadcaster_.sendTransform(transforms);
  }

  // What stands around the robot and cannot move.
  void publish_cell_markers() {
    const CellConfig& cell = cell_.config();
    visualization_msgs::MarkerArray array;
    const auto add = [&](const std::string& name, const Box& box, const Pose& T,
                         const std::string& frame, float grey) {
      visualization_msgs::Marker marker;
      marker.header.frame_id = frame;
      marker.ns = name;
      marker.id = static_cast<int>(array.markers.size());
      marker.type = visualization_msgs::Marker::CUBE;
      marker.pose = to_message(Pose(T * Eigen::Translation3d(box.center)));
      marker.scale.x = box.size.x(), marker.scale.y = box.size.y(), marker.scale.z = box.size.z();
      marker.color.r = marker.color.g = marker.color.b = grey;
      marker.color.a = 1.0f;
      array.markers.push_back(marker);
    };
    add("table", cell.table, Pose::Identity(), Topics::BASE_FRAME, 0.45f);
    for (const Box& box : cell.tray.boxes())
      add("tray", box, Pose::Identity(), Topics::BASE_FRAME, 0.25f);
    for (const Box& box : cell.camera_mount)
      add("camera_mount", box, Pose::Identity(), Topics::BASE_FRAME, 0.6f);
    add("camera", {cell.camera.body_center, cell.camera.body_size}, Pose::Identity(),
        Topics::CAMERA_FRAME, 0.8f);
    markers_.publish(array);
  }

  // --- services ----------------------------------------------------------------------------

  int load(const std::string& scene, std::uint64_t seed) {
    const double before = clock_offset_ + cell_.time();
    end_arm_goal("a scene is being loaded");
    if (gripper_goal_) {
      gripper_goal_->setCanceled(gripper_result(), "a scene is being loaded");
      gripper_goal_.reset();
    }
    const int parts = cell_.load_scene(scene, seed);
    scene_ = scene;
    seed_ = seed;
    clock_offset_ = before - cell_.time() + 0.1;
    for (Periodic* periodic :
         {&joint_states_due_, &gripper_state_due_, &controller_state_due_, &frame_due_})
      periodic->restart();
    return parts;
  }

  bool on_load_scene(LoadScene::Request& request, LoadScene::Response& response) {
    try {
      response.parts = load(request.scene, request.seed);
      response.success = true;
      response.message = (scene_.empty() ? "bare table" : scene_) + ", seed " +
                         std::to_string(seed_) + ", " + std::to_string(response.parts) + " parts";
      ROS_INFO("simulator: %s", response.message.c_str());
    } catch (const Error& error) {
      response.message = error.what();
      ROS_ERROR("simulator: %s", error.what());
    }
    return true;
  }

  bool on_reset(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
    LoadScene::Request request;
    LoadScene::Response loaded;
    request.scene = scene_;
    request.seed = seed_;
    on_load_scene(request, loaded);
    response.success = loaded.success;
    response.message = loaded.message;
    return true;
  }

  bool on_step(Step::Request& request, Step::Response& response) {
    paused_ = request.steps > 0;
    for (std::uint32_t done = 0; done < request.steps && ros::ok(); ++done) advance(1);
    response.time = now().toSec();
    return true;
  }

  bool on_judge(Judge::Request&, Judge::Response& response) {
    response.verdict_json = physics::to_json(cell_.verdict());
    response.clock_offset = clock_offset_;
    return true;
  }

  bool on_truth(CalibrationTruth::Request&, CalibrationTruth::Response& response) {
    response.base_camera = to_transform_message(cell_.camera().T_base_color);
    response.tool_board = to_transform_message(
        cell_.has_board() ? cell_.T_tool_board() : Pose::Identity());
    return true;
  }

  const Settings settings_;
  physics::SimulatedCell cell_;
  std::string scene_;
  std::uint64_t seed_ = 0;
  double clock_offset_ = 1.0;  // s; a ROS time of zero means "no time yet"
  bool paused_ = false;
  bool commanded_ = false;  // a trajectory from topic 5, without an action, is under way
  unsigned listeners_ = 0;
  std::uint64_t target_poses_ = 0;
  ros::WallTime clock_wall_, frame_wall_, newcomer_wall_;
  Periodic joint_states_due_, gripper_state_due_, controller_state_due_, frame_due_;

  ros::NodeHandle node_;
  ros::Publisher clock_, joint_states_, state_, color_, color_info_, depth_, depth_info_, aligned_,
      aligned_info_, points_, target_pose_, markers_;
  ros::Subscriber command_;
  std::array<ros::ServiceServer, 5> services_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  std::optional<ArmGoal> arm_goal_;
  std::optional<GripperGoal> gripper_goal_;
  ArmServer arm_server_;
  GripperServer gripper_server_;
};

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "simulator", [] {
    // Its own simulated clock, whoever starts it; set before the first node handle reads it.
    ros::param::set("/use_sim_time", true);
    iwgnet_grasp::nodes::Simulator simulator;
    simulator.run();
  });
}
