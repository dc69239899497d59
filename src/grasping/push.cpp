#include "iwgnet_grasp/grasping/push.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace iwgnet_grasp::grasping {
namespace {

constexpr int kDirections = 16;
constexpr double kStep = 0.002;  // m
// Half extents (m) along and across the closing direction, nearly closed; above_tips: of the
// undersides (grasping.yaml: finger_outline, finger_bodies, palm).
const Eigen::Vector2d kTips(0.013, 0.013), kFingers(0.040, 0.024), kBody(0.048, 0.042);
constexpr double kFingersAbove = 0.035, kBodyAbove = 0.060;
constexpr double kAhead = 0.08;      // m beyond the push's end that count as in its way
constexpr double kHalfWidth = 0.03;  // m of what counts
constexpr double kNeighbour = 0.10;  // m between centroids, of objects that may go along

}  // namespace

std::vector<Push> find_pushes(const HeightMap& heights, const std::vector<Eigen::Vector3d>& objects,
                              const CellConfig& cell, const PushConfig& config) {
  struct Candidate {
    Push push;
    double in_the_way;  // m, mean height
  };
  std::vector<Candidate> candidates;
  const Eigen::Vector2d low = cell.workspace_min.array() + config.margin,
                        high = cell.workspace_max.array() - config.margin;
  // m that a point lies outside.
  const auto outside = [&](const Eigen::Vector2d& p) {
    return (low - p).cwiseMax(p - high).cwiseMax(0.0).norm();
  };
  // Against one object in one direction, the tips `tip` over the table.
  const auto try_push = [&](const Eigen::Vector2d& center, const Eigen::Vector2d& along, double tip) {
    const double closing = std::atan2(along.y(), along.x());
    const auto free = [&](const Eigen::Vector2d& p, const Eigen::Vector2d& half, double above_tips) {
      return heights.max_in(p, closing, half) + config.clearance <= tip + above_tips;
    };
    const auto has_room = [&](const Eigen::Vector2d& p) {
      return free(p, kTips, 0.0) && free(p, kFingers, kFingersAbove) && free(p, kBody, kBodyAbove);
    };
    double back = kTips.x();
    while (back <= config.run_up && !has_room(center - back * along)) back += kStep;
    if (back > config.run_up) return false;
    const Eigen::Vector2d from = center - back * along;
    double met = 0.0;  // m, at the centroid at the latest
    while (met < back && free(from + met * along, kTips, 0.0)) met += kStep;
    double way = met;
    // Neighbours may be entangled with the object and go as far as it does. One that lies outside
    // already may come back.
    const auto stays = [&](const Eigen::Vector3d& object) {
      const Eigen::Vector2d p = object.head<2>();
      return (p - center).norm() > kNeighbour ||
             outside(p + (way - met + kStep) * along) <= outside(p + (way - met) * along);
    };
    // Where the body's front has been there is room for the rest of it.
    const auto front_is_free = [&](double first, double last) {
      return free(from + (kBody.x() + (first + last) / 2) * along,
                  {(last - first) / 2, kBody.y()}, kBodyAbove);
    };
    if (!front_is_free(0.0, met)) return false;
    const auto goes_on = [&] {
      return std::all_of(objects.begin(), objects.end(), stays) &&
             front_is_free(way, way + kStep);
    };
    while (way - met < config.distance && goes_on()) way += kStep;
    if (way - met < config.min_distance) return false;
    double sum = 0.0;
    int cells = 0;
    for (double s = 0.0; s <= way + kAhead; s += 2 * kStep)
      for (double t = -kHalfWidth; t <= kHalfWidth; t += 2 * kStep, ++cells) {
        const Eigen::Vector2d p = from + s * along + t * Eigen::Vector2d(-along.y(), along.x());
        sum += heights.at(p.x(), p.y());
      }
    candidates.push_back({{from, from + way * along, tip}, sum / cells});
    return true;
  };
  for (const Eigen::Vector3d& object : objects)
    for (int i = 0; i < kDirections; ++i) {
      const double angle = 2 * M_PI * i / kDirections;
      for (const double tip : config.tip_heights)  // high: what lies below stays where it is
        if (object.z() > tip + config.overlap &&
            try_push(object.head<2>(), {std::cos(angle), std::sin(angle)}, tip))
          break;
    }
  std::stable_sort(candidates.begin(), candidates.end(), [](const auto& a, const auto& b) {
    const auto rank = [](const Candidate& c) {
      return std::make_pair(-c.push.tip_height, c.in_the_way);
    };
    return rank(a) < rank(b);
  });
  std::vector<Push> pushes;
  for (const Candidate& candidate : candidates) pushes.push_back(candidate.push);
  return pushes;
}

}  // namespace iwgnet_grasp::grasping
