// Three stages from image to gripper (Eq. 5), and the choice of depth and opening.
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

#include "iwgnet_grasp/grasping/grasp_pose.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/sensing/pinhole.h"
#include "iwgnet_grasp/sensing/stereo_depth.h"

namespace iwgnet_grasp::grasping {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

struct Bench {
  CellConfig cell = load_cell_config(IWGNET_SOURCE_DIR "/config");
  GraspPoseConfig config = load_grasp_pose_config(IWGNET_SOURCE_DIR "/config");
  sensing::Renderer renderer;
  const PinholeIntrinsics& camera = cell.camera.color;
  const Pose& T = cell.camera.T_base_color;

  Bench() { add(cell.table.size, cell.table.center); }
  void add(const Eigen::Vector3d& size, const Eigen::Vector3d& center, double yaw = 0) {
    Pose pose(Eigen::Translation3d(center.x(), center.y(), center.z()));
    pose.rotate(Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()));
    renderer.add_instance(renderer.add_box(size), {}, pose);
  }
  // A bar on the table: length along its yaw, width across, height.
  void bar(double x, double y, double length, double width, double height, double yaw = 0) {
    add({length, width, height}, {x, y, height / 2}, yaw);
  }
  HeightMap heights() { return HeightMap(renderer.depth(camera, T), camera, T, cell); }
  // The grasp across a point at (x, y, z) closing along base direction `yaw`.
  GraspRectangle rectangle(double x, double y, double z, double yaw, double width) const {
    const Eigen::Vector3d p = T.inverse() * Eigen::Vector3d(x, y, z);
    const Eigen::Vector2d px = sensing::project(camera, p);
    const Eigen::Vector2d ahead =
        sensing::project(camera, T.inverse() * Eigen::Vector3d(x + std::cos(yaw) * 0.001,
                                                               y + std::sin(yaw) * 0.001, z)) - px;
    return {px.x(), px.y(), std::atan2(-ahead.y(), ahead.x()), width * camera.fx / p.z(), 0.9, p.z()};
  }
  GraspPose pose(const GraspRectangle& grasp) {
    return grasp_pose(grasp, camera, T, heights(), cell, config);
  }
};

double tool_height(const GraspPose& pose) {
  return (pose.T_base_tcp * kinematics::T_tool0_tcp(pose.width).inverse()).translation().z();
}

TEST(GraspPose, Equation5) {
  EXPECT_DOUBLE_EQ(width_in_metres(64, 0.5, 640), 0.05);
}

TEST(GraspPose, LandsOnTheObjectWithItsAngleAndWidth) {
  for (const double yaw : {0.0, 0.4, 1.2, -0.9}) {
    Bench bench;
    bench.bar(0.44, 0.11, 0.12, 0.03, 0.04, yaw - M_PI / 2);
    const GraspPose pose = bench.pose(bench.rectangle(0.44, 0.11, 0.04, yaw, 0.03));
    ASSERT_TRUE(pose.feasible) << pose.reason;
    EXPECT_NEAR(pose.T_base_tcp.translation().x(), 0.44, 1e-3);
    EXPECT_NEAR(pose.T_base_tcp.translation().y(), 0.11, 1e-3);
    const Eigen::Vector3d closing = pose.T_base_tcp.linear().col(0);
    EXPECT_NEAR(std::abs(closing.x() * std::cos(yaw) + closing.y() * std::sin(yaw)), 1.0, 1e-4);
    EXPECT_NEAR(pose.T_base_tcp.linear().determinant(), 1.0, 1e-9);
    EXPECT_NEAR(pose.T_base_tcp.linear()(2, 2), -1.0, 1e-9);
    EXPECT_NEAR(pose.width, 0.03, 2e-4);
    EXPECT_GT(pose.opening, pose.width + 2 * bench.config.side_clearance);
    EXPECT_LE(pose.opening, bench.config.max_opening);
  }
}

