#include "iwgnet_grasp/calibration/hand_eye.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <cstdio>

#include "geometry.h"

namespace iwgnet_grasp::calibration {
namespace {

// What is left between the measured and the predicted target pose, in the target's frame.
Pose discrepancy(const PosePair& pair, const Pose& X, const Pose& Y) {
  return pair.T_camera_target.inverse() * X.inverse() * pair.T_base_tool * Y;
}

Vector6 residual(const Pose& M) {
  Vector6 r;
  r << M.translation(), rotation_vector(M.linear());
  return r;
}

std::string text(const char* format, double a, double b = 0.0) {
  char line[200];
  std::snprintf(line, sizeof line, format, a, b);
  return line;
}

constexpr double kDegree = M_PI / 180.0;

}  // namespace

RotationDiversity rotation_diversity(const std::vector<PosePair>& pairs) {
  RotationDiversity result;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (std::size_t i = 0; i < pairs.size(); ++i)
    for (std::size_t j = i + 1; j < pairs.size(); ++j) {
      const Eigen::Vector3d v = rotation_vector(pairs[i].T_base_tool.linear().transpose() *
                                                pairs[j].T_base_tool.linear());
      result.largest = std::max(result.largest, v.norm());
      scatter += v * v.transpose();
    }
  // Turns about one axis leave a scatter of rank one.
  const Eigen::Vector3d spread =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(scatter).eigenvalues().cwiseMax(0.0);
  if (spread(2) > 0) result.axis_spread = std::atan(std::sqrt(spread(1) / spread(2)));
  return result;
}

std::string refuse_pairs(const std::vector<PosePair>& pairs, const Limits& limits) {
  const int count = static_cast<int>(pairs.size());
  for (int i = 0; i < count; ++i) {
    for (const Pose* T : {&pairs[i].T_base_tool, &pairs[i].T_camera_target}) {
      if (!T->matrix().allFinite())
        return "pair " + std::to_string(i) + " holds a value that is not a number; leave it out";
      if (!(T->linear() * T->linear().transpose()).isIdentity(1e-3) || T->linear().determinant() < 0)
        return "pair " + std::to_string(i) + " holds a rotation that is not one; check its quaternion";
    }
    for (int j = 0; j < i; ++j) {
      const Pose motion = pairs[j].T_base_tool.inverse() * pairs[i].T_base_tool;
      if (motion.translation().norm() < limits.repeat_translation &&
          rotation_vector(motion.linear()).norm() < limits.repeat_rotation)
        return "pairs " + std::to_string(j) + " and " + std::to_string(i) +
               " show the same robot pose; move the arm between samples";
    }
  }
  if (count < limits.min_pairs)
    return "only " + std::to_string(count) + " pairs; at least " + std::to_string(limits.min_pairs) +
           " are needed";
  const RotationDiversity diversity = rotation_diversity(pairs);
  if (diversity.largest < limits.min_rotation)
    return text("too little rotation: %.1f deg between the farthest poses, %.1f deg needed",
                diversity.largest / kDegree, limits.min_rotation / kDegree);
  if (diversity.axis_spread < limits.min_axis_spread)
    return text("all poses turn about one axis (spread %.1f deg, %.1f deg needed); tilt the target too",
                diversity.axis_spread / kDegree, limits.min_axis_spread / kDegree);
  return {};
}

Pose mean_tool_target(const std::vector<PosePair>& pairs, const Pose& T_base_camera) {
  Eigen::Matrix4d outer = Eigen::Matrix4d::Zero();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();
  for (const auto& pair : pairs) {
    const Pose Y = pair.T_base_tool.inverse() * T_base_camera * pair.T_camera_target;
    const Eigen::Vector4d q = Eigen::Quaterniond(Y.linear()).coeffs();
    outer += q * q.transpose();  // the mean quaternion is the principal axis, whatever the signs
    translation += Y.translation();
  }
  Pose mean = Pose::Identity();
  mean.linear() = Eigen::Quaterniond(Eigen::Vector4d(
                      Eigen::SelfAdjointEigenSolver<Eigen::Matrix4d>(outer).eigenvectors().col(3)))
                      .toRotationMatrix();
  mean.translation() = translation / static_cast<double>(pairs.size());
  return mean;
}

HandEyeResult evaluate(const std::vector<PosePair>& pairs, const Pose& T_base_camera,
                       const Pose& T_tool_target) {
  HandEyeResult result;
  result.success = true;
  result.T_base_camera = T_base_camera;
  result.T_tool_target = T_tool_target;
  result.covariance.setZero();
  for (const auto& pair : pairs) {
    const Vector6 r = residual(discrepancy(pair, T_base_camera, T_tool_target));
    result.translation_residuals.push_back(r.head<3>().norm());
    result.rotation_residuals.push_back(r.tail<3>().norm());
    result.rms_translation += r.head<3>().squaredNorm() / pairs.size();
    result.rms_rotation += r.tail<3>().squaredNorm() / pairs.size();
    result.weights.push_back(1.0);
  }
  result.rms_translation = std::sqrt(result.rms_translation);
  result.rms_rotation = std::sqrt(result.rms_rotation);
  return result;
}

HandEyeResult refine(const std::vector<PosePair>& pairs, const Pose& T_base_camera_start,
                     const PoseNoise& noise, const Limits& limits) {
  HandEyeResult result;
  result.reason = refuse_pairs(pairs, limits);
  if (!result.reason.empty()) return result;

  Pose X = T_base_camera_start, Y = mean_tool_target(pairs, X);
  Vector6 inverse_sigma;
  inverse_sigma << Eigen::Vector3d::Constant(1.0 / noise.translation),
      Eigen::Vector3d::Constant(1.0 / noise.rotation);

  // Iteratively reweighted Gauss-Newton. A pair within twice the median distance has its whole say,
  // one beyond four times has none; Tukey's biweight leads from one to the other. Six Gaussian
  // numbers lie beyond twice their median one time in 600, so good pairs lose nothing; and one bad
  // pair in three cannot move the median.
  const auto count = pairs.size();
  std::vector<double> weights(count, 1.0);
  Eigen::Matrix<double, 12, 12> H;
  bool converged = false;
  constexpr int kMaxIterations = 100;
  constexpr int kScaleIterations = 8;  // then the scale stays: it would chase its own weights
  double scale = 0.0;
  constexpr double kTrusted = 2.0, kRefused = 4.0;  // medians
  for (int iteration = 0; iteration < kMaxIterations && !converged; ++iteration) {
    result.iterations = iteration + 1;
    std::vector<Vector6> r(count);
    std::vector<double> distance(count);
    std::vector<Pose> M(count);
    for (std::size_t i = 0; i < count; ++i) {
      M[i] = discrepancy(pairs[i], X, Y);
      r[i] = inverse_sigma.cwiseProduct(residual(M[i]));
      distance[i] = r[i].norm() / std::sqrt(6.0);
    }
    // The first steps, from a rough start, take every pair but bound its pull (Huber).
    if (iteration < kScaleIterations) scale = std::max(median(distance), 1e-6);
    for (std::size_t i = 0; i < count; ++i) {
      const double d = distance[i] / scale;
      if (iteration < 3) {
        weights[i] = d <= 1.345 ? 1.0 : 1.345 / d;
      } else {
        const double u = std::max(d - kTrusted, 0.0) / (kRefused - kTrusted);
        weights[i] = u < 1.0 ? (1 - u * u) * (1 - u * u) : 0.0;
      }
    }
    H.setZero();
    Eigen::Matrix<double, 12, 1> g = Eigen::Matrix<double, 12, 1>::Zero();
    for (std::size_t i = 0; i < count; ++i) {
      // A step of X moves the discrepancy from the left, carried into the target's frame.
      const Pose S = pairs[i].T_camera_target.inverse();
      Eigen::Matrix<double, 6, 6> adjoint = Eigen::Matrix<double, 6, 6>::Zero();
      adjoint.topLeftCorner<3, 3>() = S.linear();
      adjoint.topRightCorner<3, 3>() = cross(S.translation()) * S.linear();
      adjoint.bottomRightCorner<3, 3>() = S.linear();
      Eigen::Matrix<double, 6, 6> left = Eigen::Matrix<double, 6, 6>::Zero();
      left.topLeftCorner<3, 3>().setIdentity();
      left.topRightCorner<3, 3>() = -cross(M[i].translation());
      left.bottomRightCorner<3, 3>() = M[i].linear().transpose();
      Eigen::Matrix<double, 6, 12> J;
      J.leftCols<6>() = -left * adjoint;
      J.rightCols<6>().setZero();
      J.block<3, 3>(0, 6) = M[i].linear();
      J.block<3, 3>(3, 9).setIdentity();
      J = inverse_sigma.asDiagonal() * J;
      H += weights[i] * J.transpose() * J;
      g += weights[i] * J.transpose() * r[i];
    }
    const Eigen::LDLT<Eigen::Matrix<double, 12, 12>> ldlt(H);
    const Eigen::Matrix<double, 12, 1> step = -ldlt.solve(g);
    if (ldlt.info() != Eigen::Success || !step.allFinite()) {
      result.reason = "the equations have no unique solution; spread the poses more";
      return result;
    }
    X = moved(X, step.head<6>());
    Y = moved(Y, step.tail<6>());
    converged = iteration >= 4 && step.norm() < 1e-8;
  }
  if (!converged) {
    result.reason = "no convergence after " + std::to_string(kMaxIterations) +
                    " iterations; the pairs contradict each other or the start is far off";
    return result;
  }

  const int iterations = result.iterations;
  result = evaluate(pairs, X, Y);
  result.success = false;
  result.iterations = iterations;
  result.weights = weights;
  double total = 0, t2 = 0, r2 = 0;
  for (std::size_t i = 0; i < count; ++i) {
    total += weights[i];
    t2 += weights[i] * std::pow(result.translation_residuals[i], 2);
    r2 += weights[i] * std::pow(result.rotation_residuals[i], 2);
  }
  const auto trusted = std::count_if(weights.begin(), weights.end(), [](double w) { return w > 0.1; });
  if (2 * trusted <= static_cast<long>(count)) {
    result.reason = "the pairs contradict each other: only " + std::to_string(trusted) + " of " +
                    std::to_string(count) + " agree; check that the target sits firmly";
    return result;
  }
  result.rms_translation = std::sqrt(t2 / total);
  result.rms_rotation = std::sqrt(r2 / total);
  if (result.rms_translation > limits.max_rms_translation ||
      result.rms_rotation > limits.max_rms_rotation) {
    result.reason = text("residual too high: %.1f mm, %.2f deg", result.rms_translation * 1e3,
                         result.rms_rotation / kDegree) +
                    "; are the robot poses base -> tool and the target poses camera -> target?";
    return result;
  }
  // Scale the information by the noise that is really there.
  const double chi2 = t2 / std::pow(noise.translation, 2) + r2 / std::pow(noise.rotation, 2);
  const double freedom = std::max(1.0, 6.0 * total - 12.0);
  result.covariance = (H.inverse() * (chi2 / freedom)).topLeftCorner<6, 6>();
  result.success = true;
  return result;
}

std::pair<double, double> axxb_rms(const std::vector<PosePair>& pairs, const Pose& X) {
  double translation = 0, rotation = 0;
  int motions = 0;
  for (std::size_t i = 0; i < pairs.size(); ++i)
    for (std::size_t j = i + 1; j < pairs.size(); ++j) {
      const Pose A = pairs[j].T_base_tool * pairs[i].T_base_tool.inverse();
      const Pose B = pairs[j].T_camera_target * pairs[i].T_camera_target.inverse();
      const Vector6 r = residual((A * X).inverse() * X * B);
      translation += r.head<3>().squaredNorm();
      rotation += r.tail<3>().squaredNorm();
      ++motions;
    }
  if (motions == 0) return {0.0, 0.0};
  return {std::sqrt(translation / motions), std::sqrt(rotation / motions)};
}

std::pair<double, double> leave_one_out_spread(const std::vector<PosePair>& pairs,
                                               const HandEyeResult& result, const PoseNoise& noise,
                                               const Limits& limits) {
  return leave_one_out(pairs, result.T_base_camera, [&](const std::vector<PosePair>& rest) {
    return refine(rest, result.T_base_camera, noise, limits);
  });
}

}  // namespace iwgnet_grasp::calibration
