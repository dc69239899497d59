// Pushes that change how a pile lies where nothing can be grasped well.
#pragma once

#include <vector>

#include "iwgnet_grasp/core/cell_config.h"
#include "iwgnet_grasp/grasping/height_map.h"

namespace iwgnet_grasp::grasping {

struct PushConfig {       // config/motion.yaml, section "push"
  double gap;             // m between the pads while pushing
  std::vector<double> tip_heights;  // m, finger tips over the table, the highest first
  double overlap;         // m, least, that the object's visible centroid is higher than the tips: what
                          // is lower than the lowest tips and this is not pushed
  double clearance;       // m, tips over whatever lies where they go down
  double run_up;          // m from the object's centroid at most, to where they go down
  double distance, min_distance;  // m that the fingers go on once they meet something, as far as the
                                  // workspace lets them, and what is worth it
  double margin;          // m, the object's centroid and its neighbours' stay so far inside the workspace
  double speed;           // m/s of the tool
};

// The tips go down at `from`, closing direction along the way, so that nothing comes between the pads,
// and move straight to `to`: the back of one finger pushes.
struct Push {
  Eigen::Vector2d from, to;  // m, base_link
  double tip_height;         // m over the table
};

// All pushes against the objects (centroids in base_link, m): from a place where the fingers find
// room, nearest to the object in each of 16 directions, at the greatest height that still meets it,
// as far as what is there is not so high that the gripper's body would touch it and the object and
// its neighbours, which may go along, stay in the workspace or, from outside, come nearer. The
// highest first, then those with the least in their way: what lies on others slides off them, and an
// object moves away from its neighbours rather than into them.
std::vector<Push> find_pushes(const HeightMap& heights, const std::vector<Eigen::Vector3d>& objects,
                              const CellConfig& cell, const PushConfig& config);

}  // namespace iwgnet_grasp::grasping