// m, how far the tips sink at most when the fingers close on from a gap.
double sinks_from(double gap) {
  double lowest = 0.0;
  for (double g = 0.0; g < gap; g += 0.001)
    lowest = std::max(lowest, kinematics::finger_tip_height(g) - kinematics::finger_tip_height(gap));
  return lowest;
}

TEST(GraspPose, TipsGoAsDeepAsTheTableAllows) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.03, 0.020);
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.02, M_PI / 2, 0.03));
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_GE(pose.tip_height, bench.config.floor_clearance - 1e-6);
  EXPECT_LE(pose.tip_height, bench.config.floor_clearance + sinks_from(0.03) + 0.0015);
  EXPECT_NEAR(pose.engagement, 0.02 - pose.tip_height, 5e-4);
}

TEST(GraspPose, TipsStopAtTheInsertionDepthInATallObject) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.05, 0.04, 0.10);
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.10, M_PI / 2, 0.04));
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_NEAR(pose.tip_height, 0.10 - bench.config.insertion_depth, 5e-4);
}

TEST(GraspPose, ToolHeightAllowsForTheTipsSinkingWhileTheyClose) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.05, 0.06, 0.020);
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.02, M_PI / 2, 0.06));
  ASSERT_TRUE(pose.feasible) << pose.reason;
  // Tips stay above the table at every gap from the opening down to the object.
  for (double gap = pose.opening; gap >= 0.06; gap -= 0.001)
    EXPECT_GE(tool_height(pose) - kinematics::finger_tip_height(gap), bench.config.floor_clearance - 5e-4)
        << gap;
  // ... and they are higher while open.
  EXPECT_LT(kinematics::finger_tip_height(pose.opening), kinematics::finger_tip_height(0.06));
}

TEST(GraspPose, OpeningShrinksBesideANeighbour) {
  Bench free, crowded;
  free.bar(0.5, 0.0, 0.12, 0.03, 0.03);
  crowded.bar(0.5, 0.0, 0.12, 0.03, 0.03);
  crowded.bar(0.5, 0.0515, 0.12, 0.02, 0.03);  // 26.5 mm between the two
  const GraspRectangle grasp = free.rectangle(0.5, 0.0, 0.03, M_PI / 2, 0.03);
  const GraspPose wide = free.pose(grasp), narrow = crowded.pose(grasp);
  ASSERT_TRUE(wide.feasible && narrow.feasible) << wide.reason << narrow.reason;
  EXPECT_LT(narrow.opening, wide.opening - 0.002);
  EXPECT_GE(narrow.opening, 0.03 + 2 * crowded.config.side_clearance - 1e-9);
  // At the neighbour's height the finger is wider than its pad: its outside must clear the edge.
  const auto& upper = crowded.config.finger_outline.back();
  const auto& lower = crowded.config.finger_outline.front();
  const double above = 0.03 - (tool_height(narrow) - kinematics::finger_tip_height(narrow.opening));
  const double outside = lower.x() + (above - lower.y()) * (upper.x() - lower.x()) / (upper.y() - lower.y());
  EXPECT_LE(narrow.opening / 2 + outside, 0.0415 + 1e-3);
}

TEST(GraspPose, NoRoomBesideTheObjectIsInfeasible) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.03, 0.03);
  bench.bar(0.5, 0.029, 0.12, 0.02, 0.03);  // 4 mm between the two: no finger fits
  bench.bar(0.5, -0.029, 0.12, 0.02, 0.03);
  bench.bar(0.5, 0.050, 0.12, 0.02, 0.03);
  bench.bar(0.5, -0.050, 0.12, 0.02, 0.03);
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.03, M_PI / 2, 0.03));
  EXPECT_FALSE(pose.feasible);
  EXPECT_NE(pose.reason.find("room"), std::string::npos) << pose.reason;
}

TEST(GraspPose, LowNeighbourUnderTheFingersLiftsTheTips) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.03, 0.040);
  bench.bar(0.5, 0.040, 0.12, 0.045, 0.015);  // a plate right beside it
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.04, M_PI / 2, 0.03));
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_GE(pose.tip_height, 0.015 + bench.config.floor_clearance - 1e-3);
  EXPECT_GE(pose.engagement, bench.config.min_engagement - 1e-6);
}

