#include "iwgnet_grasp/physics/simulated_cell.h"

#include <urdf_model/model.h>
#include <urdf_parser/urdf_parser.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <map>
#include <optional>
#include <random>
#include <sstream>

#include "iwgnet_grasp/core/yaml.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/physics/calibration_rig.h"
#include "iwgnet_grasp/sensing/pinhole.h"
#include "robot_model.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kRestSpeed = 0.01;     // rad/s: the arm counts as at rest below it
constexpr double kSettleTime = 0.5;     // s, longest wait for that after a trajectory
constexpr double kGripTime = 4.0;       // s, twice the longest stroke at the slowest speed
constexpr double kExecuteMargin = 2.0;  // s beyond a trajectory's end and its goal time
constexpr double kBoardForce = 20.0;    // N, on the edge of the calibration board
constexpr float kFloorHeight = -0.75f;  // m, of the hall's floor under the table

std::string read_text(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw Error(path + ": cannot be read; run scripts/setup");
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

// splitmix64: one seed for each (scene, stream, frame), unrelated to its neighbours.
std::uint64_t mix(std::uint64_t seed, std::uint64_t stream) {
  std::uint64_t z = seed + 0x9e3779b97f4a7c15ull * (stream + 1);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
  return z ^ (z >> 31);
}

bool is_stl(const std::string& path) {
  if (path.size() < 4) return false;
  std::string ending = path.substr(path.size() - 4);
  std::transform(ending.begin(), ending.end(), ending.begin(), ::tolower);
  return ending == ".stl";
}

TriangleMesh cylinder_mesh(double radius, double length) {
  constexpr int kSides = 32;
  TriangleMesh mesh;
  for (int i = 0; i < kSides; ++i) {
    const double angle = 2 * M_PI * i / kSides;
    for (const double z : {-length / 2, length / 2})
      mesh.vertices.emplace_back(radius * std::cos(angle), radius * std::sin(angle), z);
  }
  mesh.vertices.emplace_back(0, 0, -length / 2);
  mesh.vertices.emplace_back(0, 0, length / 2);
  for (std::uint32_t i = 0; i < kSides; ++i) {
    const std::uint32_t a = 2 * i, b = 2 * ((i + 1) % kSides);
    mesh.triangles.push_back({a, b, b + 1});
    mesh.triangles.push_back({a, b + 1, a + 1});
    mesh.triangles.push_back({2 * kSides, b, a});
    mesh.triangles.push_back({2 * kSides + 1, a + 1, b + 1});
  }
  return mesh;
}

struct Appearance {
  sensing::Light light;
  double color_noise_sigma = 0.0;
  sensing::Material table, tray, mount, camera, floor, robot, board;
  std::vector<sensing::Material> parts;
};

sensing::Material material(const YamlFile& file, const std::string& key, bool colored = true) {
  sensing::Material m;
  if (colored) m.albedo = file.vector(key + ".albedo", 3).cast<float>();
  m.metallic = file.get<float>(key + ".metallic");
  m.roughness = file.get<float>(key + ".roughness");
  m.texture = file.get<float>(key + ".texture");
  return m;
}

Appearance load_appearance(const std::string& config_dir) {
  const YamlFile file(config_dir + "/appearance.yaml");
  Appearance a;
  a.light.position = file.vector("light.position", 3).cast<float>();
  a.light.intensity = file.vector("light.intensity", 3).cast<float>();
  a.light.ambient = file.get<float>("light.ambient");
  a.color_noise_sigma = file.get<double>("color_noise_sigma");
  a.table = material(file, "table");
  a.tray = material(file, "tray");
  a.mount = material(file, "mount");
  a.camera = material(file, "camera");
  a.floor = material(file, "floor");
  a.board = material(file, "board");
  a.robot = material(file, "robot", false);
  const YAML::Node parts = file.node("parts");
  if (!parts.IsSequence() || parts.size() == 0) file.fail("parts", "needs a list of materials");
  for (const YAML::Node& node : parts) {
    try {
      sensing::Material m;
      const auto albedo = node["albedo"].as<std::vector<float>>();
      if (albedo.size() != 3) file.fail("parts", "needs an albedo of 3 numbers in each material");
      m.albedo = Eigen::Vector3f(albedo[0], albedo[1], albedo[2]);
      m.metallic = node["metallic"].as<float>();
      m.roughness = node["roughness"].as<float>();
      m.texture = node["texture"].as<float>();
      a.parts.push_back(m);
    } catch (const YAML::Exception&) {
      file.fail("parts", "needs albedo, metallic, roughness and texture in each material");
    }
  }
  return a;
}

}  // namespace

