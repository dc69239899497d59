// Grasps from geometry and the labels of a scene.
#include <gtest/gtest.h>

#include <cmath>

#include "iwgnet_grasp/grasping/antipodal.h"
#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::grasping {
namespace {

TriangleMesh box_mesh(const Eigen::Vector3f& size) {
  TriangleMesh mesh;
  for (int i = 0; i < 8; ++i)
    mesh.vertices.emplace_back(size.x() * ((i & 1) - 0.5f), size.y() * ((i >> 1 & 1) - 0.5f),
                               size.z() * ((i >> 2 & 1) - 0.5f));
  mesh.triangles = {{0, 2, 1}, {1, 2, 3}, {4, 5, 6}, {5, 7, 6}, {0, 1, 4}, {1, 5, 4},
                    {2, 6, 3}, {3, 6, 7}, {0, 4, 2}, {2, 4, 6}, {1, 3, 5}, {3, 7, 5}};
  return mesh;
}

// A prism along x over a convex polygon of (y, z), counter-clockwise seen against x.
TriangleMesh prism_mesh(const std::vector<Eigen::Vector2f>& polygon, float length) {
  TriangleMesh mesh;
  const auto n = static_cast<std::uint32_t>(polygon.size());
  for (const float x : {-length / 2, length / 2})
    for (const auto& p : polygon) mesh.vertices.emplace_back(x, p.x(), p.y());
  for (std::uint32_t i = 0; i < n; ++i) {
    const std::uint32_t j = (i + 1) % n;
    mesh.triangles.push_back({i, i + n, j});
    mesh.triangles.push_back({j, i + n, j + n});
    if (i > 0 && j > 0) {
      mesh.triangles.push_back({0, i, j});
      mesh.triangles.push_back({n, n + j, n + i});
    }
  }
  // Outward: flip whatever points at the middle.
  for (auto& t : mesh.triangles) {
    const Eigen::Vector3f a = mesh.vertices[t[0]], b = mesh.vertices[t[1]], c = mesh.vertices[t[2]];
    if ((b - a).cross(c - a).dot(a + b + c) < 0) std::swap(t[1], t[2]);
  }
  return mesh;
}

struct Bench {
  CellConfig cell = load_cell_config(IWGNET_SOURCE_DIR "/config");
  GraspPoseConfig pose_config = load_grasp_pose_config(IWGNET_SOURCE_DIR "/config");
  AntipodalConfig config = load_antipodal_config(IWGNET_SOURCE_DIR "/config");
  sensing::Renderer renderer;
  std::vector<ScenePart> parts;

  Bench() {
    renderer.add_instance(renderer.add_box(cell.table.size), {},
                          Pose(Eigen::Translation3d(cell.table.center)));
  }
  void add(const TriangleMesh& mesh, const PartGrasps& grasps, const Pose& pose) {
    const int instance = renderer.add_instance(renderer.add_mesh(mesh), {}, pose);
    parts.push_back({&grasps, pose, instance});
  }
  PartGrasps grasps(const TriangleMesh& mesh, double mass = 0.3) const {
    return find_antipodal_grasps(mesh, mass, config, pose_config.max_opening);
  }
  std::vector<GraspLabel> label() {
    const CameraConfig& c = cell.camera;
    return label_grasps(parts, renderer.depth(c.color, c.T_base_color),
                        renderer.instances(c.color, c.T_base_color), c.color, c.T_base_color, cell,
                        pose_config, config);
  }
};

Pose lying(double x, double y, double z, double yaw = 0) {
  Pose pose(Eigen::Translation3d(x, y, z));
  pose.rotate(Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()));
  return pose;
}

TEST(Antipodal, ContactsLieOnOppositeFacesOfABox) {
  const Bench bench;
  const PartGrasps part = bench.grasps(box_mesh({0.12f, 0.03f, 0.02f}));
  ASSERT_GT(part.grasps.size(), 100u);
  for (const AntipodalGrasp& grasp : part.grasps) {
    const Eigen::Vector3f line = grasp.b - grasp.a;
    // 120 mm is wider than the gripper: only the two other pairs of faces remain.
    EXPECT_NEAR(line.x(), 0, 1e-6);
    EXPECT_TRUE(std::abs(line.norm() - 0.03) < 1e-6 || std::abs(line.norm() - 0.02) < 1e-6);
  }
  EXPECT_NEAR(part.area, 2 * (0.12 * 0.03 + 0.12 * 0.02 + 0.03 * 0.02), 1e-8);
}

TEST(Antipodal, FacesBeyondTheFrictionConeGiveNone) {
  // A wedge of 60 deg: with friction 0.5 (26.6 deg) its flanks cannot be held against each other.
  const Bench bench;
  const float h = 0.03f * std::sqrt(3.0f) / 2;
  const PartGrasps wedge = bench.grasps(prism_mesh({{-0.015f, -h / 3}, {0.015f, -h / 3}, {0, 2 * h / 3}}, 0.1f));
  for (const AntipodalGrasp& grasp : wedge.grasps)
    EXPECT_GT(std::abs((grasp.b - grasp.a).normalized().x()), 0.9);  // end faces only
}

