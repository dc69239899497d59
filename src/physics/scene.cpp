#include "iwgnet_grasp/physics/scene.h"

#include <algorithm>
#include <cmath>

#include "iwgnet_grasp/core/yaml.h"

namespace iwgnet_grasp::physics {
namespace {

// splitmix64: small, and the same bits on every platform (the standard distributions are not).
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::uint64_t bits() {
    std::uint64_t z = state_ += 0x9e3779b97f4a7c15ull;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
  }
  double uniform(double low, double high) {
    return low + (high - low) * static_cast<double>(bits() >> 11) * 0x1.0p-53;
  }
  int below(int n) { return static_cast<int>(uniform(0.0, n)); }
  // Uniform over rotations (Shoemake 1992).
  Eigen::Matrix3d rotation() {
    const double u = uniform(0, 1), v = uniform(0, 2 * M_PI), w = uniform(0, 2 * M_PI);
    return Eigen::Quaterniond(std::sqrt(u) * std::cos(w), std::sqrt(1 - u) * std::sin(v),
                              std::sqrt(1 - u) * std::cos(v), std::sqrt(u) * std::sin(w))
        .normalized()
        .toRotationMatrix();
  }

 private:
  std::uint64_t state_;
};

constexpr int kPlacements = 2000;         // tries to place one part before all are laid anew
constexpr int kLayouts = 50;
constexpr double kFlatClearance = 0.0005;  // m above the table, scattered parts are let go
constexpr int kDrops = 12;                // times one part may be dropped again
constexpr double kReach = 0.08;           // m from a part's centre to its ends
constexpr double kMaxHeight = 0.11;       // m: the D455 sees nothing nearer than 0.49 m

struct Outline {  // convex outline of a part seen from above, m
  std::vector<Eigen::Vector2d> points;
  double radius = 0.0;  // of the circle about the origin that holds it
};

// Convex hull in the plane (Andrew's monotone chain), counter-clockwise.
Outline outline(const std::vector<Eigen::Vector3d>& vertices, const Eigen::Matrix3d& R) {
  std::vector<Eigen::Vector2d> p;
  for (const auto& v : vertices) p.push_back((R * v).head<2>());
  std::sort(p.begin(), p.end(), [](const auto& a, const auto& b) {
    return a.x() < b.x() || (a.x() == b.x() && a.y() < b.y());
  });
  const auto cross = [](const Eigen::Vector2d& o, const Eigen::Vector2d& a,
                        const Eigen::Vector2d& b) {
    return (a.x() - o.x()) * (b.y() - o.y()) - (a.y() - o.y()) * (b.x() - o.x());
  };
  std::vector<Eigen::Vector2d> hull(2 * p.size());
  std::size_t k = 0;
  for (std::size_t i = 0; i < p.size(); ++i) {
    while (k >= 2 && cross(hull[k - 2], hull[k - 1], p[i]) <= 0) --k;
    hull[k++] = p[i];
  }
  for (std::size_t i = p.size() - 1, lower = k + 1; i-- > 0;) {
    while (k >= lower && cross(hull[k - 2], hull[k - 1], p[i]) <= 0) --k;
    hull[k++] = p[i];
  }
  hull.resize(k > 1 ? k - 1 : k);
  Outline result{hull};
  for (const auto& point : hull) result.radius = std::max(result.radius, point.norm());
  return result;
}

// The vertices that any outline of a part has which is turned about z or put on its head.
std::vector<Eigen::Vector3d> rim(const PartModel& model) {
  std::vector<Eigen::Vector3d> vertices, rim;
  for (const auto& v : model.mesh.vertices) vertices.push_back(v.cast<double>());
  const Outline hull = outline(vertices, Eigen::Matrix3d::Identity());
  for (const auto& v : vertices)
    if (std::find(hull.points.begin(), hull.points.end(), v.head<2>()) != hull.points.end())
      rim.push_back(v);
  return rim;
}

double distance(const Eigen::Vector2d& p, const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  const Eigen::Vector2d d = b - a;
  const double t = std::clamp((p - a).dot(d) / std::max(d.squaredNorm(), 1e-18), 0.0, 1.0);
  return (p - a - t * d).norm();
}

bool separated(const Outline& a, const Eigen::Vector2d& at_a, const Outline& b,
               const Eigen::Vector2d& at_b, double gap) {
  if ((at_a - at_b).norm() > a.radius + b.radius + gap) return true;
  // Apart when some edge normal of either separates them; then the least distance counts.
  bool apart = false;
  double least = 1e9;
  const auto check = [&](const Outline& f, const Eigen::Vector2d& at_f, const Outline& g,
                         const Eigen::Vector2d& at_g) {
    const std::size_t n = f.points.size();
    for (std::size_t i = 0; i < n; ++i) {
      const Eigen::Vector2d p = at_f + f.points[i], q = at_f + f.points[(i + 1) % n];
      const Eigen::Vector2d outward(q.y() - p.y(), p.x() - q.x());
      bool all = true;
      for (const auto& v : g.points) {
        all = all && (at_g + v - p).dot(outward) > 0;
        least = std::min(least, distance(at_g + v, p, q));
      }
      apart = apart || all;
    }
  };
  check(a, at_a, b, at_b);
  check(b, at_b, a, at_a);
  return apart && least >= gap;
}

double lowest(const PartModel& model, const Eigen::Matrix3d& R) {
  double z = 0;
  for (const auto& v : model.mesh.vertices) z = std::min(z, R.row(2).dot(v.cast<double>()));
  return z;
}

double highest(const PartModel& model, const Pose& T) {
  double z = -1e9;
  for (const auto& v : model.mesh.vertices)
    z = std::max(z, T.linear().row(2).dot(v.cast<double>()) + T.translation().z());
  return z;
}

bool inside(const CellConfig& cell, const Eigen::Vector3d& p) {
  return (p.head<2>().array() >= cell.workspace_min.array()).all() &&
         (p.head<2>().array() <= cell.workspace_max.array()).all();
}

void run_until_rest(World& world, double limit) {
  const long steps = std::lround(limit / world.timestep());
  for (long i = 0; i < steps && !world.parts_at_rest(); ++i) world.step();
}

// A part may come to lie so that it rocks on and on; that one is dropped again.
int most_restless(const World& world) {
  int part = 0;
  double most = -1.0;
  for (int k = 0; k < world.part_count(); ++k) {
    const PartState state = world.part(k);
    const double speed = state.linear.norm() + kReach * state.angular.norm();
    if (speed > most) {
      most = speed;
      part = k;
    }
  }
  return part;
}

Eigen::Matrix3d yaw(double angle) {
  return Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
}

void scatter(World& world, const SceneSpec& spec, const CellConfig& cell,
             const std::vector<PartModel>& models, Random& random) {
  struct Placed {
    Eigen::Matrix3d R;
    Outline shape;
    Eigen::Vector2d at;
  };
  std::vector<std::vector<Eigen::Vector3d>> rims;
  for (const auto& model : models) rims.push_back(rim(model));
  for (int layout = 0; layout < kLayouts; ++layout) {
    std::vector<Placed> placed;
    for (const auto& vertices : rims) {
      bool found = false;
      for (int attempt = 0; attempt < kPlacements && !found; ++attempt) {
        Eigen::Matrix3d R = yaw(random.uniform(-M_PI, M_PI));
        if (random.below(2)) R = R * Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX());
        Placed p{R, outline(vertices, R), {}};
        // The whole outline stays inside the workspace.
        Eigen::Vector2d low = p.shape.points[0], high = low;
        for (const auto& v : p.shape.points) {
          low = low.cwiseMin(v);
          high = high.cwiseMax(v);
        }
        for (int k = 0; k < 2; ++k)
          p.at[k] = random.uniform(cell.workspace_min[k] - low[k], cell.workspace_max[k] - high[k]);
        found = std::all_of(placed.begin(), placed.end(), [&](const Placed& other) {
          return separated(p.shape, p.at, other.shape, other.at, spec.min_gap);
        });
        if (found) placed.push_back(std::move(p));
      }
      if (!found) break;
    }
    if (placed.size() < models.size()) continue;
    for (std::size_t i = 0; i < models.size(); ++i) {
      Pose T = Pose::Identity();
      T.linear() = placed[i].R;
      T.translation() << placed[i].at, kFlatClearance - lowest(models[i], placed[i].R);
      world.add_part(models[i], T);
    }
    run_until_rest(world, spec.settle_time);
    return;
  }
  throw Error("scene '" + spec.name + "': " + std::to_string(spec.count) +
              " parts do not fit into the workspace with gaps of " + std::to_string(spec.min_gap) +
              " m; lower count or min_gap in scenes.yaml");
}

