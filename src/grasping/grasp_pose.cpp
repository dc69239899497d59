#include "iwgnet_grasp/grasping/grasp_pose.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <limits>

#include "iwgnet_grasp/core/yaml.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/sensing/pinhole.h"

namespace iwgnet_grasp::grasping {
namespace {

using kinematics::finger_tip_height;

constexpr double kStep = 0.001;           // m, between the depths and the gaps that are tried
constexpr double kLineHalfWidth = 0.005;  // m, of the band along the closing line that is measured
constexpr double kSurfaceShare = 0.8;     // of the band's heights lie below what counts as surface
// Fingers are looked for outside this share of the predicted width; nearer to the centre a free
// place is a bore or a recess of the object itself.
constexpr double kCoreShare = 0.7;
// Slope of the object's upper side.
constexpr double kPatchHalf = 0.012;      // m across the closing line, of the patch that is fitted
constexpr float kPlaneTolerance = 0.0015f;  // m, 3 sigma of depth
constexpr double kPlaneBelow = 0.008;     // m, a plane this far under the surface is something else
constexpr double kPlaneShare = 0.3;       // least share of the patch that must lie in the plane
constexpr float kSliver = 1e-5f;          // m^2, area seen from above of three points that give no plane
constexpr int kPlaneTrials = 200;
constexpr double kGoesOn = 0.004;         // m from where a straight upper side would be
constexpr double kBetween = 0.010;        // m beside the middle between the pads: an object between them lies nearer
constexpr double kShank = 0.03;           // m, up to this width nothing slides out of the fingers
constexpr double kSnug = 0.006;           // m, cells of the height map, noise of the network's width
constexpr double kSideShare = 0.4;        // of the overlap of finger and object, up from the tips: where the
                                          // object's side is measured
constexpr double kAmpleShare = 0.5;       // of the pad's width that touches: more is no better
constexpr double kTouchless = 0.2;        // of the quality that is left where nothing seems to touch: the
                                          // camera sees sides badly
constexpr double kViewAlong = 0.08, kViewAcross = 0.04;  // m around a grasp, what the gripper's body reaches
constexpr double kPitchScale = 3.0;       // a part that leans along the pads is held as flat: its
                                          // angle counts by so much less

struct GraspAxes {
  Eigen::Vector2d center, along, across;  // base_link, m
};

Eigen::Vector3d to_base(const PinholeIntrinsics& camera, const Pose& T, double u, double v, double z) {
  return T * sensing::deproject(camera, u, v, z);
}

// The point at height z on the pixel's line of sight.
Eigen::Vector3d at_height(const PinholeIntrinsics& camera, const Pose& T, double u, double v,
                          double z) {
  const Eigen::Vector3d ray = T.rotation() * sensing::deproject(camera, u, v, 1.0);
  return T.translation() + ray * ((z - T.translation().z()) / ray.z());
}

GraspAxes axes_at(const GraspRectangle& grasp, const PinholeIntrinsics& camera, const Pose& T,
                  double height) {
  // Image rows grow downwards: a counter-clockwise angle turns towards smaller rows.
  const double du = std::cos(grasp.theta_rad), dv = -std::sin(grasp.theta_rad);
  const Eigen::Vector3d p = at_height(camera, T, grasp.x_px, grasp.y_px, height);
  const Eigen::Vector3d q = at_height(camera, T, grasp.x_px + du, grasp.y_px + dv, height);
  GraspAxes axes;
  axes.center = p.head<2>();
  axes.along = (q - p).head<2>().normalized();
  axes.across = {-axes.along.y(), axes.along.x()};
  return axes;
}

// Height of the object's surface along the closing line over the grasp's width.
double surface_height(const HeightMap& heights, const GraspAxes& axes, double width) {
  const double step = heights.resolution();
  const int n = std::max(1, static_cast<int>(width / 2 / step));
  const int m = std::max(1, static_cast<int>(kLineHalfWidth / step));
  thread_local std::vector<double> samples;
  samples.clear();
  samples.reserve((2 * n + 1) * (2 * m + 1));
  for (int i = -n; i <= n; ++i)
    for (int j = -m; j <= m; ++j) {
      const Eigen::Vector2d p = axes.center + axes.along * (i * step) + axes.across * (j * step);
      samples.push_back(heights.at(p.x(), p.y()));
    }
  const auto rank = samples.begin() + static_cast<std::ptrdiff_t>(kSurfaceShare * (samples.size() - 1));
  std::nth_element(samples.begin(), rank, samples.end());
  return *rank;
}

// The lowest point of a finger's outer side, above its tip, at a distance outwards from its face.
double underside(const GraspPoseConfig& config, double outwards) {
  if (outwards <= config.finger_thickness) return 0.0;
  Eigen::Vector2d before(config.finger_thickness, 0.0);
  for (const Eigen::Vector2d& corner : config.finger_outline) {
    if (outwards <= corner.x())
      return before.y() + (corner.y() - before.y()) * (outwards - before.x()) /
                              (corner.x() - before.x());
    before = corner;
  }
  return std::numeric_limits<double>::infinity();
}

// Gaps are tried in steps of kStep; index i is the gap i * kStep.
int steps(double metres) { return static_cast<int>(std::floor(metres / kStep + 1e-9)); }

// finger_tip_height() of each gap.
const std::vector<double>& tip_heights() {
  static const auto table = [] {
    std::vector<double> heights;
    for (int i = 0; i * kStep <= kinematics::max_gap() + kStep; ++i)
      heights.push_back(finger_tip_height(i * kStep));
    return heights;
  }();
  return table;
}

// m, how far the tips sink at most when the fingers close on from a gap.
double sinks_from(int gap) {
  const auto& heights = tip_heights();
  return *std::max_element(heights.begin(), heights.begin() + gap + 1) - heights[gap];
}

// How high the tips must stand so that both fingers clear what lies beside the grasp's centre, at
// any gap. A finger meets the highest point over the pad's width and some play.
class Clearance {
 public:
  // floor: no tip goes below it.
  Clearance(const HeightMap& heights, const GraspAxes& axes, const GraspPoseConfig& config,
            int first_gap, int last_gap, double floor)
      : config_(config), step_(heights.resolution()), floor_(floor), first_gap_(first_gap),
        lowest_(std::max(0, last_gap - first_gap + 1), kUnasked) {
    const double half = kinematics::kPadWidth / 2 + config.side_clearance;
    const double reach = config.finger_outline.empty() ? config.finger_thickness
                                                       : config.finger_outline.back().x();
    const int across = static_cast<int>(std::ceil(half / step_));
    first_ = static_cast<int>(std::ceil(first_gap * kStep / 2 / step_));
    const int last = static_cast<int>(std::ceil((last_gap * kStep / 2 + reach) / step_));
    for (int i = first_; i <= last; ++i) {
      double highest = floor;
      for (const int side : {-1, 1}) {
        const Eigen::Vector2d p = axes.center + axes.along * (side * i * step_);
        for (int j = -across; j <= across; ++j) {
          const Eigen::Vector2d q = p + axes.across * (half * j / across);
          highest = std::max(highest, heights.at(q.x(), q.y()));
        }
      }
      profile_.push_back(highest);
    }
  }

