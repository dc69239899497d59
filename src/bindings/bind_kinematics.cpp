#include <pybind11/stl.h>

#include "iwgnet_grasp/kinematics/kdl_chain.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;

void bind_kinematics(py::module_& m) {
  m.attr("JOINT_NAMES") = std::vector<std::string>(kJointNames, kJointNames + kJoints);
  m.def(
      "forward", [](const JointVector& q) { return to_matrix(kinematics::forward(q)); }, "q"_a,
      "T_base_tool0 (4, 4) of the UR5 at q (6,) rad; Eq. 1.");
  m.def(
      "inverse",
      [](const Eigen::Matrix4d& T, double q6_singular) {
        const auto found = kinematics::inverse(to_pose(T, "T_base_tool0"), q6_singular);
        Eigen::Matrix<double, Eigen::Dynamic, 6, Eigen::RowMajor> q(found.count, 6);
        for (int i = 0; i < found.count; ++i) q.row(i) = found.q[i];
        return q;
      },
      "T_base_tool0"_a, "q6_singular"_a = 0.0,
      "All solutions (n, 6) rad of the UR5, n <= 8, each in (-pi, pi]; closed form, Eq. 2.");
  m.def(
      "jacobian",
      [](const JointVector& q) { return kinematics::jacobian(q); }, "q"_a,
      "Geometric Jacobian (6, 6) of tool0 in base_link at q (6,) rad: rows 0-2 linear, 3-5 angular.");
  m.def("gap_from_joint", &kinematics::gap_from_joint, "finger_joint"_a,
        "Gap between the 2F-85's pads, m, at finger_joint rad.");
  m.def("joint_from_gap", &kinematics::joint_from_gap, "gap"_a,
        "finger_joint rad at a gap in m, clamped to [0, 0.8].");
  m.def("pad_center_height", &kinematics::pad_center_height, "gap"_a,
        "Height in m of the pads' centres over tool0 (along its z) at a gap in m.");
  m.def(
      "T_tool0_tcp", [](double gap) { return to_matrix(kinematics::T_tool0_tcp(gap)); }, "gap"_a,
      "T_tool0_tcp (4, 4): tool centre point at a gap in m.");

  py::class_<kinematics::KdlChain>(m, "KdlChain", "Kinematics of any URDF chain by KDL.")
      .def(py::init<const std::string&, const std::string&, const std::string&>(), "urdf_xml"_a,
           "root"_a, "tip"_a)
      .def_property_readonly("joint_names", &kinematics::KdlChain::joint_names)
      .def_property_readonly("lower", &kinematics::KdlChain::lower, "rad")
      .def_property_readonly("upper", &kinematics::KdlChain::upper, "rad")
      .def(
          "forward",
          [](const kinematics::KdlChain& chain, const Eigen::VectorXd& q) {
            return to_matrix(chain.forward(q));
          },
          "q"_a, "T_root_tip (4, 4) at q (n,) rad.")
      .def(
          "inverse",
          [](const kinematics::KdlChain& chain, const Eigen::Matrix4d& T,
             const Eigen::VectorXd& seed, int restarts) {
            return chain.inverse(to_pose(T, "T_root_tip"), seed, restarts);
          },
          "T_root_tip"_a, "seed"_a, "restarts"_a = 50,
          "A solution (n,) rad within 1e-6, or None.");
}

}  // namespace iwgnet_grasp::bindings