TEST(GraspPose, TallNeighbourUnderThePalmIsInfeasible) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.03, 0.03, 0.03);
  bench.bar(0.535, 0.0, 0.02, 0.03, 0.12);  // across the closing direction, beside the fingers
  const GraspPose pose = bench.pose(bench.rectangle(0.5, 0.0, 0.03, M_PI / 2, 0.03));
  EXPECT_FALSE(pose.feasible);
  EXPECT_NE(pose.reason.find("body"), std::string::npos) << pose.reason;
}

TEST(GraspPose, NeighbourUnderTheFingersBodyKeepsTheTipsUp) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.03, 0.12, 0.03);
  const GraspRectangle grasp = bench.rectangle(0.5, 0.0, 0.03, 0.0, 0.03);
  const GraspPose alone = bench.pose(grasp);
  ASSERT_TRUE(alone.feasible) << alone.reason;
  constexpr double kHeight = 0.045;
  bench.bar(0.5 + 0.054, 0.0, 0.008, 0.12, kHeight);  // beside the tips, under what is above them
  const GraspPose pose = bench.pose(grasp);
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_LT(pose.engagement, alone.engagement - 0.003);
  EXPECT_GE(pose.engagement, bench.config.min_engagement - 1e-6);
  double lowest = 1.0;  // of the fingers' body above the neighbour, with the fingers open
  const double open_tip = tool_height(pose) - kinematics::finger_tip_height(pose.opening);
  for (const auto& body : bench.config.fingers)
    if (body.along + body.spread * pose.opening > 0.050)
      lowest = std::min(lowest, open_tip + body.above_tips - kHeight);
  EXPECT_GE(lowest, bench.config.floor_clearance - 1e-3);
}

TEST(GraspPose, CentreOverABoreUsesTheRimsHeight) {
  // A square ring: two bars along x, two along y, table in the middle; far off the optical axis,
  // where the table's depth at the centre would put the grasp 5 mm away.
  Bench bench;
  for (const double s : {-1.0, 1.0}) {
    bench.bar(0.60, 0.12 + s * 0.02, 0.05, 0.01, 0.03);
    bench.bar(0.60 + s * 0.02, 0.12, 0.01, 0.05, 0.03);
  }
  GraspRectangle grasp = bench.rectangle(0.60, 0.12, 0.03, M_PI / 2, 0.05);
  grasp.depth_m = 0.6;
  const GraspPose pose = bench.pose(grasp);
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_NEAR(pose.T_base_tcp.translation().x(), 0.60, 1.5e-3);
  EXPECT_NEAR(pose.T_base_tcp.translation().y(), 0.12, 1.5e-3);
  EXPECT_NEAR(pose.width, 0.05, 1e-3);
  // As deep as leaves the tips clear of the table wherever the fingers stop.
  EXPECT_GT(sinks_from(0.05), 0.003);
  EXPECT_NEAR(pose.tip_height, bench.config.floor_clearance + sinks_from(0.05), 1.5e-3);
}

TEST(GraspPose, MissingDepthFallsBackOnWhatLiesAround) {
  Bench bench;
  bench.bar(0.62, 0.10, 0.12, 0.03, 0.04);
  GraspRectangle grasp = bench.rectangle(0.62, 0.10, 0.04, M_PI / 2, 0.03);
  const GraspPose measured = bench.pose(grasp);
  for (const double depth : {kNaN, 0.0, -1.0}) {
    grasp.depth_m = depth;
    const GraspPose pose = bench.pose(grasp);
    ASSERT_TRUE(pose.feasible) << pose.reason;
    EXPECT_LT((pose.T_base_tcp.translation() - measured.T_base_tcp.translation()).norm(), 2e-3);
  }
}

