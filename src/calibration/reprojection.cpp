#include "iwgnet_grasp/calibration/reprojection.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "geometry.h"

namespace iwgnet_grasp::calibration {
namespace {

using Matrix12 = Eigen::Matrix<double, 12, 12>;
using Vector12 = Eigen::Matrix<double, 12, 1>;

constexpr std::size_t kMinViews = 4, kMinCorners = 4;
constexpr int kMaxIterations = 100;
constexpr int kRoughIterations = 5;  // from a rough start: views are bounded, none is left out
constexpr int kScaleIterations = 10;  // then the scale stays: it would chase its own weights
constexpr double kHuber = 1.345;     // 95 % efficiency on Gaussian noise
constexpr double kTukey = 4.685;
constexpr double kLeastScale = 1e-3;  // px, of clean data

Eigen::Vector2d projected(const PinholeIntrinsics& k, const Eigen::Vector3d& p) {
  return {k.fx * p.x() / p.z() + k.cx, k.fy * p.y() / p.z() + k.cy};
}

double rms(const std::vector<Eigen::Vector2d>& residuals) {  // of one coordinate
  double sum = 0;
  for (const auto& r : residuals) sum += r.squaredNorm();
  return std::sqrt(sum / (2.0 * residuals.size()));
}

}  // namespace

std::vector<Eigen::Vector2d> reprojection_residuals(const TargetView& view,
                                                    const PinholeIntrinsics& camera, const Pose& X,
                                                    const Pose& Y) {
  const Pose T_camera_target = X.inverse() * view.T_base_tool * Y;
  std::vector<Eigen::Vector2d> residuals;
  for (std::size_t i = 0; i < view.corners.size(); ++i)
    residuals.push_back(view.pixels[i] - projected(camera, T_camera_target * view.corners[i]));
  return residuals;
}

ReprojectionResult refine_reprojection(const std::vector<TargetView>& views,
                                       const PinholeIntrinsics& camera, const Pose& X_start,
                                       const Pose& Y_start) {
  ReprojectionResult result;
  const std::size_t count = views.size();
  if (count < kMinViews) {
    result.reason = "only " + std::to_string(count) + " views; at least " +
                    std::to_string(kMinViews) + " are needed";
    return result;
  }
  for (std::size_t i = 0; i < count; ++i)
    if (views[i].corners.size() < kMinCorners || views[i].corners.size() != views[i].pixels.size()) {
      result.reason = "view " + std::to_string(i) + " has " +
                      std::to_string(views[i].pixels.size()) + " pixels for " +
                      std::to_string(views[i].corners.size()) + " corners; at least " +
                      std::to_string(kMinCorners) + " of each are needed";
      return result;
    }

  Pose X = X_start, Y = Y_start;
  std::vector<double> weights(count, 1.0), view_rms(count);
  Matrix12 H;
  double scale = 0.0;
  bool converged = false;
  for (int iteration = 0; iteration < kMaxIterations && !converged; ++iteration) {
    result.iterations = iteration + 1;
    std::vector<std::vector<Eigen::Vector2d>> residuals(count);
    for (std::size_t i = 0; i < count; ++i) {
      residuals[i] = reprojection_residuals(views[i], camera, X, Y);
      view_rms[i] = rms(residuals[i]);
      if (!std::isfinite(view_rms[i])) {
        result.reason = "view " + std::to_string(i) +
                        " lies behind the camera or holds a value that is not a number";
        return result;
      }
    }
    if (iteration < kScaleIterations) scale = std::max(median(view_rms), kLeastScale);
    H.setZero();
    Vector12 g = Vector12::Zero();
    for (std::size_t i = 0; i < count; ++i) {
      const double d = view_rms[i] / scale;
      if (iteration < kRoughIterations)
        weights[i] = d <= kHuber ? 1.0 : kHuber / d;
      else
        weights[i] = d < kTukey ? std::pow(1 - std::pow(d / kTukey, 2), 2) : 0.0;
      const Pose M = X.inverse() * views[i].T_base_tool * Y;
      for (std::size_t k = 0; k < residuals[i].size(); ++k) {
        const Eigen::Vector3d p = M * views[i].corners[k];
        // Steps of X and Y in their own axes move the corner in the camera by J.
        Eigen::Matrix<double, 3, 12> J;
        J.leftCols<3>() = -Eigen::Matrix3d::Identity();
        J.middleCols<3>(3) = cross(p);
        J.middleCols<3>(6) = M.linear();
        J.rightCols<3>() = -M.linear() * cross(views[i].corners[k]);
        Eigen::Matrix<double, 2, 3> projection;
        projection << camera.fx / p.z(), 0, -camera.fx * p.x() / (p.z() * p.z()),
            0, camera.fy / p.z(), -camera.fy * p.y() / (p.z() * p.z());
        const Eigen::Matrix<double, 2, 12> A = projection * J;
        const double far = residuals[i][k].norm() / (std::sqrt(2.0) * scale);
        const double weight = weights[i] * (far <= kHuber ? 1.0 : kHuber / far);
        H += weight * A.transpose() * A;
        g += weight * A.transpose() * residuals[i][k];
      }
    }
    const Eigen::LDLT<Matrix12> ldlt(H);
    const Vector12 step = ldlt.solve(g);
    if (ldlt.info() != Eigen::Success || !step.allFinite()) {
      result.reason = "the equations have no unique solution; spread the poses more";
      return result;
    }
    X = moved(X, step.head<6>());
    Y = moved(Y, step.tail<6>());
    converged = iteration > kRoughIterations && step.norm() < 1e-8;
  }
  if (!converged) {
    result.reason = "no convergence after " + std::to_string(kMaxIterations) +
                    " iterations; the views contradict each other or the start is far off";
    return result;
  }
  const auto trusted = std::count_if(weights.begin(), weights.end(), [](double w) { return w > 0.1; });
  if (2 * trusted <= static_cast<long>(count)) {
    result.reason = "the views contradict each other: only " + std::to_string(trusted) + " of " +
                    std::to_string(count) + " agree; check that the target sits firmly";
    return result;
  }
  result.T_base_camera = X;
  result.T_tool_target = Y;
  result.view_rms_px = view_rms;
  result.weights = weights;
  double squares = 0, numbers = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const double n = 2.0 * views[i].corners.size();
    squares += weights[i] * n * view_rms[i] * view_rms[i];
    numbers += weights[i] * n;
  }
  result.rms_px = std::sqrt(squares / numbers);
  // The information scaled by the noise that is really there.
  const double variance = squares / std::max(1.0, numbers - 12.0);
  result.covariance = (H.inverse() * variance).topLeftCorner<6, 6>();
  result.success = true;
  return result;
}

std::pair<double, double> leave_one_out_spread(const std::vector<TargetView>& views,
                                               const PinholeIntrinsics& camera,
                                               const ReprojectionResult& result) {
  return leave_one_out(views, result.T_base_camera, [&](const std::vector<TargetView>& rest) {
    return refine_reprojection(rest, camera, result.T_base_camera, result.T_tool_target);
  });
}

}  // namespace iwgnet_grasp::calibration