  int first_gap() const { return first_gap_; }
  int last_gap() const { return first_gap_ + static_cast<int>(lowest_.size()) - 1; }

  // Whether both fingers stand free at `gap` when their tips come to `tip` once the gap is `closed`.
  bool free(double tip, int closed, int gap) {
    double& lowest = lowest_[gap - first_gap_];
    if (lowest == kUnasked) lowest = lowest_tips(gap);
    return lowest <= tip + tip_heights_[closed] - tip_heights_[gap] + 1e-9;
  }

 private:
  static constexpr double kUnasked = -std::numeric_limits<double>::infinity();

  double lowest_tips(int gap) const {
    const double face = gap * kStep / 2;
    double lowest = floor_;
    const int last = first_ + static_cast<int>(profile_.size()) - 1;
    for (int i = static_cast<int>(std::ceil(face / step_ - 1e-9)); i <= last; ++i) {
      const double rise = underside(config_, i * step_ - face);
      if (!std::isfinite(rise)) break;
      lowest = std::max(lowest, profile_[i - first_] - rise);
    }
    return lowest + config_.floor_clearance;
  }

  const GraspPoseConfig& config_;
  const std::vector<double>& tip_heights_ = tip_heights();
  double step_, floor_;
  int first_gap_, first_;
  std::vector<double> profile_;  // m, the higher of both sides, from first_ steps beside the centre on
  std::vector<double> lowest_;   // of each gap, once it was asked for
};

std::string millimetres(double metres) {
  char text[32];
  std::snprintf(text, sizeof text, "%.0f mm", metres * 1e3);
  return text;
}

struct Descent {
  bool found = false;
  // m: tips' height once closed, that gap, gap to approach with, least gap at which both fingers
  // stand free, tips below the surface at that gap
  double tip, closed, opening, contact, engaged;
};

// Share of the quality that is left when the fingers stand wider than the object: what lies between
// them is not the object alone. contact: m between them where they are free; rise: of the closing
// direction, per metre.
double alone(double contact, double width, double engaged, double rise, const GraspPoseConfig& config) {
  // What lies below the upper edge of a leaning object is hidden, not necessarily taken.
  const double roll = std::asin(std::clamp(rise, -1.0, 1.0));
  const double hidden = 2 * engaged * std::abs(std::tan(roll));
  const double beside = std::max(0.0, contact - width - hidden - kSnug) / config.spread_scale;
  return std::exp(-beside * beside);
}

// Position of the tips at which both fingers find room, `deepest` (m) below the surface at most: as
// deep as there is room close to the object, at one of the clearance's gaps. `floor` is the table's
// height; rise as for alone().
Descent descend(Clearance& clearance, const GraspPoseConfig& config, double surface, double width,
                double floor, double deepest, double rise) {
  const int first = clearance.first_gap(), widest = clearance.last_gap();
  const int margin = steps(config.opening_margin);
  const int play = static_cast<int>(std::ceil(2 * config.side_clearance / kStep - 1e-9));
  const int expected = steps(width);
  const auto& heights = tip_heights();
  Descent best;
  double most = -1.0;
  for (double engaged = deepest; engaged >= config.min_engagement - 1e-9;
       engaged -= kStep) {
    const double shallow = (config.insertion_depth - engaged) / config.shallow_scale;
    const double share = std::exp(-shallow * shallow);
    if (share <= most) break;  // no place beside the object could make up for it
    const double tip = surface - engaged;
    // Contact: the nearest place to the centre where both fingers stand free.
    int contact = first;
    while (contact <= widest && !clearance.free(tip, contact, contact)) ++contact;
    if (contact > widest) continue;
    // Beside a shoulder of the object they may still close to the expected width, and sink.
    const int closed = std::min(contact, expected);
    const double lowest = tip - (heights[closed] - heights[contact]);
    // What slides out of wide open fingers lets them close, and sink.
    if (lowest - sinks_from(closed) < floor + config.floor_clearance) continue;
    int opening = contact;
    while (opening + 1 <= std::min(widest, contact + margin) &&
           clearance.free(tip, contact, opening + 1))
      ++opening;
    if (opening < contact + play) continue;
    const double worth = share * alone(contact * kStep, width, engaged, rise, config);
    if (worth > most) {
      most = worth;
      best = {true, lowest, closed * kStep, opening * kStep, contact * kStep, engaged};
    }
  }
  return best;
}

// Stages 1 and 2: where the grasp lies in the base frame. pose.reason says why it has no place.
struct Located {
  GraspPose pose;  // width and quality
  GraspAxes axes;
  double surface = 0.0;  // m over the table
};

Located locate(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
               const Pose& T_base_camera, const HeightMap& heights, const CellConfig& cell,
               const GraspPoseConfig& config) {
  Located located;
  GraspPose& pose = located.pose;
  GraspAxes& axes = located.axes;
  pose.quality = grasp.quality;
  const auto infeasible = [&](std::string reason) {
    pose.reason = std::move(reason);
    return located;
  };
  const bool finite = std::isfinite(grasp.x_px) && std::isfinite(grasp.y_px) &&
                      std::isfinite(grasp.theta_rad) && std::isfinite(grasp.width_px);
  if (!finite || grasp.width_px <= 0) return infeasible("grasp has no position, angle or width");
  if (grasp.x_px < 0 || grasp.y_px < 0 || grasp.x_px > camera.width - 1 ||
      grasp.y_px > camera.height - 1)
    return infeasible("grasp lies outside the image");
  if (heights.grid().empty()) return infeasible("no depth: the height map is empty");

  // Pixel -> camera -> base. The measured depth starts the search for the surface; the height map
  // then replaces it where it is missing, noisy or looks through a bore.
  const bool measured = std::isfinite(grasp.depth_m) && grasp.depth_m > 0;
  double surface = measured ? to_base(camera, T_base_camera, grasp.x_px, grasp.y_px, grasp.depth_m).z()
                            : config.min_engagement + config.floor_clearance;
  for (int i = 0; i < 3; ++i) {
    axes = axes_at(grasp, camera, T_base_camera, surface);
    const double depth =
        (T_base_camera.inverse() * Eigen::Vector3d(axes.center.x(), axes.center.y(), surface)).z();
    if (!(depth > 0)) return infeasible("the surface at the grasp is not in front of the camera");
    pose.width = width_in_metres(grasp.width_px, depth, camera.fx);
    surface = surface_height(heights, axes, std::min(pose.width, config.max_opening));
  }
  axes = axes_at(grasp, camera, T_base_camera, surface);
  located.surface = surface;
  const Eigen::Vector2d low = cell.workspace_min.array() - config.border;
  const Eigen::Vector2d high = cell.workspace_max.array() + config.border;
  if ((axes.center.array() < low.array()).any() || (axes.center.array() > high.array()).any())
    return infeasible("grasp lies outside the workspace");
  if (pose.width > config.max_opening)
    return infeasible("object is " + millimetres(pose.width) + " wide there, the gripper opens " +
                      millimetres(config.max_opening));
  if (surface < config.min_engagement + config.floor_clearance)
    return infeasible("nothing high enough to grip at the grasp point: surface is " +
                      millimetres(surface) + " above the table");
  return located;
}

// How well the pads will touch the measured object, in [0, 1]: the share of the pad's width, on the
// side where it is less, over which the object's side stands as far out as it does anywhere, and how
// far the two sides' places lie apart. A shoulder or a corner between the pads makes one side touch
// at its edge, and the part turns. tip: m, height of the tips.
double contact_share(const HeightMap& heights, const GraspAxes& axes, double surface, double tip,
                     double opening) {
  const double step = heights.resolution();
  const double level = tip + kSideShare * (surface - tip);
  const int rows = static_cast<int>(kinematics::kPadWidth / 2 / step);
  const int outermost = static_cast<int>(opening / 2 / step);
  double share = 1.0, place[2] = {0.0, 0.0};
  for (const int side : {0, 1}) {
    std::vector<int> reach;  // steps from the middle to the object's side, each row of the pad
    for (int j = -rows; j <= rows; ++j) {
      int out = outermost;
      const auto solid = [&](int i) {
        const Eigen::Vector2d p = axes.center + axes.along * ((side ? i : -i) * step) + axes.across * (j * step);
        return heights.at(p.x(), p.y()) > level;
      };
      while (out > 0 && !solid(out)) --out;
      reach.push_back(out);
    }
    const int farthest = *std::max_element(reach.begin(), reach.end());
    int count = 0;
    for (int j = -rows; j <= rows; ++j)
      if (reach[j + rows] > 0 && reach[j + rows] >= farthest - 1) {
        ++count;
        place[side] += j * step;
      }
    if (count == 0) return 0.0;
    place[side] /= count;
    share = std::min(share, static_cast<double>(count) / reach.size());
  }
  const double apart = (place[0] - place[1]) / (kinematics::kPadWidth / 2);
  return std::min(1.0, share / kAmpleShare) * std::exp(-apart * apart);
}

// Stage 3: depth and opening, in a frame whose z axis points back along the approach. heights, axes
// and surface are seen in it.
void lower(GraspPose& pose, const Pose& T_base_view, const HeightMap& heights,
           const GraspAxes& axes, double surface, double floor, const GraspPoseConfig& config) {
  const auto infeasible = [&](std::string reason) { pose.reason = std::move(reason); };
  const double yaw = std::atan2(axes.along.y(), axes.along.x());
  // m that the body lacks over what lies below it. The tool does not move while the fingers close:
  // the opening to approach with measures it.
  const auto lack = [&](const Descent& d) {
    const double open_tip = d.tip + finger_tip_height(d.closed) - finger_tip_height(d.opening);
    double most = 0.0;
    const auto over = [&](const Eigen::Vector2d& half, double underside) {
      if (heights.highest() + config.floor_clearance <= underside) return;
      const double highest = heights.max_in(axes.center, yaw, half) + config.floor_clearance;
      most = std::max(most, highest - underside);
    };
    over(config.palm.half, open_tip + finger_tip_height(d.opening) - config.palm.reach);
    for (const FingerBody& body : config.fingers)
      over({body.along + body.spread * d.opening, body.across}, open_tip + body.above_tips);
    return most;
  };
  const double rise = (T_base_view.linear() * Eigen::Vector3d(axes.along.x(), axes.along.y(), 0.0)).z();
  Clearance clearance(heights, axes, config, steps(kCoreShare * pose.width),
                      steps(config.max_opening), floor);
  const auto down_to = [&](double deepest) {
    return descend(clearance, config, surface, pose.width, floor, deepest, rise);
  };
  Descent descent = down_to(config.insertion_depth);
  if (!descent.found) return infeasible("fingers find no room beside the object");
  // A part beside the object may keep the body up: the fingers then hold less of it.
  for (double missing = lack(descent); missing > 0; missing = lack(descent)) {
    const double deepest = descent.engaged - std::max(missing, kStep);
    descent = down_to(deepest);
    if (!descent.found)
      return infeasible("the gripper's body would touch what lies beside the object");
  }

  pose.touch = contact_share(heights, axes, surface, descent.tip, descent.opening);
  pose.opening = descent.opening;
  pose.width = std::min(pose.width, pose.opening);  // the network's may be wider than what is measured
  pose.contact = descent.contact;
  pose.engagement = surface - descent.tip;
  const double tool_height = descent.tip + finger_tip_height(descent.closed);
  Pose T_view_tcp = Pose::Identity();
  T_view_tcp.translation() << axes.center, tool_height - kinematics::pad_center_height(pose.width);
  T_view_tcp.linear().col(0) << axes.along, 0.0;
  T_view_tcp.linear().col(1) << axes.along.y(), -axes.along.x(), 0.0;
  T_view_tcp.linear().col(2) << 0.0, 0.0, -1.0;
  pose.T_base_tcp = T_base_view * T_view_tcp;
  pose.tip_height = (T_base_view * Eigen::Vector3d(axes.center.x(), axes.center.y(), descent.tip)).z();
  pose.feasible = true;
  pose.reason.clear();
}

}  // namespace

GraspPoseConfig load_grasp_pose_config(const std::string& config_dir) {
  const YamlFile file(config_dir + "/grasping.yaml");
  GraspPoseConfig config;
  const auto positive = [&](const std::string& key) {
    const double value = file.get<double>("pose." + key);
    if (!(value > 0)) file.fail("pose." + key, "must be positive");
    return value;
  };
  config.opening_margin = positive("opening_margin");
  config.side_clearance = positive("side_clearance");
  config.max_opening = positive("max_opening");
  config.insertion_depth = positive("insertion_depth");
  config.min_engagement = positive("min_engagement");
  config.floor_clearance = positive("floor_clearance");
  config.border = file.get<double>("pose.border");
  config.max_roll = positive("max_roll");
  config.max_pitch = positive("max_pitch");
  config.min_tilt = positive("min_tilt");
  config.misalignment_scale = positive("misalignment_scale");
  config.spread_scale = positive("spread_scale");
  config.shallow_scale = positive("shallow_scale");
  config.shifts = file.get<std::vector<double>>("pose.shifts");
  config.shift_scale = positive("shift_scale");
  config.lever_scale = positive("lever_scale");
  config.hang_scale = positive("hang_scale");
  config.overhang_scale = positive("overhang_scale");
  config.width_scale = positive("width_scale");
  config.finger_thickness = positive("finger_thickness");
  if (config.min_engagement > config.insertion_depth)
    file.fail("pose.min_engagement", "must not exceed insertion_depth");
  if (config.max_opening > kinematics::max_gap() + 1e-6)
    file.fail("pose.max_opening", "exceeds what the gripper's linkage allows");
  double last = config.finger_thickness;
  for (const auto& corner : file.get<std::vector<std::vector<double>>>("pose.finger_outline")) {
    if (corner.size() != 2 || corner[0] <= last)
      file.fail("pose.finger_outline", "needs pairs [outwards, above the tip], outwards increasing");
    config.finger_outline.emplace_back(corner[0], corner[1]);
    last = corner[0];
  }
  for (const auto& body : file.node("pose.finger_bodies")) {
    try {
      const auto along = body["along"].as<std::vector<double>>();
      config.fingers.push_back({along.at(0), along.at(1), body["across"].as<double>(),
                                body["above_tips"].as<double>()});
    } catch (const std::exception&) {
      file.fail("pose.finger_bodies",
                "needs entries {along: [closed, per opening], across: half, above_tips: height}");
    }
  }
  config.palm.half = {positive("palm.along"), positive("palm.across")};
  config.palm.reach = positive("palm.reach");
  return config;
}

double width_in_metres(double width_px, double depth_m, double fx_px) {
  return depth_m * width_px / fx_px;
}

// RANSAC (Fischler and Bolles 1981), then least squares.
Slope surface_slope(const HeightMap& heights, const Eigen::Vector2d& center,
                    const Eigen::Vector2d& along, double surface, double width, double max_along,
                    double max_across) {
  const Eigen::Vector2d across(-along.y(), along.x());
  const double step = heights.resolution();
  const int n = std::max(2, static_cast<int>(width / 2 / step));
  const int m = static_cast<int>(kPatchHalf / step);
  // Points: m along, across, over the surface.
  const int count = (2 * n + 1) * (2 * m + 1);
  Eigen::ArrayXf xs(count), ys(count), zs(count);
  for (int i = -n, k = 0; i <= n; ++i)
    for (int j = -m; j <= m; ++j, ++k) {
      const Eigen::Vector2d p = center + along * (i * step) + across * (j * step);
      xs[k] = i * step;
      ys[k] = j * step;
      zs[k] = heights.at(p.x(), p.y()) - surface;
    }
  std::uint32_t state = 1;
  const auto draw = [&] {  // Numerical Recipes' linear congruential generator
    state = state * 1664525u + 1013904223u;
    const auto i = (static_cast<std::uint64_t>(state) * count) >> 32;
    return Eigen::Vector3f(xs[i], ys[i], zs[i]);
  };
  Eigen::Vector3f best = Eigen::Vector3f::Zero();  // slopes and height at the grasp
  int most = 0;
  const auto lies_in = [&](const Eigen::Vector3f& plane, int i) {
    return std::abs(plane.x() * xs[i] + plane.y() * ys[i] + plane.z() - zs[i]) < kPlaneTolerance;
  };
  for (int trial = 0; trial < kPlaneTrials; ++trial) {
    const Eigen::Vector3f a = draw(), b = draw(), c = draw();
    const Eigen::Vector3f normal = (b - a).cross(c - a);
    if (std::abs(normal.z()) < kSliver) continue;
    Eigen::Vector3f plane(-normal.x() / normal.z(), -normal.y() / normal.z(), 0.0f);
    plane.z() = a.z() - plane.x() * a.x() - plane.y() * a.y();
    if (std::abs(plane.x()) > max_along || std::abs(plane.y()) > max_across || plane.z() < -kPlaneBelow)
      continue;
    const auto inliers = static_cast<int>(
        ((plane.x() * xs + plane.y() * ys + plane.z() - zs).abs() < kPlaneTolerance).count());
    if (inliers > most) {
      most = inliers;
      best = plane;
    }
  }
  if (most < kPlaneShare * count) return {};
  for (int pass = 0; pass < 2; ++pass) {
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    for (int i = 0; i < count; ++i) {
      if (!lies_in(best, i)) continue;
      const Eigen::Vector3d row(xs[i], ys[i], 1.0);
      normal += row * row.transpose();
      right += row * zs[i];
    }
    best = normal.ldlt().solve(right).cast<float>();
  }
  if (!best.allFinite() || std::abs(best.x()) > max_along || std::abs(best.y()) > max_across) return {};
  return {best.x(), best.y()};
}

namespace {

// The located grasp with an approach that follows the object's surface.
GraspPose leaning(const Located& located, const Slope& slope, const HeightMap& heights,
                  const GraspPoseConfig& config) {
  const double roll = std::atan(slope.along), pitch = std::atan(slope.across);

  struct Lean {
    double roll, pitch, quality;
  };
  std::vector<Lean> leans;
  const auto add = [&](double roll_share, double pitch_share) {
    const double roll_left = (1 - roll_share) * roll, pitch_left = (1 - pitch_share) * pitch / kPitchScale;
    const double left = std::hypot(roll_left, pitch_left) / config.misalignment_scale;
    leans.push_back({roll_share * roll, pitch_share * pitch, std::exp(-left * left)});
  };
  const bool rolled = std::abs(roll) > config.min_tilt, pitched = std::abs(pitch) > config.min_tilt;
  for (const double roll_share : {1.0, 0.5, 0.0})
    for (const double pitch_share : {1.0, 0.5, 0.0})
      if ((rolled || roll_share == 0.0) && (pitched || pitch_share == 0.0)) add(roll_share, pitch_share);
  std::stable_sort(leans.begin(), leans.end(),
                   [](const Lean& a, const Lean& b) { return a.quality > b.quality; });

  const Eigen::Vector3d at(located.axes.center.x(), located.axes.center.y(), located.surface);
  GraspPose best, first;
  for (const Lean& lean : leans) {
    GraspPose pose = located.pose;
    pose.quality *= lean.quality;
    if (best.feasible && pose.quality <= best.quality) break;  // nor can those after it be better
    if (lean.roll == 0.0 && lean.pitch == 0.0) {
      lower(pose, Pose::Identity(), heights, located.axes, located.surface, 0.0, config);
    } else {
      // x along the closing direction and y along the pads, both in the surface.
      Pose T_base_view(Eigen::Translation3d(at.x(), at.y(), at.z()));
      const Eigen::Vector3d x(located.axes.along.x(), located.axes.along.y(), std::tan(lean.roll));
      const Eigen::Vector3d y(located.axes.across.x(), located.axes.across.y(), std::tan(lean.pitch));
      T_base_view.linear().col(0) = x.normalized();
      T_base_view.linear().col(2) = x.cross(y).normalized();
      T_base_view.linear().col(1) = T_base_view.linear().col(2).cross(T_base_view.linear().col(0));
      const HeightMap view = heights.seen_from(T_base_view, {kViewAlong, kViewAcross});
      const GraspAxes axes{{0, 0}, {1, 0}, {0, 1}};
      const double surface = surface_height(view, axes, std::min(pose.width, config.max_opening));
      const double table = -at.z() / T_base_view.linear()(2, 2);
      lower(pose, T_base_view, view, axes, surface, table, config);
    }
    if (pose.feasible) {
      const double wide = std::max(0.0, pose.width - kShank) / config.width_scale;
      pose.quality *= alone_share(pose, pose.width, config) *
                      (kTouchless + (1 - kTouchless) * pose.touch) * std::exp(-wide * wide);
      if (!best.feasible || pose.quality > best.quality) best = std::move(pose);
    } else if (first.reason.empty()) {
      first = std::move(pose);
    }
  }
  return best.feasible ? best : first;
}

Slope slope_of(const Located& located, const HeightMap& heights, const GraspPoseConfig& config) {
  return surface_slope(heights, located.axes.center, located.axes.along, located.surface,
                       std::min(located.pose.width, config.max_opening), std::tan(config.max_roll),
                       std::tan(config.max_pitch));
}

}  // namespace

double alone_share(const GraspPose& pose, double width, const GraspPoseConfig& config) {
  return alone(pose.contact, width, pose.engagement, pose.T_base_tcp.linear()(2, 0), config);
}

GraspPose grasp_pose(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
                     const Pose& T_base_camera, const HeightMap& heights, const CellConfig& cell,
                     const GraspPoseConfig& config) {
  const Located located = locate(grasp, camera, T_base_camera, heights, cell, config);
  if (!located.pose.reason.empty()) return located.pose;
  return leaning(located, slope_of(located, heights, config), heights, config);
}

GraspPose aligned_grasp_pose(const GraspRectangle& grasp, const PinholeIntrinsics& camera,
                             const Pose& T_base_camera, const HeightMap& heights,
                             const CellConfig& cell, const GraspPoseConfig& config,
                             const std::optional<Eigen::Vector3d>& centroid) {
  const Located located = locate(grasp, camera, T_base_camera, heights, cell, config);
  if (!located.pose.reason.empty()) return located.pose;
  const auto with_lever = [&](GraspPose pose) {
    if (!pose.feasible || !centroid) return pose;
    const Eigen::Vector3d away =
        pose.T_base_tcp.linear().transpose() * (*centroid - pose.T_base_tcp.translation());
    const double lever = away.y() / config.lever_scale, hang = std::max(0.0, away.z()) / config.hang_scale;
    const double overhang = std::max(0.0, std::abs(away.x()) - kBetween) / (config.overhang_scale * pose.engagement);
    pose.quality *= std::exp(-lever * lever - hang * hang - overhang * overhang);
    return pose;
  };
  const double width = std::min(located.pose.width, config.max_opening);
  const Slope slope = slope_of(located, heights, config);
  GraspPose best = with_lever(leaning(located, slope, heights, config));
  // A rim goes on round the hole, not straight along the pads.
  const bool rim = centroid && std::abs(located.axes.along.dot(centroid->head<2>() - located.axes.center)) >
                                   std::max(kBetween, located.pose.width);
  if (rim) return best;
  for (const double shift : config.shifts) {
    Located beside = located;
    beside.axes.center += shift * located.axes.across;
    beside.surface = surface_height(heights, beside.axes, width);
    // A straight part goes on as it slopes; what does not is round there, or another.
    if (std::abs(beside.surface - located.surface - slope.across * shift) > kGoesOn) continue;
    GraspPose pose = with_lever(leaning(beside, slope, heights, config));
    const double off = shift / config.shift_scale;
    pose.quality *= std::exp(-off * off);
    if (pose.feasible && (!best.feasible || pose.quality > best.quality)) best = std::move(pose);
  }
  return best;
}

GraspPose best_grasp_pose(const std::vector<GraspRectangle>& candidates,
                          const PinholeIntrinsics& camera, const Pose& T_base_camera,
                          const HeightMap& heights, const CellConfig& cell,
                          const GraspPoseConfig& config,
                          const std::optional<Eigen::Vector3d>& centroid) {
  GraspPose best;
  best.reason = "no grasp was found for the object";
  for (std::size_t i = 0; i < candidates.size(); ++i) {
    GraspPose pose = aligned_grasp_pose(candidates[i], camera, T_base_camera, heights, cell, config, centroid);
    pose.candidate = static_cast<int>(i);
    if (i == 0 || (pose.feasible && (!best.feasible || pose.quality > best.quality)))
      best = std::move(pose);
  }
  return best;
}

}  // namespace iwgnet_grasp::grasping
