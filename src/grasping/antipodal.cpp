#include "iwgnet_grasp/grasping/antipodal.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <unordered_map>

#include "iwgnet_grasp/core/yaml.h"
#include "iwgnet_grasp/grasping/height_map.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::grasping {
namespace {

using kinematics::kPadHeight;
using kinematics::kPadWidth;

constexpr double kGravity = 9.81;        // m/s^2
constexpr float kPatchDepth = 0.0005f;   // m, a soft pad yields this much: what lies within touches
constexpr double kCellDistance = 0.004;  // m, candidates closer than this ...
constexpr double kCellAngle = 0.13;      // rad, ... and than this are tried once
constexpr float kRim = 0.002f;           // m around a pad: a part that bulges there meets its edge
constexpr float kBulge = 0.0003f;        // m
constexpr double kSlantShare = 0.5;      // of a face's slant that counts where an edge is gripped
constexpr double kContactSlack = kPadWidth / 2;  // m, contacts may lie beside the pad's middle
constexpr double kShift = 0.004;         // m across the closing direction, what may go wrong on the way
constexpr double kNominalShare = 0.25;   // of the quality that counts at the exact place only
constexpr int kLineSamples = 15;         // pixels looked at along the closing line
constexpr double kOwnShare = 0.3;        // least share of them that shows the part
constexpr double kForeignShare = 0.15;   // most that may show another part
constexpr int kRefinements = 3;              // of the rectangle, until the pads close on its middle:
constexpr double kCenterTolerance = 0.0005;  // m, between the grasp's centre and that of the contacts
constexpr double kUncentred = 0.5;           // least share of the quality that is left beside the middle
constexpr double kWidthTolerance = 0.001;    // m, between the labelled width and the pads' gap
// Contact area and engagement beyond these no longer make a grasp better.
constexpr double kAmpleArea = 0.15;        // share of the pad
constexpr double kAmpleEngagement = 0.018;  // m

struct Facet {
  Eigen::Vector3f a, ab, ac, normal;
};

// Moeller and Trumbore (1997).
std::optional<float> cross(const Facet& facet, const Eigen::Vector3f& origin,
                           const Eigen::Vector3f& direction) {
  const Eigen::Vector3f p = direction.cross(facet.ac);
  const float determinant = facet.ab.dot(p);
  if (std::abs(determinant) < 1e-14f) return {};
  const Eigen::Vector3f s = origin - facet.a;
  const float u = s.dot(p) / determinant;
  if (u < 0.0f || u > 1.0f) return {};
  const Eigen::Vector3f q = s.cross(facet.ab);
  const float v = direction.dot(q) / determinant;
  if (v < 0.0f || u + v > 1.0f) return {};
  return facet.ac.dot(q) / determinant;
}

// The part's surface as the gripper meets it.
struct PosedPart {
  Eigen::MatrixX3f points;   // base_link; a coordinate's values lie side by side
  Eigen::Matrix3Xf normals;  // base_link
  Eigen::Vector3d com;
  float area_per_point;              // m^2
  double freedom;                    // share of a grasp's quality that what rests on it leaves
};

// How two parallel pads touch a part that they squeeze.
struct Squeeze {
  double width;      // m between the pads
  double center;     // m, of the contacts along the closing direction, from the grasp's centre
  double area;       // share of the pad that touches, of the lesser side
  double misfit;     // rad, between the closing direction and the contacts' normals and offset
  double lever;      // m, of the weight about the closing direction
  double com_above;  // m, centre of mass from the contacts, the rest of that distance
  double radius;     // m, half the diagonal of the common contact patch
};

// Middle of the closed finger tips, base_link.
Eigen::Vector3d tips(const GraspPose& pose) {
  const Eigen::Vector3d approach = pose.T_base_tcp.linear().col(2), tcp = pose.T_base_tcp.translation();
  return tcp + approach * ((pose.tip_height - tcp.z()) / approach.z());
}

// shift: m, of the pads across the closing direction.
std::optional<Squeeze> squeeze(const PosedPart& part, const GraspPose& pose, double shift = 0.0) {
  const Eigen::Vector3f along = pose.T_base_tcp.linear().col(0).cast<float>();
  const Eigen::Vector3f across = pose.T_base_tcp.linear().col(1).cast<float>();
  const Eigen::Vector3f up = -pose.T_base_tcp.linear().col(2).cast<float>();
  const Eigen::Vector3f center = tips(pose).cast<float>() + across * static_cast<float>(shift);
  const float half_width = kPadWidth / 2, half_opening = pose.opening / 2;
  thread_local std::vector<std::array<float, 3>> touched;  // along, across, above the tips
  thread_local std::vector<int> index;
  touched.clear();
  index.clear();
  float low = std::numeric_limits<float>::max(), high = -low, rim_low = low, rim_high = high;
  Eigen::Matrix3f axes;
  axes << along, across, up;
  thread_local Eigen::MatrixX3f points;  // along, across, up from the tips
  points = (part.points * axes).rowwise() - center.transpose() * axes;
  const float* const coordinates = points.data();
  const Eigen::Index count = points.rows();
  const float top = static_cast<float>(kPadHeight);
  for (Eigen::Index i = 0; i < count; ++i) {
    const float s = coordinates[i], t = coordinates[count + i], h = coordinates[2 * count + i];
    if (h < -kRim || h > top + kRim || std::abs(t) > half_width + kRim || std::abs(s) > half_opening)
      continue;
    rim_low = std::min(rim_low, s);
    rim_high = std::max(rim_high, s);
    if (h < 0.0f || h > top || std::abs(t) > half_width) continue;
    touched.push_back({s, t, h});
    index.push_back(static_cast<int>(i));
    low = std::min(low, s);
    high = std::max(high, s);
  }
  if (touched.empty()) return {};

  struct Patch {
    int count = 0;
    Eigen::Vector3f normal = Eigen::Vector3f::Zero();
    Eigen::Vector2f low = Eigen::Vector2f::Constant(1.0f), high = Eigen::Vector2f::Constant(-1.0f);
  } patches[2];
  for (std::size_t i = 0; i < touched.size(); ++i) {
    const auto& [s, t, h] = touched[i];
    const auto normal = part.normals.col(index[i]);
    const float facing = normal.dot(along);
    for (int side = 0; side < 2; ++side) {
      const bool touches = side == 0 ? s <= low + kPatchDepth && facing < -0.5f
                                     : s >= high - kPatchDepth && facing > 0.5f;
      if (!touches) continue;
      Patch& patch = patches[side];
      ++patch.count;
      patch.normal += normal;
      patch.low = patch.low.cwiseMin(Eigen::Vector2f(t, h));
      patch.high = patch.high.cwiseMax(Eigen::Vector2f(t, h));
    }
  }
  if (patches[0].count == 0 || patches[1].count == 0) return {};

  Squeeze result;
  result.width = high - low;
  result.center = 0.5 * (high + low);
  result.area = std::min(patches[0].count, patches[1].count) * part.area_per_point /
                (kPadWidth * kPadHeight);
  const Eigen::Vector2f inner_low = patches[0].low.cwiseMax(patches[1].low);
  const Eigen::Vector2f inner_high = patches[0].high.cwiseMin(patches[1].high);
  const double offset = (inner_low - inner_high).cwiseMax(0.0f).norm();
  // A flat pad pushes along the closing direction even on a slanted face, whose outermost edge it
  // meets: the slant then only shows as an offset between the two edges. Where the part bulges
  // beside the pad, though, the pad's own edge meets the face and pushes along its normal.
  const auto slant = [&](int side, bool bulges) {
    const float cosine = (side ? 1 : -1) * patches[side].normal.normalized().dot(along);
    return (bulges ? 1.0 : kSlantShare) * std::acos(std::clamp(cosine, -1.0f, 1.0f));
  };
  result.misfit = std::max({slant(0, rim_low < low - kBulge), slant(1, rim_high > high + kBulge),
                            std::atan2(offset, std::max(result.width, 1e-6))});
  const Eigen::Vector2f middle = 0.5f * (inner_low + inner_high);
  const Eigen::Vector3f com =
      part.com.cast<float>() - (center + across * middle.x() + up * middle.y());
  const Eigen::Vector3f beside = com - along * com.dot(along);
  result.lever = std::abs(com.cross(Eigen::Vector3f::UnitZ()).dot(along));
  result.com_above = std::sqrt(std::max(0.0, beside.squaredNorm() - result.lever * result.lever));
  result.radius = 0.5 * (inner_high - inner_low).cwiseMax(0.0f).norm();
  return result;
}

// Quality in (0, 1]: 1 for a square, deep, roomy grasp at the centre of mass; 0 when it would slip.
double quality_of(const Squeeze& contact, const GraspPose& pose, double mass,
                  const AntipodalConfig& config, const GraspPoseConfig& pose_config) {
  const double cone = std::atan(config.friction);
  if (contact.misfit >= cone || contact.area < config.min_contact_area) return 0.0;
  const double weight = mass * kGravity;
  if (weight > 2 * config.friction * config.grip_force) return 0.0;
  // Torsion that a soft contact bears: mu N 2/3 r, as of a uniformly loaded disk, on both sides.
  const double torque = weight * contact.lever;
  const double bearable =
      2 * config.friction * config.grip_force * 2.0 / 3.0 * std::max(contact.radius, 0.001);
  if (torque >= bearable) return 0.0;
  // A height difference loads the contacts only while the tool accelerates.
  const double distance = std::hypot(contact.lever, 0.5 * contact.com_above);
  const double balance = std::exp(-std::pow(distance / config.com_scale, 2)) * (1 - torque / bearable);
  const double square = 1 - std::pow(contact.misfit / cone, 2);
  const double area = std::min(1.0, contact.area / kAmpleArea);
  const double depth = std::min(1.0, pose.engagement / kAmpleEngagement);
  const double room =
      std::clamp((pose.opening - contact.width) / pose_config.opening_margin, 0.0, 1.0);
  const double centred = 1 - std::min(1.0, std::abs(contact.center) / pose_config.opening_margin);
  return balance * (0.3 + 0.7 * square) * (0.4 + 0.6 * area) * (0.4 + 0.6 * depth) *
         (0.6 + 0.4 * room) * (0.5 + 0.5 * centred) *
         alone_share(pose, contact.width, pose_config);
}

double fold(double theta) {  // into (-pi/2, pi/2]
  while (theta > M_PI / 2) theta -= M_PI;
  while (theta <= -M_PI / 2) theta += M_PI;
  return theta;
}

double angle_between(double a, double b) { return std::abs(fold(a - b)); }

struct Candidate {
  Eigen::Vector2d center, along;  // base_link, m
  double top;                     // m, the higher contact
  double width;                   // m, between the contacts as seen from above
};

class Labeller {
 public:
  Labeller(const cv::Mat& depth, const cv::Mat& instances, const PinholeIntrinsics& camera,
           const Pose& T_base_camera, const CellConfig& cell, const GraspPoseConfig& pose_config,
           const AntipodalConfig& config)
      : depth_(depth), instances_(instances), camera_(camera), T_base_camera_(T_base_camera),
        T_camera_base_(T_base_camera.inverse()), cell_(cell), pose_config_(pose_config),
        config_(config), heights_(depth, camera, T_base_camera, cell) {}