struct SimulatedCell::Impl {
  struct LinkVisual {
    std::string link;
    Pose T_link_visual;
    int instance;
  };

  Impl(const std::string& package, const std::string& configs)
      : package_dir(package),
        config_dir(configs),
        config(load_cell_config(configs)),
        camera(config.camera),
        T_base_color(config.camera.T_base_color),
        urdf_xml(read_text(package + "/urdf/cell.urdf")),
        appearance(load_appearance(configs)),
        library(load_parts(package + "/assets/parts")),
        world(urdf_xml, package, config, configs),
        arm_controller(config.observe_joints),
        judge(config, configs),
        light(appearance.light) {
    build_static_meshes();
    world.reset(config.observe_joints);
    begin_scene({}, 0);
  }

  // A mesh of the package as the renderer's handle; loaded once a file and scale.
  int mesh_of(const urdf::Mesh& mesh) {
    const std::string path = mesh_path(mesh.filename, package_dir);
    const auto found = meshes.find(path);
    if (found != meshes.end()) return found->second;
    TriangleMesh triangles = load_stl(path);
    for (auto& v : triangles.vertices)
      v = v.cwiseProduct(Eigen::Vector3f(mesh.scale.x, mesh.scale.y, mesh.scale.z));
    return meshes[path] = renderer.add_mesh(triangles);
  }

  int mesh_of(const urdf::Geometry& geometry) {
    switch (geometry.type) {
      case urdf::Geometry::MESH: return mesh_of(static_cast<const urdf::Mesh&>(geometry));
      case urdf::Geometry::BOX: {
        const auto& d = static_cast<const urdf::Box&>(geometry).dim;
        return renderer.add_box({d.x, d.y, d.z});
      }
      case urdf::Geometry::CYLINDER: {
        const auto& c = static_cast<const urdf::Cylinder&>(geometry);
        return renderer.add_mesh(cylinder_mesh(c.radius, c.length));
      }
      default: throw Error(package_dir + "/urdf/cell.urdf: spheres are not drawn; use a mesh");
    }
  }

  // Meshes outlive the scenes: the renderer keeps them when its instances are cleared.
  void build_static_meshes() {
    const auto model = urdf::parseURDF(urdf_xml);
    if (!model) throw Error(package_dir + "/urdf/cell.urdf: is not a valid URDF");
    for (const auto& [name, link] : model->links_) {
      for (const auto& visual : link->visual_array) {
        if (!visual || !visual->geometry) continue;
        LinkDrawing drawing{name, 0, pose_of(visual->origin), appearance.robot};
        drawing.material.albedo = Eigen::Vector3f(0.5f, 0.5f, 0.5f);
        if (visual->material) {
          const auto& c = visual->material->color;
          // URDF colours are display values; the renderer's are linear.
          drawing.material.albedo =
              Eigen::Vector3f(std::pow(c.r, 2.2f), std::pow(c.g, 2.2f), std::pow(c.b, 2.2f));
        }
        const urdf::Geometry* geometry = visual->geometry.get();
        // Visual meshes in other formats give way to the link's STL collision mesh.
        if (geometry->type == urdf::Geometry::MESH &&
            !is_stl(static_cast<const urdf::Mesh*>(geometry)->filename)) {
          geometry = nullptr;
          for (const auto& collision : link->collision_array)
            if (collision && collision->geometry &&
                collision->geometry->type == urdf::Geometry::MESH &&
                is_stl(static_cast<const urdf::Mesh&>(*collision->geometry).filename)) {
              geometry = collision->geometry.get();
              drawing.T_link_visual = pose_of(collision->origin);
            }
        }
        if (geometry == nullptr) continue;
        drawing.mesh = mesh_of(*geometry);
        drawings.push_back(drawing);
      }
    }
    for (const auto& part : library) part_meshes[part.name] = renderer.add_mesh(part.mesh);

    const auto box = [&](const Box& b, const sensing::Material& m) {
      boxes.push_back({renderer.add_box(b.size), Pose(Eigen::Translation3d(b.center)), m});
    };
    box(config.table, appearance.table);
    for (const Box& wall : config.tray.boxes()) box(wall, appearance.tray);
    for (const Box& beam : config.camera_mount)
      camera_boxes.push_back({renderer.add_box(beam.size), Pose(Eigen::Translation3d(beam.center)),
                              appearance.mount});
    add_camera_body();
    box({{0, 0, kFloorHeight - 0.05}, {8, 8, 0.1}}, appearance.floor);
  }

