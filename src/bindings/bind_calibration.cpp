#include <pybind11/stl.h>

#include "iwgnet_grasp/calibration/hand_eye.h"
#include "iwgnet_grasp/calibration/reprojection.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;
using namespace calibration;
using Matrices = std::vector<Eigen::Matrix4d>;
using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

namespace {

// Unchecked: refuse_pairs() says what is wrong with a pair.
Pose as_pose(const Eigen::Matrix4d& matrix) {
  Pose T = Pose::Identity();
  T.matrix().topRows<3>() = matrix.topRows<3>();
  return T;
}

std::vector<PosePair> pairs_of(const Matrices& T_base_tool, const Matrices& T_camera_target) {
  if (T_base_tool.size() != T_camera_target.size())
    throw Error(std::to_string(T_base_tool.size()) + " T_base_tool but " +
                std::to_string(T_camera_target.size()) + " T_camera_target; give one of each a pose");
  std::vector<PosePair> pairs;
  for (std::size_t i = 0; i < T_base_tool.size(); ++i)
    pairs.push_back({as_pose(T_base_tool[i]), as_pose(T_camera_target[i])});
  return pairs;
}

TargetView view_of(const Eigen::Matrix4d& T_base_tool, const Rows& corners, const Rows& pixels) {
  if (corners.cols() != 3 || pixels.cols() != 2 || corners.rows() != pixels.rows())
    throw Error("a view needs corners (n, 3) in m and as many pixels (n, 2)");
  TargetView view{to_pose(T_base_tool, "T_base_tool"), {}, {}};
  for (int i = 0; i < corners.rows(); ++i) {
    view.corners.emplace_back(corners.row(i));
    view.pixels.emplace_back(pixels.row(i));
  }
  return view;
}

}  // namespace

