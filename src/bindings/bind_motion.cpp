#include <pybind11/functional.h>
#include <pybind11/stl.h>

#include "iwgnet_grasp/motion/pick_and_place.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;
using motion::PickAndPlace;
using motion::PickPlaceConfig;
using motion::PickReason;
using motion::PickRequest;
using motion::PickResult;

void bind_motion(py::module_& m) {
  py::enum_<PickReason>(m, "PickReason", "Values of PickPlace.action.")
      .value("SUCCEEDED", PickReason::kSucceeded)
      .value("UNKNOWN_GRASP", PickReason::kUnknownGrasp)
      .value("INFEASIBLE", PickReason::kInfeasible)
      .value("UNREACHABLE", PickReason::kUnreachable)
      .value("NO_PLAN", PickReason::kNoPlan)
      .value("EXECUTION_FAILED", PickReason::kExecutionFailed)
      .value("MISSED", PickReason::kMissed)
      .value("LOST", PickReason::kLost);
  py::class_<PickResult>(m, "PickResult")
      .def_readonly("reason", &PickResult::reason)
      .def_readonly("message", &PickResult::message)
      .def_readonly("planning_seconds", &PickResult::planning_seconds, "wall time");
  py::class_<motion::Robot>(m, "Robot", "What pick and place drives; see SimulatedRobot.");
  py::class_<PickPlaceConfig>(m, "PickPlaceConfig", "config/motion.yaml")
      .def_property(
          "seed", [](const PickPlaceConfig& c) { return c.planner.seed; },
          [](PickPlaceConfig& c, std::uint64_t seed) { c.planner.seed = seed; },
          "of the path planner")
      .def_readwrite("grip_force", &PickPlaceConfig::grip_force, "N");
  m.def("load_pick_place_config", &motion::load_pick_place_config, "config_dir"_a);
  py::class_<PickAndPlace>(m, "PickAndPlace",
                           "Approach, grasp, lift, transfer, release, back to observing.")
      .def(py::init<const CellConfig&, const PickPlaceConfig&>(), "cell"_a, "config"_a)
      .def("set_heights", &PickAndPlace::set_heights, "heights"_a,
           "Heights of what lies on the table, from the scene that the grasp belongs to.")
      .def(
          "run",
          [](PickAndPlace& self, motion::Robot& robot, const grasping::GraspPose& grasp,
             const Eigen::Vector3d& centroid, int tray_slot,
             const std::function<bool(const std::string&)>& phase) {
            const PickRequest request{grasp, centroid, tray_slot};
            py::gil_scoped_release release;
            return self.run(robot, request, phase);
          },
          "robot"_a, "grasp"_a, "centroid"_a, "tray_slot"_a, "phase"_a = py::none(),
          "One pick; blocks, without the GIL. centroid: (3,) m in base_link. phase(name) -> bool is "
          "told each phase as it begins and cancels by returning False.")
      .def(
          "push",
          [](PickAndPlace& self, motion::Robot& robot, const std::vector<Eigen::Vector3d>& objects) {
            py::gil_scoped_release release;
            return self.push(robot, objects);
          },
          "robot"_a, "objects"_a,
          "Pushes one of the objects, given by their centroids (3,) m in base_link; blocks, without "
          "the GIL.")
      .def(
          "observe",
          [](PickAndPlace& self, motion::Robot& robot) {
            py::gil_scoped_release release;
            return self.observe(robot);
          },
          "robot"_a, "Brings the arm to the observing pose; blocks, without the GIL.");
}

}  // namespace iwgnet_grasp::bindings
