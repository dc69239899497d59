// Timings of the core, one JSON line a row: {"name", "value", "unit", "detail"}. Run by
// scripts/benchmark, which sets them beside their peers.
// usage: core_benchmark PACKAGE_DIR NAME...
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <functional>
#include <iterator>
#include <map>
#include <random>

#include "iwgnet_grasp/calibration/hand_eye.h"
#include "iwgnet_grasp/kinematics/kdl_chain.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/planner.h"
#include "iwgnet_grasp/physics/simulated_cell.h"

using namespace iwgnet_grasp;

namespace {

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Processor time of this thread: what other programs do on the machine does not count.
double thread_seconds() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

// Median duration of one call, s, over `runs` calls after a warm-up.
double median_seconds(int runs, const std::function<void()>& body) {
  body();
  std::vector<double> times(runs);
  for (double& time : times) {
    const double start = seconds();
    body();
    time = seconds() - start;
  }
  std::nth_element(times.begin(), times.begin() + runs / 2, times.end());
  return times[runs / 2];
}

void row(const std::string& name, double value, const std::string& unit, const std::string& detail) {
  std::printf("{\"name\": \"%s\", \"value\": %.6g, \"unit\": \"%s\", \"detail\": \"%s\"}\n",
              name.c_str(), value, unit.c_str(), detail.c_str());
  std::fflush(stdout);
}

std::vector<JointVector> random_joints(int count) {
  std::mt19937_64 random(0);
  std::uniform_real_distribution<double> angle(-M_PI, M_PI);
  std::vector<JointVector> joints(count);
  for (auto& q : joints)
    for (int i = 0; i < kJoints; ++i) q[i] = angle(random);
  return joints;
}

void measure_ik_closed_form(const std::string&) {
  std::vector<Pose> poses;
  for (const auto& q : random_joints(10000)) poses.push_back(kinematics::forward(q));
  long solutions = 0;
  const double time = median_seconds(9, [&] {
    solutions = 0;
    for (const auto& T : poses) solutions += kinematics::inverse(T).count;
  });
  row("ik", time / poses.size() * 1e6, "us",
      std::to_string(static_cast<double>(solutions) / poses.size()) + " solutions a pose");
}

void measure_ik_kdl(const std::string& package_dir) {
  std::ifstream file(package_dir + "/urdf/cell.urdf");
  const std::string urdf{std::istreambuf_iterator<char>(file), {}};
  const kinematics::KdlChain chain(urdf, "base_link", "tool0");
  std::mt19937_64 random(1);
  std::uniform_real_distribution<double> angle(-M_PI, M_PI);
  int solved = 0, asked = 0;
  const auto joints = random_joints(500);
  const double start = seconds();
  for (const auto& q : joints) {
    Eigen::VectorXd seed(kJoints);
    for (int i = 0; i < kJoints; ++i) seed[i] = angle(random);
    solved += chain.inverse(kinematics::forward(q), seed).has_value();
    ++asked;
  }
  row("ik_kdl", (seconds() - start) / asked * 1e6, "us",
      std::to_string(100.0 * solved / asked) + " % solved, one solution a pose");
}

// Simulated over processor time of physics alone, all parts kept awake, the arm on its way to and fro.
void measure_physics(const std::string& package_dir) {
  physics::SimulatedCell cell(package_dir);
  cell.load_scene("ten_stacked", 0);
  physics::World& world = cell.world();
  const JointVector home = cell.config().observe_joints;
  const int steps = static_cast<int>(4.0 / world.timestep());
  double busy = 0.0;
  for (int i = 0; i < steps; ++i) {
    if (i % 96 == 0)  // every 0.2 s each part is touched where it lies, so that none sleeps
      for (int part = 0; part < world.part_count(); ++part)
        world.set_part_pose(part, world.part(part).T_base_part);
    const double phase = 2 * M_PI * world.time() / 2.0;
    JointVector q = home, qd = JointVector::Zero();
    q[0] += 0.3 * (1 - std::cos(phase));
    qd[0] = 0.3 * std::sin(phase) * 2 * M_PI / 2.0;
    world.set_arm_setpoint(q, qd);
    const double start = thread_seconds();
    world.step();
    busy += thread_seconds() - start;
  }
  row("physics_awake", steps * world.timestep() / busy, "x real time",
      "arm moving, ten parts awake, 1/480 s, one core");
}

// The whole image, from a camera that has moved a little; and as in a trial, where a part has gone since
// the image before.
void measure_frame(const std::string& package_dir, const std::string& name, std::string what,
                   const std::function<void(physics::SimulatedCell&)>& take) {
  physics::SimulatedCell cell(package_dir);
  cell.load_scene("ten_stacked", 0);
  CameraConfig camera = cell.camera();
  const double whole = median_seconds(15, [&] {
    camera.T_base_color.translation().x() += 1e-6;
    cell.set_camera(camera);
    take(cell);
  });
  int slot = 0;
  const double next = median_seconds(5, [&] {
    cell.lay_in_tray(slot, slot);
    ++slot;
    take(cell);
  });
  row(name, whole * 1e3, "ms", what + "; " + std::to_string(next * 1e3) + " ms after a pick");
}

void measure_depth_frame(const std::string& package_dir) {
  measure_frame(package_dir, "depth_frame", "1280x720 with noise, ten parts and arm",
                [](physics::SimulatedCell& cell) { cell.depth(); });
}

void measure_color_frame(const std::string& package_dir) {
  measure_frame(package_dir, "color_frame", "1280x800 with light and shadow",
                [](physics::SimulatedCell& cell) { cell.color(); });
}

void measure_scene(const std::string& package_dir) {
  physics::SimulatedCell cell(package_dir);
  std::uint64_t seed = 0;
  row("scene", median_seconds(5, [&] { cell.load_scene("ten_stacked", seed++); }), "s",
      "ten parts dropped and settled");
}

void measure_planning(const std::string& package_dir) {
  const CellConfig cell = load_cell_config(package_dir + "/config");
  motion::CollisionWorld world(cell);
  const auto config = motion::load_pick_place_config(package_dir + "/config").planner;
  // From over the tray to above the workspace, tool down.
  Pose T = Pose::Identity();
  T.linear() << 1, 0, 0, 0, -1, 0, 0, 0, -1;
  T.translation() << 0.52, -0.05, 0.30;
  const auto solutions = kinematics::inverse(T);
  JointVector goal = cell.observe_joints;
  double best = 1e9;
  for (int i = 0; i < solutions.count; ++i) {
    const JointVector q = kinematics::nearest_turn(solutions.q[i], cell.observe_joints);
    const double far = (q - cell.observe_joints).norm();
    if (far < best && !world.collides(q)) best = far, goal = q;
  }
  bool success = true;
  const double time = median_seconds(
      50, [&] { success &= motion::plan(world, cell.observe_joints, goal, config).success; });
  row("planning", time * 1e3, "ms", success ? "tray to workspace, shortened" : "NOT SOLVED");
}

void measure_hand_eye(const std::string&) {
  std::mt19937_64 random(0);
  std::uniform_real_distribution<double> u(-1, 1);
  std::normal_distribution<double> n;
  const auto turn = [](const Eigen::Vector3d& v) {
    return Eigen::AngleAxisd(v.norm(), v.normalized()).toRotationMatrix();
  };
  Pose X = Pose::Identity(), Y = Pose::Identity();
  X.linear() << 1, 0, 0, 0, -1, 0, 0, 0, -1;
  X.translation() << 0.5, 0, 0.6;
  Y.translation() << 0.01, 0.02, 0.16;
  std::vector<calibration::PosePair> pairs;
  for (int i = 0; i < 15; ++i) {
    calibration::PosePair pair{X, X};
    pair.T_base_tool.linear() = X.linear() * turn({0.5 * u(random), 0.5 * u(random), u(random)});
    pair.T_base_tool.translation() << 0.5 + 0.15 * u(random), 0.12 * u(random), 0.25;
    pair.T_camera_target = X.inverse() * pair.T_base_tool * Y;
    const double t = 5e-4, r = 1.745e-3;
    pair.T_camera_target.linear() *= turn({r * n(random), r * n(random), r * n(random)});
    pair.T_camera_target.translation() += t * Eigen::Vector3d(n(random), n(random), n(random));
    pairs.push_back(pair);
  }
  row("hand_eye", median_seconds(50, [&] { calibration::refine(pairs, X); }) * 1e3, "ms",
      "15 pairs, maximum likelihood");
}

}  // namespace

int main(int argc, char** argv) {
  const std::map<std::string, void (*)(const std::string&)> rows = {
      {"ik", measure_ik_closed_form},     {"ik_kdl", measure_ik_kdl},
      {"physics_awake", measure_physics},       {"depth_frame", measure_depth_frame},
      {"color_frame", measure_color_frame}, {"scene", measure_scene},
      {"planning", measure_planning},     {"hand_eye", measure_hand_eye}};
  if (argc < 3) {
    std::fprintf(stderr, "usage: core_benchmark PACKAGE_DIR NAME...\n");
    return 2;
  }
  for (int i = 2; i < argc; ++i) {
    const auto found = rows.find(argv[i]);
    if (found == rows.end()) {
      std::fprintf(stderr, "core_benchmark: unknown row '%s'\n", argv[i]);
      return 2;
    }
    try {
      found->second(argv[1]);
    } catch (const Error& error) {
      std::fprintf(stderr, "core_benchmark: %s: %s\n", argv[i], error.what());
      return 1;
    }
  }
  return 0;
}