void bind_calibration(py::module_& m) {
  py::class_<PoseNoise>(m, "PoseNoise", "Standard deviations of measured target poses, m and rad.")
      .def(py::init([](double translation, double rotation) {
             return PoseNoise{translation, rotation};
           }),
           "translation"_a = PoseNoise().translation, "rotation"_a = PoseNoise().rotation);
  py::class_<HandEyeResult>(m, "HandEyeResult")
      .def_readonly("success", &HandEyeResult::success)
      .def_readonly("reason", &HandEyeResult::reason, "why not")
      .def_property_readonly("T_base_camera",
                             [](const HandEyeResult& r) { return to_matrix(r.T_base_camera); })
      .def_property_readonly("T_tool_target",
                             [](const HandEyeResult& r) { return to_matrix(r.T_tool_target); })
      .def_readonly("rms_translation", &HandEyeResult::rms_translation, "m, weighted")
      .def_readonly("rms_rotation", &HandEyeResult::rms_rotation, "rad, weighted")
      .def_readonly("translation_residuals", &HandEyeResult::translation_residuals, "m, one a pair")
      .def_readonly("rotation_residuals", &HandEyeResult::rotation_residuals, "rad, one a pair")
      .def_readonly("weights", &HandEyeResult::weights, "1 trusted .. 0 outlier, one a pair")
      .def_readonly("covariance", &HandEyeResult::covariance, "(6, 6), m and rad");
  py::class_<ReprojectionResult>(m, "ReprojectionResult")
      .def_readonly("success", &ReprojectionResult::success)
      .def_readonly("reason", &ReprojectionResult::reason, "why not")
      .def_property_readonly("T_base_camera",
                             [](const ReprojectionResult& r) { return to_matrix(r.T_base_camera); })
      .def_property_readonly("T_tool_target",
                             [](const ReprojectionResult& r) { return to_matrix(r.T_tool_target); })
      .def_readonly("rms_px", &ReprojectionResult::rms_px)
      .def_readonly("view_rms_px", &ReprojectionResult::view_rms_px, "one a view")
      .def_readonly("weights", &ReprojectionResult::weights, "1 trusted .. 0 outlier, one a view")
      .def_readonly("covariance", &ReprojectionResult::covariance, "(6, 6), m and rad");
  py::class_<TargetView>(m, "TargetView", "One image of the target.")
      .def(py::init(&view_of), "T_base_tool"_a, "corners"_a, "pixels"_a,
           "corners (n, 3) m in the target frame, pixels (n, 2).");

  m.def(
      "rotation_diversity",
      [](const Matrices& T_base_tool) {
        const auto diversity = rotation_diversity(pairs_of(T_base_tool, T_base_tool));
        return std::pair(diversity.largest, diversity.axis_spread);
      },
      "T_base_tool"_a, "(largest rotation between two poses, spread of the axes), rad");
  m.def(
      "refuse_pairs",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target) {
        return refuse_pairs(pairs_of(T_base_tool, T_camera_target));
      },
      "T_base_tool"_a, "T_camera_target"_a, "Why the pairs cannot be solved; '' when they can.");
  m.def(
      "refine_hand_eye",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target, const Eigen::Matrix4d& start,
         const PoseNoise& noise) {
        return refine(pairs_of(T_base_tool, T_camera_target), to_pose(start, "start"), noise);
      },
      "T_base_tool"_a, "T_camera_target"_a, "start"_a, "noise"_a = PoseNoise(),
      "Maximum likelihood over all pairs from a start near T_base_camera.");
  m.def(
      "axxb_rms",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target, const Eigen::Matrix4d& X) {
        return axxb_rms(pairs_of(T_base_tool, T_camera_target), to_pose(X, "T_base_camera"));
      },
      "T_base_tool"_a, "T_camera_target"_a, "T_base_camera"_a, "RMS of AX = XB, (m, rad).");
  m.def(
      "evaluate_hand_eye",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target, const Eigen::Matrix4d& X,
         const Eigen::Matrix4d& Y) {
        return evaluate(pairs_of(T_base_tool, T_camera_target), to_pose(X, "T_base_camera"),
                        to_pose(Y, "T_tool_target"));
      },
      "T_base_tool"_a, "T_camera_target"_a, "T_base_camera"_a, "T_tool_target"_a,
      "Residuals for given transforms.");
  m.def(
      "leave_one_out_spread",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target, const HandEyeResult& result,
         const PoseNoise& noise) {
        return leave_one_out_spread(pairs_of(T_base_tool, T_camera_target), result, noise);
      },
      "T_base_tool"_a, "T_camera_target"_a, "result"_a, "noise"_a = PoseNoise(),
      "Largest change of T_base_camera without one pair, (m, rad).");
  m.def(
      "mean_tool_target",
      [](const Matrices& T_base_tool, const Matrices& T_camera_target, const Eigen::Matrix4d& X) {
        return to_matrix(
            mean_tool_target(pairs_of(T_base_tool, T_camera_target), to_pose(X, "T_base_camera")));
      },
      "T_base_tool"_a, "T_camera_target"_a, "T_base_camera"_a, "T_tool_target (4, 4)");

  m.def(
      "refine_reprojection",
      [](const std::vector<TargetView>& views, const PinholeIntrinsics& camera,
         const Eigen::Matrix4d& X, const Eigen::Matrix4d& Y) {
        return refine_reprojection(views, camera, to_pose(X, "T_base_camera"),
                                   to_pose(Y, "T_tool_target"));
      },
      "views"_a, "camera"_a, "T_base_camera"_a, "T_tool_target"_a,
      "Maximum likelihood over all corners of all views from a start near the solution.");
  m.def(
      "leave_one_view_out_spread",
      [](const std::vector<TargetView>& views, const PinholeIntrinsics& camera,
         const ReprojectionResult& result) { return leave_one_out_spread(views, camera, result); },
      "views"_a, "camera"_a, "result"_a, "Largest change without one view, (m, rad).");
  m.def(
      "reprojection_residuals",
      [](const TargetView& view, const PinholeIntrinsics& camera, const Eigen::Matrix4d& X,
         const Eigen::Matrix4d& Y) {
        const auto residuals = reprojection_residuals(view, camera, to_pose(X, "T_base_camera"),
                                                      to_pose(Y, "T_tool_target"));
        Rows rows(residuals.size(), 2);
        for (std::size_t i = 0; i < residuals.size(); ++i) rows.row(i) = residuals[i];
        return rows;
      },
      "view"_a, "camera"_a, "T_base_camera"_a, "T_tool_target"_a, "(n, 2) px, seen - predicted");

  m.def(
      "load_camera_pose", [](const std::string& path) { return to_matrix(load_camera_pose(path)); },
      "path"_a, "T_base_color (4, 4) of a camera.yaml or a calibration's result.");
}

}  // namespace iwgnet_grasp::bindings