  void begin_scene(const std::vector<PartModel>& parts, std::uint64_t scene_seed) {
    models = parts;
    seed = scene_seed;
    frames = 0;
    arm_controller.reset(home());
    gripper_controller.reset();
    judge.reset(world);
    light = appearance.light;
    camera = config.camera;
    camera.T_base_color = T_base_color;

    renderer.clear_instances();
    link_visuals.clear();
    part_instances.clear();
    for (const LinkDrawing& d : drawings)
      link_visuals.push_back(
          {d.link, d.T_link_visual, renderer.add_instance(d.mesh, d.material, Pose::Identity())});
    for (std::size_t i = 0; i < boxes.size(); ++i) {
      const int instance =
          renderer.add_instance(boxes[i].mesh, boxes[i].material, boxes[i].T_base_box);
      if (i == 0) table_instance = instance;
    }
    camera_instances.clear();
    for (const BoxDrawing& b : camera_boxes)
      camera_instances.push_back(renderer.add_instance(b.mesh, b.material, Pose::Identity()));
    place_camera();
    const std::size_t start = mix(seed, 77) % appearance.parts.size();
    for (std::size_t i = 0; i < models.size(); ++i)
      part_instances.push_back(renderer.add_instance(
          part_meshes.at(models[i].name), appearance.parts[(start + i) % appearance.parts.size()],
          Pose::Identity()));
    show_board();
    sync();
  }

  // Where the arm stands when a scene begins.
  JointVector home() const { return board ? board->start_joints : config.observe_joints; }

  // The board's drawings in a scene that has just been begun.
  void show_board() {
    if (!board) return;
    board->sheet = renderer.add_instance(board->sheet_mesh, appearance.board, Pose::Identity());
    board->plate = renderer.add_instance(board->plate_mesh, appearance.board, Pose::Identity());
    gripper_controller.start(board->thickness, kBoardForce, world.time());
  }

  // The imagers look out of the body's front: what is drawn of it ends just behind them.
  void add_camera_body() {
    const CameraConfig& c = config.camera;
    constexpr double kBehind = 0.001;  // m
    const double back = c.body_center.x() - c.body_size.x() / 2;
    const double front = std::min(c.body_center.x() + c.body_size.x() / 2, -kBehind);
    if (front <= back) return;
    Eigen::Vector3d size = c.body_size, center = c.body_center;
    size.x() = front - back;
    center.x() = (front + back) / 2;
    camera_boxes.push_back({renderer.add_box(size),
                            c.T_base_camera_link() * Pose(Eigen::Translation3d(center)),
                            appearance.camera});
  }

  // Body and mount move with the camera.
  void place_camera() {
    const Pose moved = camera.T_base_color * config.camera.T_base_color.inverse();
    for (std::size_t i = 0; i < camera_boxes.size(); ++i)
      renderer.set_pose(camera_instances[i], moved * camera_boxes[i].T_base_box);
  }