  std::vector<GraspLabel> label(const ScenePart& part, int index,
                                const std::vector<int>& part_of_instance) const {
    const PartGrasps& model = *part.grasps;
    PosedPart posed;
    const Eigen::Isometry3f T = part.T_base_part.cast<float>();
    posed.points = ((T.linear() * model.points).colwise() + T.translation()).transpose();
    posed.normals = T.linear() * model.normals;
    posed.com = part.T_base_part.translation();
    posed.area_per_point = static_cast<float>(model.area / std::max<Eigen::Index>(1, model.points.cols()));
    posed.freedom = std::exp(-part.load / (model.mass * kGravity * config_.load_scale));
    std::vector<GraspLabel> labels;
    // Farther from the centre of mass than this, quality is below the least in any case.
    const double farthest = config_.com_scale * std::sqrt(-std::log(std::min(config_.min_quality, 1.0)));
    for (const Candidate& candidate : candidates(model, T)) {
      const Eigen::Vector2d lever = posed.com.head<2>() - candidate.center;
      const Eigen::Vector2d& along = candidate.along;
      if (std::abs(lever.x() * along.y() - lever.y() * along.x()) > farthest + kContactSlack) continue;
      if (!shows(candidate, part.instance, part_of_instance)) continue;
      if (auto label = evaluate(candidate, posed, model.mass)) {
        label->part = index;
        labels.push_back(std::move(*label));
      }
    }
    return spread(std::move(labels));
  }