TEST(GraspPose, StereoNoiseMovesTheTipsByMillimetresAtMost) {
  Bench bench;
  bench.bar(0.46, 0.06, 0.12, 0.03, 0.03, 0.5);
  const GraspRectangle grasp = bench.rectangle(0.46, 0.06, 0.03, 0.5 + M_PI / 2, 0.03);
  const CameraConfig& c = bench.cell.camera;
  for (std::uint64_t seed = 0; seed < 5; ++seed) {
    const cv::Mat depth = sensing::align_depth(sensing::capture_depth(bench.renderer, c, seed), c.depth,
                                               c.color, c.T_depth_color.inverse());
    const GraspPose pose = grasp_pose(grasp, c.color, c.T_base_color,
                                      HeightMap(depth, c.color, c.T_base_color, bench.cell),
                                      bench.cell, bench.config);
    ASSERT_TRUE(pose.feasible) << pose.reason;
    EXPECT_GT(pose.tip_height, bench.config.floor_clearance - 0.001);
    EXPECT_LT(pose.tip_height, bench.config.floor_clearance + 0.004);
  }
}

TEST(GraspPose, BadGraspsSayWhy) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.03, 0.03);
  const HeightMap heights = bench.heights();
  const GraspRectangle good = bench.rectangle(0.5, 0.0, 0.03, M_PI / 2, 0.03);
  const auto reason = [&](GraspRectangle grasp) {
    const GraspPose pose =
        grasp_pose(grasp, bench.camera, bench.T, heights, bench.cell, bench.config);
    EXPECT_FALSE(pose.feasible);
    return pose.reason;
  };
  auto grasp = good;
  grasp.width_px = 150;
  EXPECT_NE(reason(grasp).find("the gripper opens 85 mm"), std::string::npos);
  grasp = good;
  grasp.x_px = kNaN;
  EXPECT_NE(reason(grasp).find("no position"), std::string::npos);
  grasp = good;
  grasp.x_px = -20;
  EXPECT_NE(reason(grasp).find("outside the image"), std::string::npos);
  EXPECT_NE(reason(bench.rectangle(0.70, 0.0, 0.0, 0, 0.03)).find("workspace"), std::string::npos);
  EXPECT_NE(reason(bench.rectangle(0.40, 0.1, 0.0, 0, 0.03)).find("high enough"), std::string::npos);
  EXPECT_NE(grasp_pose(good, bench.camera, bench.T, HeightMap(), bench.cell, bench.config)
                .reason.find("height map is empty"),
            std::string::npos);
}

TEST(SurfaceSlope, IsThePlanesUnderNoiseAndWithARecess) {
  const CellConfig cell = load_cell_config(IWGNET_SOURCE_DIR "/config");
  const PinholeIntrinsics& camera = cell.camera.color;
  for (const double rise : {-0.4, 0.0, 0.25}) {
    cv::Mat depth(camera.height, camera.width, CV_32FC1);
    cv::theRNG().state = 1;
    cv::randn(depth, 0.0, 0.0005);
    for (int v = 0; v < camera.height; ++v)
      for (int u = 0; u < camera.width; ++u) {
        // z = 0.05 + rise (x - 0.5) + 0.1 y along the pixel's line of sight; a groove along y.
        const double a = (u - camera.cx) / camera.fx, b = -(v - camera.cy) / camera.fy;
        double z = (0.6 - 0.05) / (1 + rise * a + 0.1 * b);
        if (std::abs(a * z) < 0.004) z += 0.007;
        depth.at<float>(v, u) += static_cast<float>(z);
      }
    const HeightMap heights(depth, camera, cell.camera.T_base_color, cell);
    const Slope slope = surface_slope(heights, {0.5, 0.0}, {1, 0}, 0.05, 0.02, 0.7, 0.7);
    EXPECT_NEAR(slope.along, rise, 0.03);
    EXPECT_NEAR(slope.across, 0.1, 0.03);
    // Seen along another direction the same plane has the slopes exchanged.
    const Slope turned = surface_slope(heights, {0.5, 0.0}, {0, 1}, 0.05, 0.02, 0.7, 0.7);
    EXPECT_NEAR(turned.along, 0.1, 0.05);
    EXPECT_NEAR(turned.across, -rise, 0.05);
  }
}

