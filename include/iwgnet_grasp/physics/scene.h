// Scenes from config/scenes.yaml: how many parts, how they come to lie.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "iwgnet_grasp/physics/world.h"

namespace iwgnet_grasp::physics {

enum class Arrangement {
  kScattered,  // laid flat with gaps between them
  kStacked     // dropped one after another onto a heap
};

struct SceneSpec {
  std::string name;
  int count = 0;
  Arrangement arrangement = Arrangement::kScattered;
  std::vector<std::string> families;  // part families to draw from
  double min_gap = 0.0;               // m, scattered: between the parts' outlines
  Eigen::Vector2d drop_area{0, 0};    // m, stacked: extents around the workspace centre
  double drop_height = 0.0;           // m, stacked: above what lies there
  double drop_interval = 0.30;        // s, stacked: between two drops
  double settle_time = 12.0;          // s a scene may take to come to rest
};

std::vector<std::string> scene_names(const std::string& config_dir);
// Throws Error naming the known scenes when `name` is not one.
SceneSpec load_scene_spec(const std::string& config_dir, const std::string& name);

// Fills an empty world by the spec and the seed and lets it come to rest inside the workspace;
// returns the parts' models in the order of their indices. Same seed, same scene to the bit.
std::vector<PartModel> build_scene(World& world, const SceneSpec& spec, const CellConfig& cell,
                                   const std::vector<PartModel>& library, std::uint64_t seed);

}  // namespace iwgnet_grasp::physics