TEST(Antipodal, SeedsRepeat) {
  const Bench bench;
  const TriangleMesh mesh = box_mesh({0.1f, 0.03f, 0.02f});
  const PartGrasps a = bench.grasps(mesh), b = bench.grasps(mesh);
  EXPECT_EQ(a.points, b.points);
  AntipodalConfig other = bench.config;
  other.seed = 99;
  EXPECT_NE(find_antipodal_grasps(mesh, 0.3, other, 0.085).points, a.points);
}

TEST(Antipodal, MeshWithoutAreaIsRefused) {
  const Bench bench;
  TriangleMesh flat;
  flat.vertices.assign(3, Eigen::Vector3f::Zero());
  flat.triangles.push_back({0, 1, 2});
  EXPECT_THROW(bench.grasps(flat), Error);
}

TEST(Labels, BestGraspOfABarIsAcrossItsMiddle) {
  Bench bench;
  const TriangleMesh mesh = box_mesh({0.12f, 0.03f, 0.024f});
  const PartGrasps grasps = bench.grasps(mesh);
  const double yaw = 0.5;
  bench.add(mesh, grasps, lying(0.45, 0.08, 0.012, yaw));
  const auto labels = bench.label();
  ASSERT_GT(labels.size(), 5u);
  const GraspLabel& best = labels.front();
  EXPECT_GT(best.rectangle.quality, 0.8);
  EXPECT_LT((best.pose.T_base_tcp.translation() - Eigen::Vector3d(0.45, 0.08, 0)).head<2>().norm(), 0.006);
  // Base yaw turns counter-clockwise; so does theta, as the image's x is base x.
  EXPECT_NEAR(best.rectangle.theta_rad, yaw - M_PI / 2, 0.02);
  EXPECT_NEAR(best.pose.width, 0.03, 5e-4);
  EXPECT_NEAR(best.rectangle.width_px, 0.03 * 640 / (0.6 - 0.024), 0.6);
  EXPECT_NEAR(best.jaw_px, 0.022 * 640 / (0.6 - 0.024), 0.6);
  EXPECT_GT(best.opening_px, best.rectangle.width_px);
  for (const GraspLabel& label : labels) {
    EXPECT_TRUE(label.pose.feasible);
    EXPECT_GT(label.rectangle.quality, 0);
    EXPECT_LE(label.rectangle.quality, 1);
    EXPECT_LE(label.rectangle.quality, best.rectangle.quality);
  }
}

TEST(Labels, QualityFallsWithTheDistanceFromTheCentreOfMass) {
  Bench bench;
  const TriangleMesh mesh = box_mesh({0.14f, 0.03f, 0.024f});
  const PartGrasps grasps = bench.grasps(mesh);
  bench.add(mesh, grasps, lying(0.5, 0.0, 0.012));
  double near = 0, far = 0;
  for (const GraspLabel& label : bench.label()) {
    const double d = std::abs(label.pose.T_base_tcp.translation().x() - 0.5);
    if (d < 0.01) near = std::max(near, label.rectangle.quality);
    if (d > 0.03) far = std::max(far, label.rectangle.quality);
  }
  EXPECT_GT(near, 2 * far);
  EXPECT_GT(far, 0);
}

TEST(Labels, AHeavyPartIsNotLabelledFarFromItsCentre) {
  Bench bench;
  const TriangleMesh mesh = box_mesh({0.14f, 0.03f, 0.024f});
  const PartGrasps light = bench.grasps(mesh, 0.2), heavy = bench.grasps(mesh, 3.0);
  const auto farthest = [&](const PartGrasps& grasps) {
    Bench own;
    own.add(mesh, grasps, lying(0.5, 0.0, 0.012));
    double d = 0;
    for (const GraspLabel& label : own.label())
      d = std::max(d, std::abs(label.pose.T_base_tcp.translation().x() - 0.5));
    return d;
  };
  EXPECT_LT(farthest(heavy), farthest(light));
}

TEST(Labels, NeighboursForbidTheGraspsTheyBlock) {
  const TriangleMesh mesh = box_mesh({0.12f, 0.03f, 0.024f});
  Bench bench;
  const PartGrasps grasps = bench.grasps(mesh);
  bench.add(mesh, grasps, lying(0.5, 0.0, 0.012));
  bench.add(mesh, grasps, lying(0.5, 0.031, 0.012));  // 1 mm apart
  for (const GraspLabel& label : bench.label()) {
    // No finger fits between them, and both together are wider than one is labelled.
    const double middle = label.part == 0 ? 0.0 : 0.031;
    const double across = std::abs(label.pose.T_base_tcp.linear()(1, 0));
    EXPECT_FALSE(across > 0.9 && std::abs(label.pose.T_base_tcp.translation().y() - middle) < 0.01 &&
                 label.pose.width < 0.035)
        << label.part;
  }
}

