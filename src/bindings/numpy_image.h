// numpy arrays as cv::Mat and back, without a copy where memory allows it.
#pragma once

#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <opencv2/core.hpp>
#include <string>

#include "iwgnet_grasp/core/types.h"

namespace iwgnet_grasp::bindings {

namespace py = pybind11;

// (H, W) or (H, W, C) array that shares the image's memory and keeps it alive.
template <typename T>
py::array_t<T> to_numpy(const cv::Mat& image) {
  auto* kept = new cv::Mat(image);
  const py::capsule owner(kept, [](void* p) { delete static_cast<cv::Mat*>(p); });
  const auto rows = static_cast<py::ssize_t>(image.rows);
  const auto columns = static_cast<py::ssize_t>(image.cols);
  const auto step = static_cast<py::ssize_t>(image.step[0]);
  const auto size = static_cast<py::ssize_t>(sizeof(T));
  if (image.channels() == 1)
    return py::array_t<T>({rows, columns}, {step, size}, image.ptr<T>(), owner);
  const auto channels = static_cast<py::ssize_t>(image.channels());
  return py::array_t<T>({rows, columns, channels}, {step, channels * size, size}, image.ptr<T>(),
                        owner);
}

using FloatImage = py::array_t<float, py::array::c_style | py::array::forcecast>;

// View of a (H, W) float32 array; valid while the array is.
inline cv::Mat to_mat(const FloatImage& image, const std::string& name) {
  if (image.ndim() != 2)
    throw Error(name + ": expected an array of shape (height, width), got " +
                std::to_string(image.ndim()) + " dimensions");
  return cv::Mat(static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)), CV_32FC1,
                 const_cast<float*>(image.data()));
}

inline Eigen::Matrix4d to_matrix(const Pose& T) { return T.matrix(); }

// Throws Error unless the matrix is a rigid transform.
inline Pose to_pose(const Eigen::Matrix4d& matrix, const std::string& name) {
  const Eigen::Matrix3d R = matrix.topLeftCorner<3, 3>();
  if (!matrix.allFinite() || !(R * R.transpose()).isIdentity(1e-4) || R.determinant() < 0 ||
      (matrix.row(3) - Eigen::RowVector4d(0, 0, 0, 1)).norm() > 1e-6)
    throw Error(name + ": is not a rigid transform (4 x 4, rotation and translation)");
  Pose T = Pose::Identity();
  T.linear() = R;
  T.translation() = matrix.topRightCorner<3, 1>();
  return T;
}

// One file a room; each adds its functions and classes to the module.
void bind_kinematics(py::module_& m);
void bind_cell_config(py::module_& m);
void bind_sensing(py::module_& m);
void bind_grasping(py::module_& m);
void bind_physics(py::module_& m);
void bind_motion(py::module_& m);
void bind_planning(py::module_& m);
void bind_calibration(py::module_& m);

}  // namespace iwgnet_grasp::bindings