  void sync() {
    std::map<std::string, Pose> poses;
    for (const LinkPose& link : world.link_poses()) poses.emplace(link.link, link.T_base_link);
    for (const LinkVisual& visual : link_visuals) {
      const auto found = poses.find(visual.link);
      if (found != poses.end())
        renderer.set_pose(visual.instance, found->second * visual.T_link_visual);
    }
    for (std::size_t i = 0; i < part_instances.size(); ++i)
      renderer.set_pose(part_instances[i], world.part(static_cast<int>(i)).T_base_part);
    if (board) {
      const Pose T_base_board = kinematics::forward(world.arm().q) * board->T_tool_board;
      renderer.set_pose(board->sheet, T_base_board);
      renderer.set_pose(board->plate, T_base_board * Eigen::Translation3d(board->plate_center));
    }
    renderer.set_region(view_margin ? around_parts(*view_margin) : Eigen::AlignedBox3d());
  }

  Eigen::AlignedBox3d around_parts(double margin) const {
    Eigen::AlignedBox3d box;
    for (std::size_t i = 0; i < models.size(); ++i) {
      const Pose T = world.part(static_cast<int>(i)).T_base_part;
      if (config.tray.covers(T.translation().head<2>())) continue;
      for (const Eigen::Vector3f& vertex : models[i].mesh.vertices)
        box.extend(T * vertex.cast<double>());
    }
    if (box.isEmpty()) return box;
    box.min().array() -= margin;
    box.max().head<2>().array() += margin;
    return box;
  }

  struct LinkDrawing {
    std::string link;
    int mesh;
    Pose T_link_visual;
    sensing::Material material;
  };
  struct Board {  // of the calibration rig
    int sheet_mesh, plate_mesh;
    Eigen::Vector3d plate_center;  // m, board frame
    double thickness;              // m
    Pose T_tool_board;
    Offset noise;
    JointVector start_joints;
    int sheet = -1, plate = -1;    // instances of the scene
  };
  struct BoxDrawing {
    int mesh;
    Pose T_base_box;
    sensing::Material material;
  };

  std::string package_dir, config_dir;
  CellConfig config;
  CameraConfig camera;
  Pose T_base_color;  // of the camera in new scenes
  std::string urdf_xml;
  Appearance appearance;
  std::vector<PartModel> library;
  World world;
  TrajectoryController arm_controller;
  GripperController gripper_controller;
  Judge judge;
  sensing::Renderer renderer;
  sensing::Light light;
  std::optional<double> view_margin;  // m

  std::map<std::string, int> meshes, part_meshes;
  std::vector<LinkDrawing> drawings;
  std::vector<BoxDrawing> boxes, camera_boxes;
  std::vector<LinkVisual> link_visuals;
  std::vector<int> part_instances, camera_instances;
  int table_instance = -1;
  std::optional<Board> board;

  std::vector<PartModel> models;
  std::uint64_t seed = 0, frames = 0;

  std::function<void()> watcher;
  int watch_interval = 1, steps_to_watch = 0;
};

SimulatedCell::SimulatedCell(const std::string& package_dir, const std::string& config_dir)
    : impl_(std::make_unique<Impl>(package_dir,
                                   config_dir.empty() ? package_dir + "/config" : config_dir)) {}
SimulatedCell::~SimulatedCell() = default;

const CellConfig& SimulatedCell::config() const { return impl_->config; }

int SimulatedCell::load_scene(const std::string& scene, std::uint64_t seed) {
  if (scene.empty()) return load_scene(SceneSpec{}, seed);
  return load_scene(load_scene_spec(impl_->config_dir, scene), seed);
}

int SimulatedCell::load_scene(const SceneSpec& spec, std::uint64_t seed) {
  Impl& m = *impl_;
  m.world.reset(m.home());
  std::vector<PartModel> parts;
  if (spec.count > 0) parts = build_scene(m.world, spec, m.config, m.library, seed);
  m.begin_scene(parts, seed);
  return static_cast<int>(parts.size());
}