TEST(Labels, TwoPartsBetweenTheFingersAreNoGraspOfOne) {
  // Both together fit the gripper; what the pads would meet is one side of each.
  const TriangleMesh mesh = box_mesh({0.12f, 0.016f, 0.024f});
  const auto across_one = [&](double distance) {
    Bench bench;
    const PartGrasps grasps = bench.grasps(mesh);
    bench.add(mesh, grasps, lying(0.5, 0.0, 0.012));
    bench.add(mesh, grasps, lying(0.5, distance, 0.012));
    int count = 0;
    for (const GraspLabel& label : bench.label())
      count += std::abs(label.pose.T_base_tcp.linear()(1, 0)) > 0.9;
    return count;
  };
  EXPECT_EQ(across_one(0.017), 0);
  EXPECT_GT(across_one(0.060), 0);
}

TEST(Labels, GripperLeansWithATiltedBar) {
  const TriangleMesh mesh = box_mesh({0.12f, 0.03f, 0.024f});
  for (const double roll : {0.0, 0.45}) {
    Bench bench;
    const PartGrasps grasps = bench.grasps(mesh);
    const Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
    const double height = 0.015 * std::sin(roll) + 0.012 * std::cos(roll) + 0.005;
    Pose pose(Eigen::Translation3d(0.5, 0.0, height));
    pose.rotate(Eigen::AngleAxisd(roll, axis));
    bench.add(mesh, grasps, pose);
    const auto labels = bench.label();
    ASSERT_FALSE(labels.empty()) << roll;
    const GraspLabel& best = labels.front();
    EXPECT_GT(best.rectangle.quality, 0.5) << roll;
    EXPECT_NEAR(best.pose.width, 0.03, 1e-3) << roll;
    // The approach against the bar's own vertical.
    const Eigen::Vector3d up = pose.rotation() * Eigen::Vector3d::UnitZ();
    EXPECT_LT(std::acos(-best.pose.T_base_tcp.linear().col(2).dot(up)), 0.06) << roll;
  }
}

TEST(Labels, ACoveredPartHasNone) {
  Bench bench;
  const TriangleMesh small = box_mesh({0.06f, 0.02f, 0.02f}), lid = box_mesh({0.12f, 0.08f, 0.02f});
  const PartGrasps below = bench.grasps(small), above = bench.grasps(lid);
  bench.add(small, below, lying(0.5, 0.0, 0.01));
  bench.add(lid, above, lying(0.5, 0.0, 0.03));
  for (const GraspLabel& label : bench.label()) EXPECT_EQ(label.part, 1);
}

TEST(Labels, HexagonIsHeldByItsEdges) {
  // Flats 36 mm apart, lying on one: its side faces slant by 30 deg, beyond the cone, but two
  // opposite edges face the pads at the same height.
  std::vector<Eigen::Vector2f> hexagon;
  for (int i = 0; i < 6; ++i)
    hexagon.emplace_back(0.0208f * std::cos(i * M_PI / 3), 0.0208f * std::sin(i * M_PI / 3));
  Bench bench;
  bench.pose_config.insertion_depth = 0.018 + 0.010;  // the edges lie 18 mm below the upper side
  const TriangleMesh mesh = prism_mesh(hexagon, 0.1f);
  const PartGrasps grasps = bench.grasps(mesh);
  bench.add(mesh, grasps, lying(0.5, 0.0, 0.018));
  const auto labels = bench.label();
  ASSERT_FALSE(labels.empty());
  EXPECT_NEAR(labels.front().pose.width, 0.0416, 1e-3);
}

TEST(Labels, SpreadKeepsThemApart) {
  Bench bench;
  const TriangleMesh mesh = box_mesh({0.08f, 0.05f, 0.03f});
  const PartGrasps grasps = bench.grasps(mesh);
  bench.add(mesh, grasps, lying(0.5, 0.0, 0.015));
  const auto labels = bench.label();
  EXPECT_LE(static_cast<int>(labels.size()), bench.config.max_per_part);
  for (std::size_t i = 0; i < labels.size(); ++i)
    for (std::size_t j = 0; j < i; ++j) {
      const double d = (labels[i].pose.T_base_tcp.translation() -
                        labels[j].pose.T_base_tcp.translation()).head<2>().norm();
      double turn = std::abs(labels[i].rectangle.theta_rad - labels[j].rectangle.theta_rad);
      turn = std::min(turn, M_PI - turn);
      EXPECT_TRUE(d >= bench.config.nms_distance - 1e-9 || turn >= bench.config.nms_angle - 1e-9);
    }
}

TEST(Labels, ImagesThatDoNotMatchAreRefused) {
  Bench bench;
  const CameraConfig& c = bench.cell.camera;
  EXPECT_THROW(label_grasps({}, cv::Mat(800, 1280, CV_32FC1), cv::Mat(800, 1280, CV_8UC1), c.color,
                            c.T_base_color, bench.cell, bench.pose_config, bench.config),
               Error);
}

}  // namespace
}  // namespace iwgnet_grasp::grasping
