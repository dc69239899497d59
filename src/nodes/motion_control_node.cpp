// Node 4: plans and executes one pick and place, or one push, at a time through the arm's trajectory
// controller and gripper_control.
#include <actionlib/server/simple_action_server.h>
#include <control_msgs/FollowJointTrajectoryAction.h>
#include <iwgnet_grasp/GraspPoses.h>
#include <iwgnet_grasp/GripAction.h>
#include <iwgnet_grasp/PickPlaceAction.h>
#include <iwgnet_grasp/PushAction.h>
#include <iwgnet_grasp/Scene.h>
#include <iwgnet_grasp/Topics.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/transform_listener.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <mutex>

#include "action_call.h"
#include "camera_transform.h"
#include "conversions.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/motion/pick_and_place.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

using control_msgs::FollowJointTrajectoryAction;

constexpr double kLateTopics = 3.0;  // wall s

// The robot behind its ROS drivers.
class RosRobot : public motion::Robot {
 public:
  explicit RosRobot(double held_gap_min)
      : held_gap_min_(held_gap_min), arm_(Topics::ARM_ACTION), gripper_(Topics::GRIP) {
    joints_subscriber_ =
        node_.subscribe(Topics::JOINT_STATES, 10, &RosRobot::on_joints, this,
                        ros::TransportHints().tcpNoDelay());
  }

  // Object that the gripper's commands are for, and what asks to give up.
  void begin(std::uint32_t scene_id, std::uint32_t object_id, std::function<bool()> cancelled) {
    grip_goal_.scene_id = scene_id;
    grip_goal_.object_id = object_id;
    cancelled_ = std::move(cancelled);
    closed_ = false;
  }

  // The same for a motion without an object: topic 4 has no opening for it.
  void begin(std::function<bool()> cancelled) {
    begin(0, 0, std::move(cancelled));
    closed_ = true;
  }

  JointVector joints() override {
    const ros::WallTime start = ros::WallTime::now();
    while (ros::ok()) {
      {
        const std::lock_guard lock(mutex_);
        if (ros::WallTime::now() - joints_time_ < ros::WallDuration(1.0)) return joints_;
      }
      if (ros::WallTime::now() - start > ros::WallDuration(5.0))
        throw Error("no joint state of the arm on " + Topics::JOINT_STATES +
                    " for 5 s: is the arm's driver running?");
      ros::WallDuration(0.002).sleep();
    }
    throw Error("the node is shutting down");
  }

  motion::ExecutionResult execute(const motion::Trajectory& trajectory) override {
    motion::ExecutionResult result = follow(trajectory, {});
    result.contact = false;
    return result;
  }

  motion::ExecutionResult execute_until_contact(const motion::Trajectory& trajectory,
                                                const JointVector& path_tolerance) override {
    motion::ExecutionResult result = follow(trajectory, path_tolerance);
    if (result.contact) result.success = true;
    return result;
  }

  motion::GripResult grip(double gap_m, double /*force_n: topic 4 carries it*/) override {
    const auto outcome =
        call_action(gripper_, Topics::GRIP, goal_for(gap_m), ros::Duration(30.0), cancelled_);
    motion::GripResult result;
    result.success = outcome.finished && outcome.succeeded;
    result.stalled = outcome.result.stalled;
    result.gap = outcome.result.gap;
    result.message = outcome.message;
    return result;
  }

  // The arm starts while the gripper still opens; the next grip() takes over from this goal.
  motion::GripResult preset(double gap_m, double force_n) override {
    if (!gripper_.isServerConnected()) return grip(gap_m, force_n);  // which waits and says why not
    preset_ = gripper_.sendGoal(goal_for(gap_m));
    motion::GripResult result;
    result.success = true;
    result.gap = gap_m;
    return result;
  }

  double gap() override {
    const std::lock_guard lock(mutex_);
    return gap_;
  }

 private:
  motion::ExecutionResult follow(const motion::Trajectory& trajectory,
                                 const std::optional<JointVector>& path_tolerance) {
    control_msgs::FollowJointTrajectoryGoal goal;
    goal.trajectory = to_message(trajectory);
    goal.trajectory.header.frame_id = Topics::BASE_FRAME;
    for (int j = 0; path_tolerance && j < kJoints; ++j) {
      control_msgs::JointTolerance tolerance;
      tolerance.name = goal.trajectory.joint_names[j];
      tolerance.position = (*path_tolerance)[j];
      goal.path_tolerance.push_back(tolerance);
    }
    const double duration = trajectory.empty() ? 0.0 : trajectory.back().time;
    const auto outcome = call_action(arm_, Topics::ARM_ACTION, goal, ros::Duration(duration + 10.0),
                                     cancelled_);
    if (!outcome.finished) return {false, outcome.message};
    if (outcome.succeeded) return {true, ""};
    using Result = control_msgs::FollowJointTrajectoryResult;
    return {false,
            "the arm's controller gave up: " + outcome.result.error_string +
                (outcome.result.error_string.empty() ? outcome.message : ""),
            outcome.result.error_code == Result::PATH_TOLERANCE_VIOLATED};
  }