void SimulatedCell::step(int steps) {
  Impl& m = *impl_;
  for (int i = 0; i < steps; ++i) {
    const double now = m.world.time();
    const motion::TrajectoryPoint point = m.arm_controller.update(now, m.world.arm());
    m.world.set_arm_setpoint(point.q, point.qd);
    m.gripper_controller.update(m.world, now);
    m.world.step();
    m.judge.observe(m.world, m.gripper_controller.goal());
    if (m.watcher && --m.steps_to_watch <= 0) {
      m.steps_to_watch = m.watch_interval;
      m.watcher();
    }
  }
}

void SimulatedCell::watch(double period, std::function<void()> watcher) {
  if (!(period > 0)) throw Error("watch: the period must be above 0 s");
  impl_->watch_interval = std::max(1, static_cast<int>(std::lround(period / timestep())));
  impl_->steps_to_watch = 0;
  impl_->watcher = std::move(watcher);
}

double SimulatedCell::time() const { return impl_->world.time(); }
double SimulatedCell::timestep() const { return impl_->world.timestep(); }

ArmState SimulatedCell::arm() const { return impl_->world.arm(); }
GripperState SimulatedCell::gripper() const { return impl_->world.gripper(); }
TrajectoryController& SimulatedCell::arm_controller() { return impl_->arm_controller; }

std::string SimulatedCell::start_trajectory(const motion::Trajectory& trajectory,
                                            const TrajectoryTolerances& tolerances) {
  return impl_->arm_controller.start(trajectory, tolerances, time(), arm());
}

void SimulatedCell::command_gripper(double gap, double force) {
  impl_->gripper_controller.start(gap, force, time());
}

GripperStatus SimulatedCell::gripper_status() const { return impl_->gripper_controller.status(); }
double SimulatedCell::commanded_gap() const { return impl_->gripper_controller.goal(); }

cv::Mat SimulatedCell::color() {
  Impl& m = *impl_;
  m.sync();
  return m.renderer.color(m.camera.color, m.camera.T_base_color, m.light,
                          m.appearance.color_noise_sigma, mix(m.seed, 2 * m.frames++));
}

cv::Mat SimulatedCell::depth() {
  Impl& m = *impl_;
  m.sync();
  return sensing::capture_depth(m.renderer, m.camera, mix(m.seed, 2 * m.frames++ + 1));
}

cv::Mat SimulatedCell::aligned_depth(const cv::Mat& depth) const {
  const CameraConfig& c = impl_->camera;
  return sensing::align_depth(depth, c.depth, c.color, c.T_depth_color.inverse());
}

const CameraConfig& SimulatedCell::camera() const { return impl_->camera; }
void SimulatedCell::set_camera(const CameraConfig& camera) {
  impl_->camera = camera;
  impl_->place_camera();
}

void SimulatedCell::offset_camera(std::uint64_t seed) {
  Impl& m = *impl_;
  const Offset offset = load_calibration_rig(m.config_dir).camera_offset;
  m.T_base_color = m.config.camera.T_base_color * draw_offset(offset, mix(seed, 101));
  CameraConfig moved = m.camera;
  moved.T_base_color = m.T_base_color;
  set_camera(moved);
}

void SimulatedCell::hold_board(const cv::Mat& print, std::uint64_t seed) {
  Impl& m = *impl_;
  const CalibrationRig rig = load_calibration_rig(m.config_dir);
  constexpr double kGap = 5e-5;  // m, the print above the plate, that they do not fight for pixels
  Eigen::Vector3d size = rig.plate.size;
  size.z() -= kGap;
  m.board = Impl::Board{m.renderer.add_sheet(rig.print_size, print),
                        m.renderer.add_box(size),
                        rig.plate.center - Eigen::Vector3d(0, 0, kGap / 2),
                        rig.plate.size.z(),
                        rig.T_tool_board * draw_offset(rig.board_offset, mix(seed, 102)),
                        rig.pose_noise, rig.start_joints};
}