void stack(World& world, const SceneSpec& spec, const CellConfig& cell,
           const std::vector<PartModel>& models, Random& random) {
  const Eigen::Vector2d center = (cell.workspace_min + cell.workspace_max) / 2;
  const auto drop_pose = [&](int part) {
    double top = 0.0;
    for (int k = 0; k < world.part_count(); ++k)
      if (k != part) {
        const Pose T = world.part(k).T_base_part;
        if (inside(cell, T.translation())) top = std::max(top, highest(models[k], T));
      }
    Pose T = Pose::Identity();
    T.linear() = random.rotation();
    T.translation() << center.x() + random.uniform(-0.5, 0.5) * spec.drop_area.x(),
        center.y() + random.uniform(-0.5, 0.5) * spec.drop_area.y(),
        top + spec.drop_height - lowest(models[part], T.linear());
    return T;
  };
  const long fall = std::lround(spec.drop_interval / world.timestep());
  for (std::size_t i = 0; i < models.size(); ++i) {
    world.add_part(models[i], drop_pose(static_cast<int>(i)));
    for (long s = 0; s < fall; ++s) world.step();
  }
  for (int drop = 0;; ++drop) {
    run_until_rest(world, spec.settle_time);
    std::vector<int> stray;
    for (int k = 0; k < world.part_count(); ++k) {
      const Pose T = world.part(k).T_base_part;
      if (!inside(cell, T.translation()) || highest(models[k], T) > kMaxHeight) stray.push_back(k);
    }
    if (stray.empty() && !world.parts_at_rest()) stray.push_back(most_restless(world));
    if (stray.empty() || drop == kDrops * spec.count) return;
    // One at a time: two dropped into the same place would start inside each other.
    world.set_part_pose(stray.front(), drop_pose(stray.front()));
    for (long s = 0; s < fall; ++s) world.step();
  }
}

}  // namespace