 private:
  // Pairs of contacts that a horizontal closing direction can reach, one for each place and angle.
  std::vector<Candidate> candidates(const PartGrasps& model, const Eigen::Isometry3f& T) const {
    std::unordered_map<std::int64_t, Candidate> cells;
    const float max_rise = static_cast<float>(std::sin(config_.max_tilt));
    for (const AntipodalGrasp& grasp : model.grasps) {
      const Eigen::Vector3f a = T * grasp.a, b = T * grasp.b;
      const Eigen::Vector3f line = b - a;
      if (std::abs(line.z()) > max_rise * line.norm()) continue;
      const Eigen::Vector2d along = line.head<2>().cast<double>().normalized();
      const Eigen::Vector2d center = (0.5f * (a + b)).head<2>().cast<double>();
      const double theta = fold(std::atan2(along.y(), along.x()));
      const auto bin = [](double value, double size) {
        return static_cast<std::int64_t>(std::floor(value / size)) & 0xfffff;
      };
      const std::int64_t key = bin(center.x(), kCellDistance) << 40 |
                               bin(center.y(), kCellDistance) << 20 | bin(theta, kCellAngle);
      const Candidate candidate{center, along, std::max(a.z(), b.z()), line.head<2>().norm()};
      const auto [it, fresh] = cells.try_emplace(key, candidate);
      if (!fresh && candidate.top > it->second.top) it->second = candidate;
    }
    std::vector<std::pair<std::int64_t, Candidate>> sorted(cells.begin(), cells.end());
    std::sort(sorted.begin(), sorted.end(),  // the map's order is the library's own
              [](const auto& a, const auto& b) { return a.first < b.first; });
    std::vector<Candidate> result;
    for (const auto& entry : sorted) result.push_back(entry.second);
    return result;
  }