TEST(AlignedGraspPose, LeansWithARolledBar) {
  for (const double roll : {-0.6, 0.2, 0.4}) {
    Bench bench;
    // A bar along x, 60 mm over the table, rolled about its axis.
    Pose T_bar(Eigen::Translation3d(0.5, 0.0, 0.06));
    T_bar.rotate(Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()));
    bench.renderer.add_instance(bench.renderer.add_box({0.12, 0.03, 0.03}), {}, T_bar);
    const Eigen::Vector3d top = T_bar * Eigen::Vector3d(0, 0, 0.015);
    const GraspRectangle grasp = bench.rectangle(top.x(), top.y(), top.z(), M_PI / 2, 0.03);
    const GraspPose pose =
        aligned_grasp_pose(grasp, bench.camera, bench.T, bench.heights(), bench.cell, bench.config);
    ASSERT_TRUE(pose.feasible) << pose.reason;
    EXPECT_GT(std::abs(pose.T_base_tcp.linear().col(0).dot(T_bar.linear().col(1))), std::cos(0.04));
    EXPECT_GT(-pose.T_base_tcp.linear().col(2).dot(T_bar.linear().col(2)), std::cos(0.04));
    EXPECT_NEAR(pose.T_base_tcp.linear().determinant(), 1.0, 1e-9);
    // The pads' middle lies on the bar's plane of symmetry, the tips within the bar.
    const Eigen::Vector3d tcp = T_bar.inverse() * pose.T_base_tcp.translation();
    EXPECT_NEAR(tcp.y(), 0.0, 0.003);
    EXPECT_GT(pose.engagement, bench.config.min_engagement - 1e-6);
    EXPECT_NEAR(pose.quality, grasp.quality, 0.1);
    // Straight down the same place is worth less.
    GraspPoseConfig upright = bench.config;
    upright.min_tilt = 1.5;
    const GraspPose down =
        aligned_grasp_pose(grasp, bench.camera, bench.T, bench.heights(), bench.cell, upright);
    if (down.feasible) {
      EXPECT_LT(down.quality, pose.quality);
    }
  }
}

TEST(AlignedGraspPose, GoesStraightDownOnALevelBar) {
  Bench bench;
  bench.bar(0.5, 0.05, 0.12, 0.03, 0.03, 0.3);
  const GraspRectangle grasp = bench.rectangle(0.5, 0.05, 0.03, 0.3 + M_PI / 2, 0.03);
  const HeightMap heights = bench.heights();
  const GraspPose aligned =
      aligned_grasp_pose(grasp, bench.camera, bench.T, heights, bench.cell, bench.config);
  ASSERT_TRUE(aligned.feasible) << aligned.reason;
  EXPECT_TRUE(aligned.T_base_tcp.isApprox(bench.pose(grasp).T_base_tcp, 1e-12));
  EXPECT_NEAR(aligned.quality, grasp.quality, 0.01);
}

TEST(AlignedGraspPose, MovesAlongThePadsTowardsTheCentroid) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.14, 0.03, 0.03);
  const HeightMap heights = bench.heights();
  const GraspRectangle grasp = bench.rectangle(0.54, 0.0, 0.03, M_PI / 2, 0.03);
  const auto at = [&](const std::optional<Eigen::Vector3d>& centroid) {
    return aligned_grasp_pose(grasp, bench.camera, bench.T, heights, bench.cell, bench.config, centroid);
  };
  const GraspPose free = at(std::nullopt), drawn = at(Eigen::Vector3d(0.5, 0.0, 0.03));
  ASSERT_TRUE(free.feasible && drawn.feasible);
  EXPECT_NEAR(free.T_base_tcp.translation().x(), 0.54, 1e-3);
  EXPECT_LT(drawn.T_base_tcp.translation().x(), 0.535);
  EXPECT_LT(drawn.quality, free.quality);
}

