// Hand-eye calibration with ViSP by the visp_hand2eye_calibration workflow: topics camera_object and
// world_effector, services compute_effector_camera, compute_effector_camera_quick and reset.
// Beyond it: ~eye_to_hand, stamped pairs on `pair`, a maximum-likelihood refinement, residuals on
// ~result, and a refusal with its reason in place of a wrong matrix.
//
// This executable links libvisp (GPL-2+) and is therefore under the GPL as a whole.
#include <iwgnet_grasp/CalibrationPair.h>
#include <iwgnet_grasp/HandEyeResult.h>
#include <ros/ros.h>
#include <visp_hand2eye_calibration/TransformArray.h>
#include <visp_hand2eye_calibration/compute_effector_camera.h>
#include <visp_hand2eye_calibration/compute_effector_camera_quick.h>
#include <visp_hand2eye_calibration/reset.h>

#include <tuple>

#include "iwgnet_grasp/calibration/hand_eye.h"
#include "visp_solver.h"

namespace iwgnet_grasp {
namespace {

namespace visp = visp_hand2eye_calibration;

Pose from_message(const geometry_msgs::Transform& message) {
  Pose T = Pose::Identity();
  const auto& q = message.rotation;
  // An all-zero quaternion stays a non-rotation, which refuse_pairs() then names.
  T.linear() = Eigen::Quaterniond(q.w, q.x, q.y, q.z).toRotationMatrix();
  T.translation() << message.translation.x, message.translation.y, message.translation.z;
  return T;
}

geometry_msgs::Transform to_message(const Pose& T) {
  geometry_msgs::Transform message;
  const Eigen::Quaterniond q(T.linear());
  message.rotation.x = q.x();
  message.rotation.y = q.y();
  message.rotation.z = q.z();
  message.rotation.w = q.w();
  message.translation.x = T.translation().x();
  message.translation.y = T.translation().y();
  message.translation.z = T.translation().z();
  return message;
}

class Calibrator {
 public:
  Calibrator() {
    eye_to_hand_ = private_.param("eye_to_hand", false);
    limits_.min_pairs = private_.param("min_pairs", limits_.min_pairs);
    limits_.max_rms_translation = private_.param("max_rms_translation", limits_.max_rms_translation);
    limits_.max_rms_rotation = private_.param("max_rms_rotation", limits_.max_rms_rotation);
    noise_.translation = private_.param("noise_translation", noise_.translation);
    noise_.rotation = private_.param("noise_rotation", noise_.rotation);
    if (limits_.min_pairs < 4 || limits_.max_rms_translation <= 0 || limits_.max_rms_rotation <= 0 ||
        noise_.translation <= 0 || noise_.rotation <= 0)
      throw Error("calibrator: min_pairs must be at least 4, limits and noise positive");

    constexpr int kQueue = 1000;  // of the original: nothing of a fast client may be lost
    result_ = private_.advertise<HandEyeResult>("result", 1, true);
    camera_object_ = node_.subscribe<geometry_msgs::Transform>(
        "camera_object", kQueue, [this](const auto& message) { camera_.push_back(*message); });
    world_effector_ = node_.subscribe<geometry_msgs::Transform>(
        "world_effector", kQueue, [this](const auto& message) { effector_.push_back(*message); });
    pair_ = node_.subscribe<CalibrationPair>("pair", kQueue, [this](const auto& message) {
      pairs_.push_back(pair(message->world_effector, message->camera_object));
    });
    compute_ = node_.advertiseService("compute_effector_camera", &Calibrator::compute, this);
    quick_ = node_.advertiseService("compute_effector_camera_quick", &Calibrator::quick, this);
    reset_ = node_.advertiseService("reset", &Calibrator::reset, this);
    ROS_INFO("calibrator: ready, %s", eye_to_hand_ ? "camera in the room (eye-to-hand)"
                                                   : "camera on the effector (eye-in-hand)");
  }

 private:
  // Both set-ups in the form of calibration::refine(): the eye-in-hand one with the base and the
  // tool in each other's place.
  calibration::PosePair pair(const geometry_msgs::Transform& world_effector,
                             const geometry_msgs::Transform& camera_object) const {
    const Pose T_world_effector = from_message(world_effector);
    return {eye_to_hand_ ? T_world_effector : T_world_effector.inverse(),
            from_message(camera_object)};
  }