  Eigen::Vector2d pixel(const Eigen::Vector2d& xy, double z) const {
    return sensing::project(camera_, T_camera_base_ * Eigen::Vector3d(xy.x(), xy.y(), z));
  }

  int instance_at(const Eigen::Vector2d& px) const {
    const int u = static_cast<int>(std::lround(px.x())), v = static_cast<int>(std::lround(px.y()));
    if (u < 0 || v < 0 || u >= instances_.cols || v >= instances_.rows) return -1;
    return instances_.ptr<int>(v)[u];
  }

  // The part must be on top between the pads.
  bool shows(const Candidate& candidate, int instance,
             const std::vector<int>& part_of_instance) const {
    int own = 0, foreign = 0;
    for (int i = 0; i < kLineSamples; ++i) {
      const double s = 0.5 * candidate.width * (2.0 * i / (kLineSamples - 1) - 1);
      const int id = instance_at(pixel(candidate.center + candidate.along * s, candidate.top));
      if (id == instance)
        ++own;
      else if (id >= 0 && id < static_cast<int>(part_of_instance.size()) && part_of_instance[id] >= 0)
        ++foreign;
    }
    return own >= kOwnShare * kLineSamples && foreign <= kForeignShare * kLineSamples;
  }

  // The rectangle that leads grasp_pose() to this grasp, and what the pads then hold.
  std::optional<GraspLabel> evaluate(const Candidate& candidate, const PosedPart& posed,
                                     double mass) const {
    GraspLabel label;
    Eigen::Vector2d center = candidate.center;
    double surface = candidate.top, width = candidate.width;
    Squeeze contact;
    for (int i = 0; i < kRefinements; ++i) {
      const Eigen::Vector2d px = pixel(center, surface);
      const Eigen::Vector2d ahead = pixel(center + candidate.along * 0.001, surface) - px;
      const double z = (T_camera_base_ * Eigen::Vector3d(center.x(), center.y(), surface)).z();
      label.rectangle = {px.x(), px.y(), fold(std::atan2(-ahead.y(), ahead.x())),
                         width * camera_.fx / z, 1.0, depth_at(px)};
      label.pose = grasp_pose(label.rectangle, camera_, T_base_camera_, heights_, cell_, pose_config_);
      if (!label.pose.feasible) return {};
      const auto touched = squeeze(posed, label.pose);
      if (!touched) return {};
      contact = *touched;
      // What slips or takes a neighbour along does so wherever between the pads it lies.
      if (i == 0 && posed.freedom * quality_of(contact, label.pose, mass, config_, pose_config_) <
                        config_.min_quality * kUncentred)
        return {};
      const bool settled = std::abs(contact.center) < kCenterTolerance &&
                           std::abs(contact.width - width) < kWidthTolerance;
      if (settled) break;
      const auto& axes = label.pose.T_base_tcp.linear();
      center += axes.col(0).head<2>() * contact.center;
      surface = tips(label.pose).z() - axes(2, 2) * label.pose.engagement;
      width = contact.width;
    }
    if (width < config_.min_width) return {};
    // A shoulder beside the pads makes a grasp that only works at the exact place.
    const double exact = quality_of(contact, label.pose, mass, config_, pose_config_);
    double beside = exact;
    for (const double shift : {-kShift, kShift}) {
      const auto shifted = squeeze(posed, label.pose, shift);
      beside = std::min(beside, shifted ? quality_of(*shifted, label.pose, mass, config_, pose_config_) : 0.0);
    }
    const double quality = posed.freedom * (kNominalShare * exact + (1 - kNominalShare) * beside);
    if (quality < config_.min_quality) return {};
    const double scale = label.rectangle.width_px / label.pose.width;  // px per m at the surface
    label.rectangle.quality = label.pose.quality = quality;
    label.jaw_px = kPadWidth * scale;
    label.opening_px = label.pose.opening * scale;
    return label;
  }