  GripGoal goal_for(double gap_m) {
    GripGoal goal = grip_goal_;
    goal.gap = gap_m;
    if (gap_m < held_gap_min_) {
      goal.command = GripGoal::CLOSE;
      closed_ = true;
    } else {
      goal.command = closed_ ? GripGoal::RELEASE : GripGoal::OPEN;
    }
    return goal;
  }

  void on_joints(const sensor_msgs::JointState::ConstPtr& state) {
    const auto joints = arm_joints(*state);
    const std::lock_guard lock(mutex_);
    if (!joints) {  // the gripper's own joint state
      const auto finger = std::find(state->name.begin(), state->name.end(), "finger_joint");
      const auto index = static_cast<std::size_t>(finger - state->name.begin());
      if (index < state->position.size()) gap_ = kinematics::gap_from_joint(state->position[index]);
      return;
    }
    joints_ = *joints;
    joints_time_ = ros::WallTime::now();
  }

  const double held_gap_min_;
  ros::NodeHandle node_;
  ros::Subscriber joints_subscriber_;
  std::mutex mutex_;
  JointVector joints_ = JointVector::Zero();
  ros::WallTime joints_time_;
  double gap_ = std::numeric_limits<double>::quiet_NaN();  // m; unknown until the gripper reports
  actionlib::ActionClient<FollowJointTrajectoryAction> arm_;
  actionlib::ActionClient<GripAction> gripper_;
  actionlib::ActionClient<GripAction>::GoalHandle preset_;  // dropping it would lose track of it
  GripGoal grip_goal_;
  std::function<bool()> cancelled_;
  bool closed_ = false;
};

class MotionControl {
 public:
  MotionControl()
      : cell_(load_cell_config(config_dir())),
        config_(load_config()),
        pick_and_place_(cell_, config_),
        robot_(config_.held_gap_min),
        transforms_(buffer_),
        server_(Topics::PICK_PLACE, [this](const PickPlaceGoalConstPtr& goal) { pick(*goal); },
                false),
        push_server_(Topics::PUSH, [this](const PushGoalConstPtr& goal) { push(*goal); }, false) {
    scene_subscriber_ = node_.subscribe(Topics::SCENE, 1, &MotionControl::on_scene, this);
    poses_subscriber_ = node_.subscribe(Topics::GRASP_POSE, 2, &MotionControl::on_poses, this);
    observe_service_ = node_.advertiseService(Topics::OBSERVE, &MotionControl::observe, this);
    server_.start();
    push_server_.start();
  }

 private:
  static motion::PickPlaceConfig load_config() {
    motion::PickPlaceConfig config = motion::load_pick_place_config(config_dir());
    config.planner.seed = ros::param::param("~planner_seed", static_cast<int>(config.planner.seed));
    return config;
  }

  void on_scene(const Scene::ConstPtr& scene) {
    const std::lock_guard lock(mutex_);
    scene_ = scene;
  }

  void on_poses(const GraspPoses::ConstPtr& poses) {
    const std::lock_guard lock(mutex_);
    poses_ = poses;
  }

  // The grasp poses of a scene, whose heights the planner is given. Throws Error when they do not
  // come; `what` they are for.
  GraspPoses::ConstPtr poses_of(std::uint32_t scene_id, const std::string& what) {
    GraspPoses::ConstPtr poses;
    Scene::ConstPtr scene;
    // Topics and goals come by different connections: the goal may be the first to arrive.
    const ros::WallTime deadline = ros::WallTime::now() + ros::WallDuration(kLateTopics);
    do {
      {
        const std::lock_guard lock(mutex_);
        poses = poses_;
        scene = scene_;
      }
      if (poses && scene && poses->scene_id == scene_id && scene->scene_id == scene_id) break;
      ros::WallDuration(0.005).sleep();
    } while (ros::ok() && ros::WallTime::now() < deadline);
    if (!poses || poses->scene_id != scene_id)
      throw Error(Topics::GRASP_POSE + " holds nothing for " + what);
    if (poses->header.frame_id != Topics::BASE_FRAME)
      throw Error(Topics::GRASP_POSE + " is in frame '" + poses->header.frame_id + "', expected '" +
                  Topics::BASE_FRAME + "'");
    if (!scene || scene->scene_id != scene_id)
      throw Error(Topics::SCENE + " holds no depth for " + what);
    if (scene_with_heights_ != scene) {
      const cv::Mat depth = depth_image(scene->depth, Topics::SCENE);
      pick_and_place_.set_heights(
          grasping::HeightMap(depth, from_message(scene->camera_info),
                              camera_transform(buffer_, scene->header.frame_id), cell_));
      scene_with_heights_ = scene;
    }
    return poses;
  }