bool SimulatedCell::has_board() const { return impl_->board.has_value(); }

Pose SimulatedCell::T_tool_board() const {
  if (!impl_->board) throw Error("the simulated gripper holds no calibration board");
  return impl_->board->T_tool_board;
}

Pose SimulatedCell::measure_board(std::uint64_t index) const {
  const Pose T_tool = T_tool_board();
  return impl_->camera.T_base_color.inverse() * kinematics::forward(impl_->world.arm().q) * T_tool *
         draw_noise(impl_->board->noise, mix(impl_->seed, 103), index);
}

World& SimulatedCell::world() { return impl_->world; }
sensing::Renderer& SimulatedCell::renderer() { return impl_->renderer; }
void SimulatedCell::sync_renderer() { impl_->sync(); }

int SimulatedCell::part_instance(int part) const {
  if (part < 0 || part >= static_cast<int>(impl_->part_instances.size()))
    throw Error("part " + std::to_string(part) + " is not in the scene, which holds " +
                std::to_string(impl_->part_instances.size()));
  return impl_->part_instances[part];
}

const std::vector<PartModel>& SimulatedCell::models() const { return impl_->models; }

cv::Mat SimulatedCell::ideal_depth() {
  impl_->sync();
  return impl_->renderer.depth(impl_->camera.color, impl_->camera.T_base_color);
}

cv::Mat SimulatedCell::part_mask() { return ideal_view().second; }

std::pair<cv::Mat, cv::Mat> SimulatedCell::ideal_view() {
  Impl& m = *impl_;
  m.sync();
  cv::Mat instances;
  const cv::Mat depth = m.renderer.depth(m.camera.color, m.camera.T_base_color, &instances);
  std::map<int, int> part_of;
  for (std::size_t i = 0; i < m.part_instances.size(); ++i)
    part_of[m.part_instances[i]] = static_cast<int>(i);
  int last = -1, last_part = -1;
  for (int row = 0; row < instances.rows; ++row) {
    int* line = instances.ptr<int>(row);
    for (int column = 0; column < instances.cols; ++column) {
      if (line[column] != last) {
        last = line[column];
        const auto found = part_of.find(last);
        last_part = found == part_of.end() ? -1 : found->second;
      }
      line[column] = last_part;
    }
  }
  return {depth, instances};
}

std::vector<double> SimulatedCell::unoccluded_areas() {
  constexpr int kReduction = 4;
  Impl& m = *impl_;
  m.sync();
  PinholeIntrinsics k = m.camera.color;
  k.width /= kReduction;
  k.height /= kReduction;
  k.fx /= kReduction;
  k.fy /= kReduction;
  k.cx = (k.cx + 0.5) / kReduction - 0.5;
  k.cy = (k.cy + 0.5) / kReduction - 0.5;
  std::vector<double> areas;
  show_parts(false);
  for (const int instance : m.part_instances) {
    m.renderer.set_visible(instance, true);
    const cv::Mat seen = m.renderer.instances(k, m.camera.T_base_color) == instance;
    areas.push_back(cv::countNonZero(seen) * double(kReduction) * kReduction);
    m.renderer.set_visible(instance, false);
  }
  show_parts(true);
  return areas;
}

void SimulatedCell::lay_in_tray(int part, int slot) {
  Impl& m = *impl_;
  part_instance(part);  // throws for an index that is not there
  const auto slots = m.config.tray.slots();
  if (slot < 0 || slot >= static_cast<int>(slots.size()))
    throw Error("slot " + std::to_string(slot) + ": the tray has " + std::to_string(slots.size()));
  float lowest = 0.0f;
  for (const auto& v : m.models[part].mesh.vertices) lowest = std::min(lowest, v.z());
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() = slots[slot] - Eigen::Vector3d(0, 0, lowest);
  m.world.set_part_pose(part, T);
}