  // Best first; grasps too much like a better one are dropped.
  std::vector<GraspLabel> spread(std::vector<GraspLabel> labels) const {
    std::stable_sort(labels.begin(), labels.end(), [](const auto& a, const auto& b) {
      return a.rectangle.quality > b.rectangle.quality;
    });
    std::vector<GraspLabel> kept;
    for (GraspLabel& label : labels) {
      if (static_cast<int>(kept.size()) >= config_.max_per_part) break;
      const bool alike = std::any_of(kept.begin(), kept.end(), [&](const GraspLabel& other) {
        const double distance = (label.pose.T_base_tcp.translation() -
                                 other.pose.T_base_tcp.translation()).head<2>().norm();
        return distance < config_.nms_distance &&
               angle_between(label.rectangle.theta_rad, other.rectangle.theta_rad) < config_.nms_angle;
      });
      if (!alike) kept.push_back(std::move(label));
    }
    return kept;
  }

  double depth_at(const Eigen::Vector2d& px) const {
    const int u = static_cast<int>(std::lround(px.x())), v = static_cast<int>(std::lround(px.y()));
    if (u < 0 || v < 0 || u >= depth_.cols || v >= depth_.rows)
      return std::numeric_limits<double>::quiet_NaN();
    return depth_.ptr<float>(v)[u];
  }

