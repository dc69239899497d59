#include "iwgnet_grasp/kinematics/ur5.h"

#include <cmath>

namespace iwgnet_grasp::kinematics {
namespace {

constexpr double kHalfPi = M_PI / 2;
// Below this sine of joint 5 the axes of joints 4 and 6 count as parallel.
constexpr double kWristSingular = 1e-10;
// Squared lengths (m^2) this far beyond the reach are rounding, not unreachable poses.
constexpr double kRounding = 1e-12;

double wrap(double angle) {
  if (angle > M_PI) return angle - 2 * M_PI;
  if (angle <= -M_PI) return angle + 2 * M_PI;
  return angle;
}

// T * dh_transform(row, theta) written out: the alphas of the UR5 are 0 or +-pi/2.
void advance(Pose& T, const DhRow& row, double theta) {
  const double c = std::cos(theta), s = std::sin(theta);
  const Eigen::Vector3d x = T.matrix().block<3, 1>(0, 0), y = T.matrix().block<3, 1>(0, 1),
                        z = T.matrix().block<3, 1>(0, 2);
  const Eigen::Vector3d x_new = c * x + s * y, y_new = c * y - s * x;
  T.matrix().block<3, 1>(0, 3) += row.a * x_new + row.d * z;
  T.matrix().block<3, 1>(0, 0) = x_new;
  if (row.alpha == 0.0) {
    T.matrix().block<3, 1>(0, 1) = y_new;
  } else {
    const double sign = row.alpha > 0 ? 1.0 : -1.0;
    T.matrix().block<3, 1>(0, 1) = sign * z;
    T.matrix().block<3, 1>(0, 2) = -sign * y_new;
  }
}

// base_link is the DH base turned by pi about z.
Pose dh_base() {
  Pose T = Pose::Identity();
  T.matrix()(0, 0) = T.matrix()(1, 1) = -1.0;
  return T;
}

}  // namespace

const std::array<DhRow, kJoints> kUr5Dh = {{{0.089159, 0.0, kHalfPi},
                                            {0.0, -0.425, 0.0},
                                            {0.0, -0.39225, 0.0},
                                            {0.10915, 0.0, kHalfPi},
                                            {0.09465, 0.0, -kHalfPi},
                                            {0.0823, 0.0, 0.0}}};

Eigen::Matrix4d dh_transform(const DhRow& row, double theta) {
  const double ct = std::cos(theta), st = std::sin(theta);
  const double ca = std::cos(row.alpha), sa = std::sin(row.alpha);
  Eigen::Matrix4d T;
  T << ct, -st * ca, st * sa, row.a * ct,  //
      st, ct * ca, -ct * sa, row.a * st,   //
      0, sa, ca, row.d,                    //
      0, 0, 0, 1;
  return T;
}

std::array<Pose, kJoints> link_frames(const JointVector& q) {
  std::array<Pose, kJoints> frames;
  Pose T = dh_base();
  for (int i = 0; i < kJoints; ++i) {
    advance(T, kUr5Dh[i], q[i]);
    frames[i] = T;
  }
  return frames;
}

Pose forward(const JointVector& q) {
  Pose T = dh_base();
  for (int i = 0; i < kJoints; ++i) advance(T, kUr5Dh[i], q[i]);
  return T;
}

IkSolutions inverse(const Pose& T_base_tool0, double q6_singular) {
  const double d1 = kUr5Dh[0].d, a2 = kUr5Dh[1].a, a3 = kUr5Dh[2].a, d4 = kUr5Dh[3].d,
               d5 = kUr5Dh[4].d, d6 = kUr5Dh[5].d;
  // Columns n, o, a, p of T06 in the DH base frame.
  const auto turned = [&](int column) {
    const auto& m = T_base_tool0.matrix();
    return Eigen::Vector3d(-m(0, column), -m(1, column), m(2, column));
  };
  const Eigen::Vector3d n = turned(0), o = turned(1), a = turned(2), p = turned(3);

  IkSolutions solutions;
  // Joint 1: the wrist centre lies d4 beside the plane of the arm, X sin q1 - Y cos q1 = d4.
  const double X = p.x() - d6 * a.x(), Y = p.y() - d6 * a.y();
  double root = X * X + Y * Y - d4 * d4;
  if (!(root >= -kRounding)) return solutions;
  root = std::sqrt(std::max(root, 0.0));
  const double rho2 = X * X + Y * Y;

  for (int shoulder = 0; shoulder < (root > 0.0 ? 2 : 1); ++shoulder) {
    const double r = shoulder == 0 ? root : -root;
    // q1 = atan2(Y, X) + atan2(d4, r), by its sine and cosine.
    const double s1 = (Y * r + X * d4) / rho2, c1 = (X * r - Y * d4) / rho2;
    const double q1 = std::atan2(s1, c1);
    // The axis z1 = (s1, -c1, 0) in frame 6 is (s5 c6, -s5 s6, c5).
    const double z1n = s1 * n.x() - c1 * n.y(), z1o = s1 * o.x() - c1 * o.y(),
                 z1a = s1 * a.x() - c1 * a.y();
    const double sin5 = std::sqrt(z1n * z1n + z1o * z1o);
    const bool singular = sin5 < kWristSingular;

    for (int wrist = 0; wrist < (singular ? 1 : 2); ++wrist) {
      const double sign = wrist == 0 ? 1.0 : -1.0;
      double q5, q6, s6, c6;
      if (singular) {
        q5 = z1a > 0 ? 0.0 : M_PI;
        q6 = wrap(std::remainder(q6_singular, 2 * M_PI));
        s6 = std::sin(q6);
        c6 = std::cos(q6);
      } else {
        q5 = std::atan2(sign * sin5, z1a);
        s6 = -sign * z1o / sin5;
        c6 = sign * z1n / sin5;
        q6 = std::atan2(s6, c6);
      }
      // The axis of joint 5 gives q2 + q3 + q4 and frame 4's origin; both in the arm's plane.
      const Eigen::Vector3d z4 = -(s6 * n + c6 * o);
      const Eigen::Vector3d o4 = p - d6 * a - d5 * z4;
      const double q234 = std::atan2(z4.x() * c1 + z4.y() * s1, -z4.z());
      const double x = o4.x() * c1 + o4.y() * s1, y = o4.z() - d1;
      // Two links a2, a3 in the plane.
      const double cos3 = (x * x + y * y - a2 * a2 - a3 * a3) / (2 * a2 * a3);
      double sin3 = 1.0 - cos3 * cos3;
      if (sin3 < -kRounding) continue;
      sin3 = std::sqrt(std::max(sin3, 0.0));
      const double q3 = std::atan2(sin3, cos3), direction = std::atan2(y, x),
                   bend = std::atan2(a3 * sin3, a2 + a3 * cos3);
      for (int elbow = 0; elbow < (sin3 > 0.0 ? 2 : 1); ++elbow) {
        const double up = elbow == 0 ? 1.0 : -1.0;
        const double q2 = wrap(direction - up * bend);
        JointVector& q = solutions.q[solutions.count++];
        q << q1, q2, up * q3, wrap(wrap(q234 - q2) - up * q3), q5, q6;
      }
    }
  }
  return solutions;
}

JointVector nearest_turn(const JointVector& q, const JointVector& reference) {
  JointVector result;
  for (int i = 0; i < kJoints; ++i) {
    double turned = q[i] + 2 * M_PI * std::round((reference[i] - q[i]) / (2 * M_PI));
    if (turned > 2 * M_PI) turned -= 2 * M_PI;
    if (turned < -2 * M_PI) turned += 2 * M_PI;
    result[i] = turned;
  }
  return result;
}

Eigen::Matrix<double, 6, 6> jacobian(const JointVector& q) {
  const auto frames = link_frames(q);
  const Eigen::Vector3d tool = frames[kJoints - 1].translation();
  Eigen::Matrix<double, 6, 6> J;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ(), origin = Eigen::Vector3d::Zero();
  for (int i = 0; i < kJoints; ++i) {
    J.block<3, 1>(0, i) = axis.cross(tool - origin);
    J.block<3, 1>(3, i) = axis;
    axis = frames[i].linear().col(2);
    origin = frames[i].translation();
  }
  return J;
}

}  // namespace iwgnet_grasp::kinematics
