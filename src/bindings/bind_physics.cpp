#include <pybind11/functional.h>
#include <pybind11/stl.h>

#include <map>
#include <memory>

#include "iwgnet_grasp/grasping/antipodal.h"
#include "iwgnet_grasp/physics/simulated_cell.h"
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

using namespace py::literals;
using physics::Arrangement;
using physics::SceneSpec;
using physics::SimulatedCell;
using physics::SimulatedRobot;

namespace {

// Images are made without the GIL: a renderer and its cell belong to one thread at a time.
template <typename T>
py::array_t<T> without_gil(SimulatedCell& cell, cv::Mat (SimulatedCell::*image)()) {
  cv::Mat result;
  {
    py::gil_scoped_release release;
    result = (cell.*image)();
  }
  return to_numpy<T>(result);
}

// label_grasps() on simulated scenes; the grasps of a part are found once and kept.
class GraspLabeler {
 public:
  explicit GraspLabeler(const std::string& config_dir)
      : pose_config_(grasping::load_grasp_pose_config(config_dir)),
        config_(grasping::load_antipodal_config(config_dir)) {}

  std::vector<grasping::GraspLabel> label(SimulatedCell& cell, const cv::Mat& depth,
                                          const cv::Mat& mask) {
    std::vector<grasping::ScenePart> parts;
    for (std::size_t i = 0; i < cell.models().size(); ++i) {
      const physics::PartModel& model = cell.models()[i];
      auto& grasps = grasps_[model.name];
      if (!grasps)
        grasps = std::make_unique<grasping::PartGrasps>(grasping::find_antipodal_grasps(
            model.mesh, model.mass, config_, pose_config_.max_opening));
      const int index = static_cast<int>(i);
      parts.push_back({grasps.get(), cell.world().part(index).T_base_part, index});
    }
    for (const physics::Support& support : cell.world().supports())
      parts[support.under].load += support.force;
    const CameraConfig& camera = cell.camera();
    return grasping::label_grasps(parts, depth, mask, camera.color, camera.T_base_color,
                                  cell.config(), pose_config_, config_);
  }

 private:
  grasping::GraspPoseConfig pose_config_;
  grasping::AntipodalConfig config_;
  std::map<std::string, std::unique_ptr<grasping::PartGrasps>> grasps_;
};

}  // namespace

