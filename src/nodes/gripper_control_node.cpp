// Node 5: opens and closes the gripper by the widths of topic 4, and says whether it holds something.
#include <actionlib/server/simple_action_server.h>
#include <control_msgs/GripperCommandAction.h>
#include <iwgnet_grasp/GripAction.h>
#include <iwgnet_grasp/GripperWidths.h>
#include <iwgnet_grasp/Topics.h>

#include <cmath>
#include <mutex>

#include "action_call.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/motion/pick_and_place.h"
#include "node_setup.h"

namespace iwgnet_grasp::nodes {
namespace {

constexpr double kLateTopic = 3.0;       // wall s
constexpr double kGripTimeLimit = 15.0;  // s: full stroke at the slowest speed takes 4 s

class GripperControl {
 public:
  GripperControl()
      : config_(motion::load_pick_place_config(config_dir())),
        driver_(Topics::GRIPPER_ACTION),
        server_(Topics::GRIP, [this](const GripGoalConstPtr& goal) { grip(*goal); }, false) {
    widths_subscriber_ = node_.subscribe(Topics::GRIPPER_WIDTH, 2, &GripperControl::on_widths, this);
    server_.start();
  }

 private:
  void on_widths(const GripperWidths::ConstPtr& widths) {
    const std::lock_guard lock(mutex_);
    widths_ = widths;
  }

  GripperWidth width_of(std::uint32_t scene_id, std::uint32_t object_id) {
    // Topic and goal come by different connections: the goal may be the first to arrive.
    const ros::WallTime deadline = ros::WallTime::now() + ros::WallDuration(kLateTopic);
    do {
      {
        const std::lock_guard lock(mutex_);
        if (widths_ && widths_->scene_id == scene_id)
          for (const GripperWidth& width : widths_->widths)
            if (width.object_id == object_id) return width;
      }
      ros::WallDuration(0.005).sleep();
    } while (ros::ok() && ros::WallTime::now() < deadline);
    throw Error(Topics::GRIPPER_WIDTH + " holds no width for object " + std::to_string(object_id) +
                " of scene " + std::to_string(scene_id));
  }

  // Gap (m) and force (N) of a goal. Throws Error.
  control_msgs::GripperCommand command_for(const GripGoal& goal) {
    control_msgs::GripperCommand command;
    command.max_effort = config_.grip_force;
    if (goal.command == GripGoal::RELEASE) {
      command.position = goal.gap;
    } else if (goal.command == GripGoal::OPEN) {
      command.position = width_of(goal.scene_id, goal.object_id).opening;
    } else if (goal.command == GripGoal::CLOSE) {
      command.position = 0.0;
      command.max_effort = width_of(goal.scene_id, goal.object_id).force;
    } else {
      throw Error("unknown grip command " + std::to_string(goal.command) +
                  ": use OPEN 0, CLOSE 1 or RELEASE 2");
    }
    if (!std::isfinite(command.position) || command.position < 0.0 ||
        command.position > kinematics::max_gap() + 1e-3)
      throw Error("a gap of " + std::to_string(command.position) + " m is outside the gripper's 0 to " +
                  std::to_string(kinematics::max_gap()) + " m");
    return command;
  }

  void grip(const GripGoal& goal) {
    GripResult result;
    try {
      control_msgs::GripperCommandGoal driver_goal;
      driver_goal.command = command_for(goal);
      const auto outcome =
          call_action(driver_, Topics::GRIPPER_ACTION, driver_goal, ros::Duration(kGripTimeLimit),
                      [this] { return server_.isPreemptRequested(); });
      if (!outcome.finished) throw Error(outcome.message);
      result.gap = outcome.result.position;
      result.stalled = outcome.result.stalled;
      // Some drivers abort when they stall on an object: that is a grip, not a fault.
      if (!outcome.succeeded && !result.stalled)
        throw Error("the gripper's driver gave up: " + outcome.message);
      result.holding = goal.command == GripGoal::CLOSE && result.stalled &&
                       result.gap > config_.held_gap_min;
      server_.setSucceeded(result);
    } catch (const Error& error) {
      result.message = error.what();
      ROS_ERROR("gripper_control: %s", error.what());
      if (server_.isPreemptRequested())
        server_.setPreempted(result, result.message);
      else
        server_.setAborted(result, result.message);
    }
  }

  const motion::PickPlaceConfig config_;
  ros::NodeHandle node_;
  std::mutex mutex_;
  GripperWidths::ConstPtr widths_;
  ros::Subscriber widths_subscriber_;
  actionlib::ActionClient<control_msgs::GripperCommandAction> driver_;
  actionlib::SimpleActionServer<GripAction> server_;
};

}  // namespace
}  // namespace iwgnet_grasp::nodes

int main(int argc, char** argv) {
  return iwgnet_grasp::nodes::run_node(argc, argv, "gripper_control", [] {
    iwgnet_grasp::nodes::GripperControl gripper;
    ros::AsyncSpinner spinner(2);
    spinner.start();
    ros::waitForShutdown();
  });
}