  motion::PickRequest request_for(const PickPlaceGoal& goal) {
    const std::string which = "object " + std::to_string(goal.object_id) + " of scene " +
                              std::to_string(goal.scene_id);
    const int slots = cell_.tray.columns * cell_.tray.rows;
    if (goal.tray_slot >= static_cast<std::uint32_t>(slots))
      throw Error("tray slot " + std::to_string(goal.tray_slot) + " does not exist: the tray has " +
                  std::to_string(slots));
    const GraspPoses::ConstPtr poses = poses_of(goal.scene_id, which);
    for (const GraspPose& grasp : poses->grasps)
      if (grasp.object_id == goal.object_id)
        return {from_message(grasp), from_message(grasp.centroid), static_cast<int>(goal.tray_slot)};
    throw Error(Topics::GRASP_POSE + " holds nothing for " + which);
  }

  template <typename Server, typename Result>
  static void finish(Server& server, const Result& result) {
    if (server.isPreemptRequested())
      server.setPreempted(result, result.message);
    else if (result.success)
      server.setSucceeded(result, result.message);
    else
      server.setAborted(result, result.message);
  }

  void pick(const PickPlaceGoal& goal) {
    const std::lock_guard motion_lock(motion_mutex_);
    PickPlaceResult result;
    result.reason = PickPlaceResult::UNKNOWN_GRASP;
    try {
      const motion::PickRequest request = request_for(goal);
      result.reason = PickPlaceResult::EXECUTION_FAILED;  // of an Error thrown below
      const auto cancelled = [this] { return server_.isPreemptRequested() || !ros::ok(); };
      robot_.begin(goal.scene_id, goal.object_id, cancelled);
      const motion::PickResult picked =
          pick_and_place_.run(robot_, request, [&](const std::string& phase) {
            PickPlaceFeedback feedback;
            feedback.phase = phase;
            server_.publishFeedback(feedback);
            return !cancelled();
          });
      result.success = picked.reason == motion::PickReason::kSucceeded;
      result.reason = static_cast<std::uint8_t>(picked.reason);
      result.message = picked.message;
      ROS_INFO("motion_control: scene %u object %u: %s (planned in %.0f ms)", goal.scene_id,
               goal.object_id, result.success ? "done" : result.message.c_str(),
               picked.planning_seconds * 1e3);
    } catch (const Error& error) {
      result.message = error.what();
    }
    if (!result.success) ROS_WARN("motion_control: pick refused or failed: %s", result.message.c_str());
    finish(server_, result);
  }

  void push(const PushGoal& goal) {
    const std::lock_guard motion_lock(motion_mutex_);
    PushResult result;
    try {
      const GraspPoses::ConstPtr poses =
          poses_of(goal.scene_id, "scene " + std::to_string(goal.scene_id));
      std::vector<Eigen::Vector3d> objects;
      for (const GraspPose& grasp : poses->grasps)
        if (std::isfinite(grasp.centroid.x)) objects.push_back(from_message(grasp.centroid));
      result.moved = true;  // of an Error thrown below
      robot_.begin([this] { return push_server_.isPreemptRequested() || !ros::ok(); });
      const motion::PickResult pushed = pick_and_place_.push(robot_, objects);
      result.success = pushed.reason == motion::PickReason::kSucceeded;
      result.moved = result.success || pushed.reason == motion::PickReason::kExecutionFailed;
      result.message = pushed.message;
    } catch (const Error& error) {
      result.message = error.what();
    }
    ROS_INFO("motion_control: push in scene %u: %s", goal.scene_id,
             result.success ? "done" : result.message.c_str());
    finish(push_server_, result);
  }

  bool observe(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
    const std::unique_lock motion_lock(motion_mutex_, std::try_to_lock);
    if (!motion_lock) {
      response.message = "a pick is under way: wait for it or cancel it first";
      return true;
    }
    try {
      robot_.begin([] { return !ros::ok(); });
      const motion::PickResult result = pick_and_place_.observe(robot_);
      response.success = result.reason == motion::PickReason::kSucceeded;
      response.message = result.message;
    } catch (const Error& error) {
      response.message = error.what();
    }
    if (!response.success) ROS_ERROR("motion_control: observe: %s", response.message.c_str());
    return true;
  }

  const CellConfig cell_;
  const motion::PickPlaceConfig config_;
  motion::PickAndPlace pick_and_place_;
  RosRobot robot_;
  std::mutex motion_mutex_;  // one motion at a time
  std::mutex mutex_;         // of the messages below
  Scene::ConstPtr scene_, scene_with_heights_;
  GraspPoses::ConstPtr poses_;
  ros::NodeHandle node_;
  tf2_ros::Buffer buffer_;
  tf2_ros::TransformListener transforms_;
  ros::Subscriber scene_subscriber_, poses_subscriber_;
  ros::ServiceServer observe_service_;
  actionlib::SimpleActionServer<PickPlaceAction> server_;
  actionlib::SimpleActionServer<PushAction> push_server_;
};

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "motion_control", [] {
    iwgnet_grasp::nodes::MotionControl motion;
    ros::AsyncSpinner spinner(4);
    spinner.start();
    ros::waitForShutdown();
  });
}