  std::vector<calibration::PosePair> pairs_of(
      const std::vector<geometry_msgs::Transform>& effector,
      const std::vector<geometry_msgs::Transform>& camera) const {
    if (effector.size() != camera.size())
      throw Error("calibrator: " + std::to_string(camera.size()) + " camera_object but " +
                  std::to_string(effector.size()) +
                  " world_effector; send one of each for every pose, then call again");
    std::vector<calibration::PosePair> pairs;
    for (std::size_t i = 0; i < camera.size(); ++i) pairs.push_back(pair(effector[i], camera[i]));
    return pairs;
  }

  geometry_msgs::Transform solve(const std::vector<calibration::PosePair>& pairs) {
    const std::string refusal = calibration::refuse_pairs(pairs, limits_);
    if (!refusal.empty()) throw Error("calibrator: " + refusal);
    const Pose start = solve_with_visp(pairs);
    const auto result = calibration::refine(pairs, start, noise_, limits_);
    if (!result.success)
      throw Error("calibrator: " + result.reason +
                  (fits_other_set_up(pairs) ? std::string("; they fit a camera ") +
                                                  (eye_to_hand_ ? "on the effector (~eye_to_hand:=false)"
                                                                : "in the room (~eye_to_hand:=true)")
                                            : ""));
    publish(pairs, start, result);
    return to_message(result.T_base_camera);
  }

  // Whether the pairs are good ones with base and tool in each other's place.
  bool fits_other_set_up(std::vector<calibration::PosePair> pairs) const {
    for (auto& pair : pairs) pair.T_base_tool = pair.T_base_tool.inverse();
    try {
      return calibration::refine(pairs, solve_with_visp(pairs), noise_, limits_).success;
    } catch (const std::exception&) {
      return false;
    }
  }

  void publish(const std::vector<calibration::PosePair>& pairs, const Pose& visp_solution,
               const calibration::HandEyeResult& result) {
    HandEyeResult message;
    message.header.stamp = ros::Time::now();
    message.eye_to_hand = eye_to_hand_;
    message.camera = to_message(result.T_base_camera);
    message.target = to_message(result.T_tool_target);
    message.visp = to_message(visp_solution);
    message.rms_translation = result.rms_translation;
    message.rms_rotation = result.rms_rotation;
    message.translation_residuals = result.translation_residuals;
    message.rotation_residuals = result.rotation_residuals;
    message.weights = result.weights;
    std::tie(message.leave_one_out_translation, message.leave_one_out_rotation) =
        calibration::leave_one_out_spread(pairs, result, noise_, limits_);
    const auto diversity = calibration::rotation_diversity(pairs);
    message.largest_rotation = diversity.largest;
    message.axis_spread = diversity.axis_spread;
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 6; ++c) message.covariance[6 * r + c] = result.covariance(r, c);
    result_.publish(message);
    ROS_INFO("calibrator: %zu pairs, rms %.2f mm %.3f deg, leave-one-out %.2f mm %.3f deg",
             pairs.size(), result.rms_translation * 1e3, result.rms_rotation * 180 / M_PI,
             message.leave_one_out_translation * 1e3, message.leave_one_out_rotation * 180 / M_PI);
  }

  // An Error thrown by a service goes back to the caller with its text; the node serves on.
  bool compute(visp::compute_effector_camera::Request&,
               visp::compute_effector_camera::Response& response) {
    auto pairs = pairs_of(effector_, camera_);
    pairs.insert(pairs.end(), pairs_.begin(), pairs_.end());
    response.effector_camera = solve(pairs);
    return true;
  }

  bool quick(visp::compute_effector_camera_quick::Request& request,
             visp::compute_effector_camera_quick::Response& response) {
    response.effector_camera =
        solve(pairs_of(request.world_effector.transforms, request.camera_object.transforms));
    return true;
  }

  bool reset(visp::reset::Request&, visp::reset::Response&) {
    camera_.clear();
    effector_.clear();
    pairs_.clear();
    return true;
  }

  ros::NodeHandle node_, private_{"~"};
  bool eye_to_hand_;
  calibration::Limits limits_;
  calibration::PoseNoise noise_;
  std::vector<geometry_msgs::Transform> camera_, effector_;  // in the order of arrival
  std::vector<calibration::PosePair> pairs_;                 // of the stamped input
  ros::Publisher result_;
  ros::Subscriber camera_object_, world_effector_, pair_;
  ros::ServiceServer compute_, quick_, reset_;
};

}  // namespace
}  // namespace iwgnet_grasp

int main(int argc, char** argv) {
  ros::init(argc, argv, "calibrator");
  try {
    const iwgnet_grasp::Calibrator calibrator;
    ros::spin();
  } catch (const std::exception& error) {
    ROS_FATAL("%s", error.what());
    return 1;
  }
  return 0;
}
