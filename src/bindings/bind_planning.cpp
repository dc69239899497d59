#include <pybind11/stl.h>

#include "iwgnet_grasp/motion/pick_and_place.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;
using motion::CollisionWorld;
using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

namespace {

struct TimedPath {  // opaque to Python but for its columns
  motion::Trajectory points;

  Rows column(JointVector motion::TrajectoryPoint::*member) const {
    Rows rows(points.size(), kJoints);
    for (std::size_t i = 0; i < points.size(); ++i) rows.row(i) = points[i].*member;
    return rows;
  }
};

}  // namespace

void bind_planning(py::module_& m) {
  py::class_<CollisionWorld>(m, "CollisionWorld", "What the arm must not touch.")
      .def(py::init<const CellConfig&>(), "cell"_a)
      .def("set_gripper_gap", &CollisionWorld::set_gripper_gap, "gap"_a, "m")
      .def(
          "set_attached",
          [](CollisionWorld& world, const std::vector<std::pair<Eigen::Vector3d, Eigen::Vector3d>>&
                                        segments, double radius) {
            std::vector<motion::AttachedPart> pieces;
            for (const auto& [a, b] : segments) pieces.push_back({a, b, radius});
            world.set_attached(pieces);
          },
          "segments"_a, "radius"_a,
          "What the gripper holds, as capsules: [(a, b)] (3,) m in the TCP frame of the present gap.")
      .def("collides", &CollisionWorld::collides, "q"_a)
      .def("describe", &CollisionWorld::describe, "q"_a,
           "What touches what at q (6,) rad; '' when free.")
      .def(
          "spheres",
          [](const CollisionWorld& world, const JointVector& q) {
            Rows rows(0, 4);
            for (const auto& s : world.spheres(q)) {
              if (s.body == CollisionWorld::kHeldPart) continue;
              rows.conservativeResize(rows.rows() + 1, 4);
              rows.row(rows.rows() - 1) << s.center.transpose(), s.radius;
            }
            return rows;
          },
          "q"_a, "(n, 4): centre in base_link and radius, m, of the arm and the gripper");

  py::class_<TimedPath>(m, "Trajectory", "A timed joint trajectory; rests at both ends.")
      .def_property_readonly("times",
                             [](const TimedPath& t) {
                               Eigen::VectorXd times(t.points.size());
                               for (std::size_t i = 0; i < t.points.size(); ++i)
                                 times[i] = t.points[i].time;
                               return times;
                             })
      .def_property_readonly(
          "q", [](const TimedPath& t) { return t.column(&motion::TrajectoryPoint::q); }, "(n, 6)")
      .def_property_readonly(
          "qd", [](const TimedPath& t) { return t.column(&motion::TrajectoryPoint::qd); }, "(n, 6)");

  m.def(
      "plan_motion",
      [](const CollisionWorld& world, const JointVector& from, const JointVector& to,
         const motion::PickPlaceConfig& config, double max_velocity, double max_acceleration) {
        const auto plan = motion::plan(world, from, to, config.planner);
        if (!plan.success) throw Error("no motion to the pose: " + plan.message);
        const motion::JointLimits limits{JointVector::Constant(max_velocity),
                                         JointVector::Constant(max_acceleration)};
        // Corners are stops, so that the path is the one that was checked.
        return TimedPath{motion::time_parametrize(plan.path, limits, 0.0)};
      },
      "world"_a, "start"_a, "goal"_a, "config"_a, "max_velocity"_a, "max_acceleration"_a,
      "A collision-free Trajectory within rad/s and rad/s^2. CoreError when there is none.");
  m.def(
      "execute",
      [](motion::Robot& robot, const TimedPath& trajectory) {
        py::gil_scoped_release release;
        const auto result = robot.execute(trajectory.points);
        if (!result.success) throw Error("the arm did not follow: " + result.message);
      },
      "robot"_a, "trajectory"_a, "Blocks until the arm has come to rest. CoreError when it failed.");
}

}  // namespace iwgnet_grasp::bindings