void SimulatedCell::lay_parts(const std::vector<Pose>& T_base_part) {
  Impl& m = *impl_;
  if (T_base_part.size() != m.models.size())
    throw Error(std::to_string(T_base_part.size()) + " poses for the scene's " +
                std::to_string(m.models.size()) + " parts");
  m.world.reset(m.config.observe_joints);
  for (std::size_t i = 0; i < m.models.size(); ++i) m.world.add_part(m.models[i], T_base_part[i]);
  m.arm_controller.reset(m.config.observe_joints);
  m.gripper_controller.reset();
  m.judge.reset(m.world);
}

void SimulatedCell::show_parts(bool shown) {
  for (const int instance : impl_->part_instances) impl_->renderer.set_visible(instance, shown);
}

void SimulatedCell::view_around_parts(std::optional<double> margin) {
  impl_->view_margin = margin;
}

void SimulatedCell::set_light(const sensing::Light& light) { impl_->light = light; }

void SimulatedCell::set_part_material(int part, const sensing::Material& material) {
  impl_->renderer.set_material(part_instance(part), material);
}

void SimulatedCell::set_table_material(const sensing::Material& material) {
  impl_->renderer.set_material(impl_->table_instance, material);
}

Verdict SimulatedCell::verdict() const { return impl_->judge.verdict(impl_->world); }

JointVector SimulatedRobot::joints() { return cell_.arm().q; }

motion::ExecutionResult SimulatedRobot::execute(const motion::Trajectory& trajectory) {
  motion::ExecutionResult result = follow(trajectory, default_tolerances());
  result.contact = false;
  return result;
}

motion::ExecutionResult SimulatedRobot::execute_until_contact(const motion::Trajectory& trajectory,
                                                              const JointVector& path_tolerance) {
  TrajectoryTolerances tolerances = default_tolerances();
  tolerances.path = path_tolerance;
  motion::ExecutionResult result = follow(trajectory, tolerances);
  if (result.contact) result.success = true;
  return result;
}

motion::ExecutionResult SimulatedRobot::follow(const motion::Trajectory& trajectory,
                                               const TrajectoryTolerances& tolerances) {
  const std::string refusal = cell_.start_trajectory(trajectory, tolerances);
  if (!refusal.empty()) return {false, "trajectory refused: " + refusal};
  const double give_up =
      cell_.time() + trajectory.back().time + tolerances.goal_time + kExecuteMargin;
  while (cell_.arm_controller().status() == TrajectoryStatus::kActive && cell_.time() < give_up)
    cell_.step();
  const TrajectoryStatus status = cell_.arm_controller().status();
  if (status != TrajectoryStatus::kSucceeded) {
    const std::string why = cell_.arm_controller().message();
    cell_.arm_controller().cancel(cell_.arm());
    return {false, why.empty() ? "the arm did not reach the trajectory's end in time" : why,
            status == TrajectoryStatus::kPathViolated};
  }
  const double settled_by = cell_.time() + kSettleTime;
  while (cell_.arm().qd.cwiseAbs().maxCoeff() > kRestSpeed && cell_.time() < settled_by)
    cell_.step();
  return {true, ""};
}

motion::GripResult SimulatedRobot::grip(double gap_m, double force_n) {
  cell_.command_gripper(gap_m, force_n);
  const double give_up = cell_.time() + kGripTime;
  do {
    cell_.step();
  } while (!cell_.gripper_status().reached && !cell_.gripper_status().stalled &&
           cell_.time() < give_up);
  const GripperStatus status = cell_.gripper_status();
  motion::GripResult result;
  result.gap = cell_.gripper().gap;
  result.stalled = status.stalled;
  result.success = status.reached || status.stalled;
  if (!result.success) result.message = "the gripper neither reached the commanded gap nor stalled";
  return result;
}

motion::GripResult SimulatedRobot::preset(double gap_m, double force_n) {
  cell_.command_gripper(gap_m, force_n);
  motion::GripResult result;
  result.success = true;
  result.gap = gap_m;
  return result;
}

double SimulatedRobot::gap() { return cell_.gripper().gap; }

}  // namespace iwgnet_grasp::physics