void bind_physics(py::module_& m) {
  m.def("scene_names", &physics::scene_names, "config_dir"_a, "Scenes of config_dir/scenes.yaml.");
  py::enum_<Arrangement>(m, "Arrangement")
      .value("SCATTERED", Arrangement::kScattered, "laid flat with gaps between them")
      .value("STACKED", Arrangement::kStacked, "dropped one after another onto a heap");
  py::class_<SceneSpec>(m, "SceneSpec", "How many parts, and how they come to lie; lengths in m.")
      .def(py::init([](int count, Arrangement arrangement, std::vector<std::string> families,
                       double min_gap, const Eigen::Vector2d& drop_area, double drop_height,
                       double drop_interval, double settle_time) {
             return SceneSpec{"",        count,       arrangement,   std::move(families), min_gap,
                              drop_area, drop_height, drop_interval, settle_time};
           }),
           "count"_a, "arrangement"_a, "families"_a = std::vector<std::string>{},
           "min_gap"_a = 0.0, "drop_area"_a = Eigen::Vector2d(0.16, 0.16), "drop_height"_a = 0.06,
           "drop_interval"_a = SceneSpec().drop_interval, "settle_time"_a = SceneSpec().settle_time)
      .def_readwrite("count", &SceneSpec::count)
      .def_readwrite("arrangement", &SceneSpec::arrangement)
      .def_readwrite("families", &SceneSpec::families);

  py::class_<SimulatedCell>(m, "SimulatedCell",
                            "Physics, controllers, camera and judge of the simulated cell.")
      .def(py::init<const std::string&, const std::string&>(), "package_dir"_a,
           "config_dir"_a = "",
           "package_dir: the checkout; config_dir: its config/ when empty.")
      .def_property_readonly("config", [](const SimulatedCell& c) { return c.config(); })
      .def(
          "load_scene",
          [](SimulatedCell& c, const std::string& scene, std::uint64_t seed) {
            py::gil_scoped_release release;
            return c.load_scene(scene, seed);
          },
          "scene"_a, "seed"_a,
          "Scene by name ('' leaves the table bare); returns the number of parts.")
      .def(
          "build_scene",
          [](SimulatedCell& c, const SceneSpec& spec, std::uint64_t seed) {
            py::gil_scoped_release release;
            return c.load_scene(spec, seed);
          },
          "spec"_a, "seed"_a, "Scene by its description; returns the number of parts.")
      .def(
          "step",
          [](SimulatedCell& c, int steps) {
            py::gil_scoped_release release;
            c.step(steps);
          },
          "steps"_a = 1, "Advances by `steps` time steps.")
      .def("watch", &SimulatedCell::watch, "period"_a, "watcher"_a,
           "Calls watcher() about every `period` s of simulated time, also while a SimulatedRobot "
           "moves; None ends it.")
      .def_property_readonly("time", &SimulatedCell::time, "s")
      .def_property_readonly("timestep", &SimulatedCell::timestep, "s")
      .def_property_readonly(
          "joints", [](const SimulatedCell& c) { return c.arm().q; }, "(6,) rad")
      .def_property_readonly(
          "joint_velocities", [](const SimulatedCell& c) { return c.arm().qd; }, "(6,) rad/s")
      .def_property_readonly(
          "gap", [](const SimulatedCell& c) { return c.gripper().gap; }, "m between the pads")
      .def_property_readonly(
          "grip_force", [](const SimulatedCell& c) { return c.gripper().force; },
          "N, squeezed between the pads by the drive")
      .def("command_gripper", &SimulatedCell::command_gripper, "gap"_a, "force"_a, "m, N")
      .def(
          "color",
          [](SimulatedCell& c) {
            return without_gil<std::uint8_t>(c, &SimulatedCell::color);
          },
          "(H, W, 3) uint8 RGB")
      .def(
          "depth", [](SimulatedCell& c) { return without_gil<float>(c, &SimulatedCell::depth); },
          "(H, W) float32 m as the D455 measures it, depth frame, NaN invalid")
      .def(
          "aligned_depth",
          [](const SimulatedCell& c, const FloatImage& depth) {
            const cv::Mat image = to_mat(depth, "depth");
            cv::Mat aligned;
            {
              py::gil_scoped_release release;
              aligned = c.aligned_depth(image);
            }
            return to_numpy<float>(aligned);
          },
          "depth"_a, "The depth image in the colour frame, (H, W) float32 m, NaN invalid")
      .def_property(
          "camera", [](const SimulatedCell& c) { return CameraConfig(c.camera()); },
          &SimulatedCell::set_camera,
          "A copy of the camera in use; assign to change it. A new scene resets it.")
      .def("offset_camera", &SimulatedCell::offset_camera, "seed"_a,
           "Hangs the camera off its nominal pose by what the seed draws, in this and later scenes.")
      .def(
          "hold_board",
          [](SimulatedCell& c,
             const py::array_t<std::uint8_t, py::array::c_style | py::array::forcecast>& print,
             std::uint64_t seed) {
            if (print.ndim() != 2) throw Error("print: expected shape (height, width)");
            c.hold_board(cv::Mat(static_cast<int>(print.shape(0)),
                                 static_cast<int>(print.shape(1)), CV_8UC1,
                                 const_cast<std::uint8_t*>(print.data())),
                         seed);
          },
          "print"_a, "seed"_a,
          "Bolts a calibration board with this print (H, W) uint8 albedo to the gripper.")
      .def(
          "measure_board",
          [](const SimulatedCell& c, std::uint64_t index) {
            return to_matrix(c.measure_board(index));
          },
          "index"_a, "(4, 4) T_camera_board with the noise of simulated target poses")
      // Ground truth: for the judge, for labels and for pictures only.
      .def_property_readonly(
          "T_tool_board", [](const SimulatedCell& c) { return to_matrix(c.T_tool_board()); })
      .def(
          "verdict", [](const SimulatedCell& c) { return physics::to_json(c.verdict()); },
          "The judge's verdict on the trial so far, JSON.")
      .def(
          "contacts",
          [](SimulatedCell& c) {
            py::list contacts;
            for (const physics::Contact& contact : c.world().contacts())
              contacts.append(
                  py::make_tuple(contact.a, contact.b, contact.normal_force, contact.point));
            return contacts;
          },
          "Who touches whom: [(name, name, N, point (3,) m in base_link)]; parts are 'part:INDEX'.")
      .def(
          "supports",
          [](SimulatedCell& c) {
            py::list supports;
            for (const physics::Support& s : c.world().supports())
              supports.append(py::make_tuple(s.under, s.over, s.force));
            return supports;
          },
          "Which parts rest on which: [(part below, part above, N)]")
      .def(
          "ideal_depth",
          [](SimulatedCell& c) { return without_gil<float>(c, &SimulatedCell::ideal_depth); },
          "(H, W) float32 m, colour frame, noise-free")
      .def(
          "part_mask",
          [](SimulatedCell& c) {
            return without_gil<std::int32_t>(c, &SimulatedCell::part_mask);
          },
          "(H, W) int32, colour frame: index of the part seen, -1 for none")
      .def(
          "ideal_view",
          [](SimulatedCell& c) {
            std::pair<cv::Mat, cv::Mat> view;
            {
              py::gil_scoped_release release;
              view = c.ideal_view();
            }
            return py::make_tuple(to_numpy<float>(view.first), to_numpy<std::int32_t>(view.second));
          },
          "ideal_depth() and part_mask() at the price of one")
      .def(
          "part_poses",
          [](SimulatedCell& c) {
            const int n = c.world().part_count();
            py::array_t<double> poses({n, 4, 4});
            for (int i = 0; i < n; ++i) {
              const Pose T = c.world().part(i).T_base_part;
              for (int row = 0; row < 4; ++row)
                for (int column = 0; column < 4; ++column)
                  poses.mutable_at(i, row, column) = T(row, column);
            }
            return poses;
          },
          "(n, 4, 4) T_base_part")
      .def_property_readonly(
          "part_names",
          [](const SimulatedCell& c) {
            std::vector<std::string> names;
            for (const auto& model : c.models()) names.push_back(model.name);
            return names;
          })
      .def_property_readonly(
          "part_families",
          [](const SimulatedCell& c) {
            std::vector<std::string> families;
            for (const auto& model : c.models()) families.push_back(model.family);
            return families;
          })
      .def(
          "unoccluded_areas",
          [](SimulatedCell& c) {
            py::gil_scoped_release release;
            return c.unoccluded_areas();
          },
          "px that each part would cover with nothing before it")
      .def("lay_in_tray", &SimulatedCell::lay_in_tray, "part"_a, "slot"_a,
           "Moves a part into a slot of the tray at once: for the looks of a half-cleared table.")
      .def(
          "lay_parts",
          [](SimulatedCell& c, const std::vector<Eigen::Matrix4d>& poses) {
            std::vector<Pose> T_base_part;
            for (const auto& T : poses) T_base_part.push_back(to_pose(T, "T_base_part"));
            py::gil_scoped_release release;
            c.lay_parts(T_base_part);
          },
          "T_base_part"_a,
          "Parts at rest in these poses, as part_poses() gave them, arm observing, time 0, judge "
          "reset; camera, light and materials stay.")
      .def("show_parts", &SimulatedCell::show_parts, "shown"_a,
           "Whether the camera sees the parts; the physics keeps them.")
      .def("view_around_parts", &SimulatedCell::view_around_parts, "margin"_a,
           "From now on depth() and the ideal images hold only what lies this far (m) around the parts "
           "that are not in the tray; None: all.")
      .def("set_light", &SimulatedCell::set_light, "light"_a)
      .def("set_part_material", &SimulatedCell::set_part_material, "part"_a, "material"_a)
      .def("set_table_material", &SimulatedCell::set_table_material, "material"_a)
      .def(
          "picture",
          [](SimulatedCell& c, const PinholeIntrinsics& camera, const Eigen::Matrix4d& T,
             const sensing::Light& light) {
            const Pose pose = to_pose(T, "T_base_camera");
            cv::Mat image;
            {
              py::gil_scoped_release release;
              c.sync_renderer();
              image = c.renderer().color(camera, pose, light, 0.0, 0);
            }
            return to_numpy<std::uint8_t>(image);
          },
          "camera"_a, "T_base_camera"_a, "light"_a,
          "(H, W, 3) uint8 RGB of the cell from anywhere; z of the camera looks forward, y down.");

  py::class_<grasping::GraspLabel>(m, "GraspLabel", "An executable grasp of a part, ground truth.")
      .def_readonly("part", &grasping::GraspLabel::part)
      .def_readonly("rectangle", &grasping::GraspLabel::rectangle,
                    "in the colour image; width_px is the part's width between the pads")
      .def_readonly("jaw_px", &grasping::GraspLabel::jaw_px)
      .def_readonly("opening_px", &grasping::GraspLabel::opening_px)
      .def_readonly("pose", &grasping::GraspLabel::pose);
  py::class_<GraspLabeler>(m, "GraspLabeler", "Finds the executable grasps of a settled scene.")
      .def(py::init<const std::string&>(), "config_dir"_a)
      .def(
          "label",
          [](GraspLabeler& self, SimulatedCell& cell, const FloatImage& depth,
             const py::array_t<std::int32_t, py::array::c_style | py::array::forcecast>& mask) {
            if (mask.ndim() != 2) throw Error("part_mask: expected shape (height, width)");
            const cv::Mat image = to_mat(depth, "depth");
            const cv::Mat parts(static_cast<int>(mask.shape(0)), static_cast<int>(mask.shape(1)),
                                CV_32SC1, const_cast<std::int32_t*>(mask.data()));
            py::gil_scoped_release release;
            return self.label(cell, image, parts);
          },
          "cell"_a, "ideal_depth"_a, "part_mask"_a,
          "GraspLabels of all visible parts, best first within a part. Images: those of "
          "SimulatedCell.ideal_depth() and part_mask().");

  py::class_<SimulatedRobot, motion::Robot>(
      m, "SimulatedRobot", "The simulated arm and gripper; simulated time passes while it blocks.")
      .def(py::init<SimulatedCell&>(), "cell"_a, py::keep_alive<1, 2>());
}

}  // namespace iwgnet_grasp::bindings