TEST(AlignedGraspPose, ARimThatHoldsAllOfItsPartBesideItMustBeHeldDeep) {
  const auto at = [](double height, double beside) {  // a wall, 10 mm thick across y
    Bench bench;
    bench.bar(0.5, 0.0, 0.06, 0.01, height);
    return aligned_grasp_pose(bench.rectangle(0.5, 0.0, height, M_PI / 2, 0.01), bench.camera, bench.T,
                              bench.heights(), bench.cell, bench.config,
                              Eigen::Vector3d(0.5, beside, height / 2));
  };
  double before = 1.0;
  for (const double height : {0.030, 0.022, 0.014}) {
    const GraspPose within = at(height, 0.0), rim = at(height, 0.05);
    ASSERT_TRUE(within.feasible && rim.feasible);
    const double overhang = (0.05 - 0.01) / (3.0 * rim.engagement);  // grasping.yaml, overhang_scale
    EXPECT_NEAR(rim.quality / within.quality, std::exp(-overhang * overhang), 0.1);
    EXPECT_LT(rim.quality, before);
    before = rim.quality;
    EXPECT_NEAR(rim.T_base_tcp.translation().x(), 0.5, 1e-3);  // a wall that goes on is no reason to shift
  }
}

TEST(AlignedGraspPose, TakingANeighbourAlongCostsQuality) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.02, 0.03);
  bench.bar(0.5, 0.0205, 0.12, 0.02, 0.03);  // touches it: the fingers fit around both only
  const GraspRectangle grasp = bench.rectangle(0.5, 0.010, 0.03, M_PI / 2, 0.02);
  const GraspPose pose =
      aligned_grasp_pose(grasp, bench.camera, bench.T, bench.heights(), bench.cell, bench.config);
  ASSERT_TRUE(pose.feasible) << pose.reason;
  EXPECT_GT(pose.contact, 0.035);
  EXPECT_LT(pose.quality, 0.5 * grasp.quality);
}

TEST(BestGraspPose, TakesTheBestFeasibleCandidate) {
  Bench bench;
  bench.bar(0.5, 0.0, 0.12, 0.03, 0.03);
  const HeightMap heights = bench.heights();
  const GraspRectangle lengthways = bench.rectangle(0.5, 0.0, 0.03, 0, 0.12);
  const GraspRectangle across = bench.rectangle(0.5, 0.0, 0.03, M_PI / 2, 0.03);
  const auto best = [&](const std::vector<GraspRectangle>& grasps) {
    return best_grasp_pose(grasps, bench.camera, bench.T, heights, bench.cell, bench.config);
  };
  EXPECT_EQ(best({lengthways, across}).candidate, 1);
  EXPECT_TRUE(best({lengthways, across}).feasible);
  GraspRectangle better = across;
  better.quality = across.quality + 0.05;
  EXPECT_EQ(best({across, lengthways, better}).candidate, 2);
  EXPECT_FALSE(best({lengthways}).feasible);
  EXPECT_FALSE(best({lengthways}).reason.empty());
  EXPECT_FALSE(best({}).feasible);
  EXPECT_FALSE(best({}).reason.empty());
}

TEST(GraspPoseConfig, FaultyFilesAreNamed) {
  const auto dir = std::filesystem::temp_directory_path() / "iwgnet_grasping_config";
  std::filesystem::create_directories(dir);
  std::ifstream in(IWGNET_SOURCE_DIR "/config/grasping.yaml");
  std::stringstream text;
  text << in.rdbuf();
  std::string broken = text.str();
  broken.replace(broken.find("max_opening: 0.085"), 18, "max_opening: 0.500");
  std::ofstream(dir / "grasping.yaml") << broken;
  try {
    load_grasp_pose_config(dir.string());
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("pose.max_opening"), std::string::npos) << error.what();
  }
  std::filesystem::remove_all(dir);
}

}  // namespace
}  // namespace iwgnet_grasp::grasping