  const cv::Mat &depth_, &instances_;
  const PinholeIntrinsics& camera_;
  const Pose T_base_camera_, T_camera_base_;
  const CellConfig& cell_;
  const GraspPoseConfig& pose_config_;
  const AntipodalConfig& config_;
  const HeightMap heights_;
};

std::uint64_t next_random(std::uint64_t& state) {  // SplitMix64
  std::uint64_t x = state += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

float uniform(std::uint64_t& state) { return static_cast<float>(next_random(state) >> 40) / (1 << 24); }

}  // namespace

AntipodalConfig load_antipodal_config(const std::string& config_dir) {
  const YamlFile file(config_dir + "/grasping.yaml");
  AntipodalConfig config;
  const auto positive = [&](const std::string& key) {
    const double value = file.get<double>("labels." + key);
    if (!(value > 0)) file.fail("labels." + key, "must be positive");
    return value;
  };
  config.surface_samples = static_cast<int>(positive("surface_samples"));
  config.friction = positive("friction");
  const YamlFile motion(config_dir + "/motion.yaml");
  config.grip_force = motion.get<double>("grip_force");
  if (!(config.grip_force > 0)) motion.fail("grip_force", "must be positive");
  config.min_width = positive("min_width");
  config.max_tilt = positive("max_tilt");
  config.min_contact_area = positive("min_contact_area");
  config.com_scale = positive("com_scale");
  config.load_scale = positive("load_scale");
  config.min_quality = positive("min_quality");
  config.nms_distance = positive("nms_distance");
  config.nms_angle = positive("nms_angle");
  config.max_per_part = static_cast<int>(positive("max_per_part"));
  config.seed = file.get<std::uint64_t>("labels.seed");
  return config;
}

PartGrasps find_antipodal_grasps(const TriangleMesh& mesh, double mass,
                                 const AntipodalConfig& config, double max_width) {
  std::vector<Facet> facets;
  std::vector<double> cumulative;
  double area = 0.0;
  for (const auto& [i, j, k] : mesh.triangles) {
    const Eigen::Vector3f ab = mesh.vertices[j] - mesh.vertices[i];
    const Eigen::Vector3f ac = mesh.vertices[k] - mesh.vertices[i];
    const Eigen::Vector3f product = ab.cross(ac);
    if (!(product.norm() > 0.0f)) continue;
    facets.push_back({mesh.vertices[i], ab, ac, product.stableNormalized()});
    cumulative.push_back(area += 0.5 * product.norm());
  }
  if (facets.empty()) throw Error("grasps of a part: its mesh has no area");

  PartGrasps result;
  result.mass = mass;
  result.area = area;
  result.points.resize(3, config.surface_samples);
  result.normals.resize(3, config.surface_samples);
  const float cone = std::cos(std::atan(static_cast<float>(config.friction)));
  std::uint64_t state = config.seed;
  for (int i = 0; i < config.surface_samples; ++i) {
    const double target = (i + uniform(state)) / config.surface_samples * area;
    const auto index = std::min<std::size_t>(
        std::lower_bound(cumulative.begin(), cumulative.end(), target) - cumulative.begin(),
        facets.size() - 1);
    const Facet& facet = facets[index];
    float u = uniform(state), v = uniform(state);
    if (u + v > 1.0f) u = 1.0f - u, v = 1.0f - v;
    const Eigen::Vector3f a = facet.a + facet.ab * u + facet.ac * v;
    result.points.col(i) = a;
    result.normals.col(i) = facet.normal;

    // Pads come from outside: nothing may lie before the first contact, and the second is where
    // the line leaves the part for good, beyond any bore.
    const Eigen::Vector3f inwards = -facet.normal;
    float farthest = 0.0f, nearest = 0.0f;
    const Facet* exit = nullptr;
    for (std::size_t f = 0; f < facets.size(); ++f) {
      if (f == index) continue;
      const auto distance = cross(facets[f], a, inwards);
      if (!distance) continue;
      nearest = std::min(nearest, *distance);
      if (*distance > farthest) {
        farthest = *distance;
        exit = &facets[f];
      }
    }
    if (!exit || nearest < -1e-5f || farthest < config.min_width || farthest > max_width) continue;
    if (exit->normal.dot(inwards) < cone) continue;
    result.grasps.push_back({a, a + inwards * farthest});
  }
  return result;
}

std::vector<GraspLabel> label_grasps(const std::vector<ScenePart>& parts, const cv::Mat& depth,
                                     const cv::Mat& instances, const PinholeIntrinsics& camera,
                                     const Pose& T_base_camera, const CellConfig& cell,
                                     const GraspPoseConfig& pose_config,
                                     const AntipodalConfig& config) {
  if (instances.type() != CV_32SC1 || instances.size() != depth.size())
    throw Error("grasp labels: needs a 32SC1 instance image of the depth image's size");
  int highest = -1;
  for (const ScenePart& part : parts) highest = std::max(highest, part.instance);
  std::vector<int> part_of_instance(highest + 1, -1);
  for (std::size_t i = 0; i < parts.size(); ++i)
    if (parts[i].instance >= 0) part_of_instance[parts[i].instance] = static_cast<int>(i);
  const Labeller labeller(depth, instances, camera, T_base_camera, cell, pose_config, config);
  std::vector<GraspLabel> labels;
  for (std::size_t i = 0; i < parts.size(); ++i) {
    if (parts[i].instance < 0) continue;
    auto own = labeller.label(parts[i], static_cast<int>(i), part_of_instance);
    std::move(own.begin(), own.end(), std::back_inserter(labels));
  }
  return labels;
}

}  // namespace iwgnet_grasp::grasping