std::vector<std::string> scene_names(const std::string& config_dir) {
  const YamlFile file(config_dir + "/scenes.yaml");
  std::vector<std::string> names;
  for (const auto& entry : file.root()) names.push_back(entry.first.as<std::string>());
  return names;
}

SceneSpec load_scene_spec(const std::string& config_dir, const std::string& name) {
  const YamlFile file(config_dir + "/scenes.yaml");
  const auto names = scene_names(config_dir);
  if (std::find(names.begin(), names.end(), name) == names.end()) {
    std::string known;
    for (const auto& n : names) known += (known.empty() ? "" : ", ") + n;
    throw Error("no scene '" + name + "'; " + config_dir + "/scenes.yaml has " + known);
  }
  SceneSpec spec;
  spec.name = name;
  spec.count = file.get<int>(name + ".count");
  if (spec.count < 1) file.fail(name + ".count", "must be at least 1");
  const auto arrangement = file.get<std::string>(name + ".arrangement");
  spec.families = file.get<std::vector<std::string>>(name + ".families");
  if (arrangement == "scattered") {
    spec.arrangement = Arrangement::kScattered;
    spec.min_gap = file.get<double>(name + ".min_gap");
    if (!(spec.min_gap >= 0)) file.fail(name + ".min_gap", "must not be negative");
  } else if (arrangement == "stacked") {
    spec.arrangement = Arrangement::kStacked;
    spec.drop_area = file.vector(name + ".drop_area", 2);
    spec.drop_height = file.get<double>(name + ".drop_height");
    if (!(spec.drop_area.minCoeff() >= 0)) file.fail(name + ".drop_area", "must not be negative");
    if (!(spec.drop_height > 0)) file.fail(name + ".drop_height", "must be above 0");
  } else {
    file.fail(name + ".arrangement", "must be 'scattered' or 'stacked', not '" + arrangement + "'");
  }
  return spec;
}

std::vector<PartModel> build_scene(World& world, const SceneSpec& spec, const CellConfig& cell,
                                   const std::vector<PartModel>& library, std::uint64_t seed) {
  std::vector<const PartModel*> candidates;
  for (const auto& model : library)
    if (spec.families.empty() || std::find(spec.families.begin(), spec.families.end(),
                                           model.family) != spec.families.end())
      candidates.push_back(&model);
  if (candidates.empty())
    throw Error("scene '" + spec.name + "': the part library holds none of its families");
  Random random(seed);
  std::vector<PartModel> models;
  for (int i = 0; i < spec.count; ++i)
    models.push_back(*candidates[random.below(static_cast<int>(candidates.size()))]);
  world.simulate_robot(false);
  if (spec.arrangement == Arrangement::kScattered)
    scatter(world, spec, cell, models, random);
  else
    stack(world, spec, cell, models, random);
  world.simulate_robot(true);
  return models;
}

}  // namespace iwgnet_grasp::physics
