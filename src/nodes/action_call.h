// One goal to an action server, waited for without a chance to hang: the server may die, its clock
// may stand still, the caller may want to give up.
#pragma once

#include <actionlib/client/action_client.h>
#include <ros/ros.h>

#include <chrono>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <string>

namespace iwgnet_grasp::nodes {

template <typename Result>
struct ActionOutcome {
  bool finished = false;  // the server gave a result
  bool succeeded = false;
  Result result;
  std::string message;    // why not finished, else what the server said
};

// Needs a spinner elsewhere. `limit`: ROS time for the goal; `silence`: wall seconds after which a
// server whose clock stands still is given up. Not SimpleActionClient: a result that comes back
// before its sendGoal() has returned is lost there.
template <typename Action>
ActionOutcome<typename Action::_action_result_type::_result_type> call_action(
    actionlib::ActionClient<Action>& client, const std::string& name,
    const typename Action::_action_goal_type::_goal_type& goal, ros::Duration limit,
    const std::function<bool()>& cancelled = {}, double silence = 180.0) {
  using Result = typename Action::_action_result_type::_result_type;
  using Handle = actionlib::ClientGoalHandle<Action>;
  using Clock = std::chrono::steady_clock;
  struct Shared {  // outlives this call if a late result arrives
    std::mutex mutex;
    std::condition_variable changed;
    bool done = false, succeeded = false;
    std::string text;
    typename Result::ConstPtr result;
  };
  ActionOutcome<Result> outcome;
  const auto wall_start = Clock::now();
  const auto waited = [&] { return std::chrono::duration<double>(Clock::now() - wall_start).count(); };
  if (cancelled && cancelled()) {
    outcome.message = "cancelled";
    return outcome;
  }
  while (ros::ok() && !client.isServerConnected()) {
    if (waited() > 10.0) {
      outcome.message = "no action server on " + name + ": is its node or driver running?";
      return outcome;
    }
    ros::WallDuration(0.005).sleep();
  }

  const auto shared = std::make_shared<Shared>();
  Handle handle = client.sendGoal(goal, [shared](Handle changed) {
    if (changed.getCommState() != actionlib::CommState::DONE) return;
    const std::lock_guard lock(shared->mutex);
    shared->done = true;
    shared->succeeded = changed.getTerminalState() == actionlib::TerminalState::SUCCEEDED;
    shared->text = changed.getTerminalState().getText();
    shared->result = changed.getResult();
    shared->changed.notify_all();
  });
  const ros::Time start = ros::Time::now();
  std::unique_lock lock(shared->mutex);
  while (!shared->done) {
    shared->changed.wait_for(lock, std::chrono::milliseconds(20));
    if (shared->done) break;
    if (!ros::ok())
      outcome.message = "the node is shutting down";
    else if (cancelled && cancelled())
      outcome.message = "cancelled";
    else if (!client.isServerConnected())
      outcome.message = "the action server on " + name + " went away";
    else if (ros::Time::now() - start > limit)
      outcome.message = "no result from " + name + " within " +
                        std::to_string(static_cast<int>(limit.toSec())) + " s";
    else if (waited() > silence)
      outcome.message = "no result from " + name + ": does its clock stand still?";
    if (!outcome.message.empty()) {
      lock.unlock();
      handle.cancel();
      return outcome;
    }
  }
  outcome.finished = true;
  outcome.succeeded = shared->succeeded;
  outcome.message = shared->text;
  if (shared->result) outcome.result = *shared->result;
  return outcome;
}

}  // namespace iwgnet_grasp::nodes
