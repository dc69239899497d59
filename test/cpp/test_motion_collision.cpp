// The collision world: what its spheres cover, what they meet, what they leave free.
#include <gtest/gtest.h>

#include <fstream>
#include <sstream>

#include "iwgnet_grasp/core/mesh.h"
#include "iwgnet_grasp/kinematics/kdl_chain.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"
#include "iwgnet_grasp/motion/collision_world.h"

using namespace iwgnet_grasp;
using motion::CollisionWorld;

namespace {

const std::string kSource = IWGNET_SOURCE_DIR;

CellConfig cell() { return load_cell_config(kSource + "/config"); }

// Tool pointing down with the closing direction at `yaw`; TCP of the given gap at (x, y, z).
JointVector tool_down(double x, double y, double z, double yaw = 0.0, double gap = 0.085) {
  Pose T = Pose::Identity();
  T.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX())).toRotationMatrix();
  T.translation() << x, y, z;
  const JointVector near = cell().observe_joints;
  const auto solutions = kinematics::inverse(T * kinematics::T_tool0_tcp(gap).inverse());
  JointVector best = JointVector::Constant(100);
  for (int i = 0; i < solutions.count; ++i) {
    const JointVector q = kinematics::nearest_turn(solutions.q[i], near);
    if ((q - near).norm() < (best - near).norm()) best = q;
  }
  EXPECT_LT(best[0], 50) << "pose out of reach";
  return best;
}

// Heights as a camera of unit pixel size would give them: a block of height h on [x0, x1] x [y0, y1].
grasping::HeightMap block(double x0, double x1, double y0, double y1, double h) {
  const CellConfig config = cell();
  const PinholeIntrinsics camera = config.camera.color;
  const Pose T = config.camera.T_base_color;
  cv::Mat depth(camera.height, camera.width, CV_32FC1);
  for (int v = 0; v < camera.height; ++v)
    for (int u = 0; u < camera.width; ++u) {
      const Eigen::Vector3d ray((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
      const Eigen::Vector3d top = T * Eigen::Vector3d(ray * (T.translation().z() - h));
      const bool inside = top.x() > x0 && top.x() < x1 && top.y() > y0 && top.y() < y1;
      depth.at<float>(v, u) = static_cast<float>(T.translation().z() - (inside ? h : 0.0));
    }
  return grasping::HeightMap(depth, camera, T, config);
}

bool covered(const std::vector<CollisionWorld::Sphere>& spheres, const Eigen::Vector3d& p, double slack) {
  for (const auto& s : spheres)
    if ((s.center - p).norm() < s.radius + slack) return true;
  return false;
}

}  // namespace

TEST(CollisionWorld, ObservingPoseIsFreeAndOutOfTheCamerasView) {
  const CellConfig config = cell();
  const CollisionWorld world(config);
  EXPECT_EQ(world.describe(config.observe_joints), "");
  const Pose T_tool = kinematics::forward(config.observe_joints);
  EXPECT_LT(T_tool(2, 2), -0.999);  // tool down
  const Pose T_color_base = config.camera.T_base_color.inverse();
  const auto& k = config.camera.color;
  for (const auto& s : world.spheres(config.observe_joints)) {
    if (s.body <= CollisionWorld::kUpperArm) continue;  // base and shoulder stand at the left edge
    const Eigen::Vector3d p = T_color_base * s.center;
    // How far the sphere's centre lies outside the farthest of the view's four planes, m.
    const auto outside = [&](double side, double limit, double f) {
      return (side * f - limit * p.z()) / std::hypot(f, limit);
    };
    const double right = outside(p.x(), k.width - k.cx, k.fx), left = outside(-p.x(), k.cx, k.fx),
                 bottom = outside(p.y(), k.height - k.cy, k.fy), top = outside(-p.y(), k.cy, k.fy);
    EXPECT_GT(std::max({right, left, bottom, top}), s.radius)
        << "body " << s.body << " at " << s.center.transpose();
  }
}

TEST(CollisionWorld, EverythingSolidIsMet) {
  const CollisionWorld world(cell());
  EXPECT_NE(world.describe(tool_down(0.5, 0.0, -0.03)).find("gripper_finger - table"), std::string::npos);
  // Tray walls.
  const TrayConfig tray = cell().tray;
  const double wall = tray.center.y() - tray.inner_size.y() / 2;
  EXPECT_NE(world.describe(tool_down(0.25, wall, 0.02)).find("tray"), std::string::npos);
  // Camera: tool0 close below it.
  const Eigen::Vector3d camera = cell().camera.T_base_camera_link() * cell().camera.body_center;
  EXPECT_NE(world.describe(tool_down(camera.x(), camera.y(), camera.z() - 0.20)).find("camera"),
            std::string::npos);
  EXPECT_TRUE(world.collides(tool_down(0.58, 0.0, 0.44)));  // under the beam
  // The arm itself: the wrist folded onto the upper arm.
  JointVector folded;
  folded << 0.0, -1.57, 2.9, -1.4, -1.57, 0.0;
  EXPECT_NE(world.describe(folded), "");
}

TEST(CollisionWorld, FingerTipsMeetTheTableAtTheirTrueHeight) {
  CollisionWorld world(cell());
  for (const double gap : {0.0, 0.03, 0.06, 0.085}) {
    world.set_gripper_gap(gap);
    const double tip = kinematics::kPadHeight / 2;  // below the TCP
    EXPECT_FALSE(world.collides(tool_down(0.5, 0.0, tip + 0.0005, 0.3, gap)));
    EXPECT_TRUE(world.collides(tool_down(0.5, 0.0, tip - 0.0005, 0.3, gap)));
  }
}

TEST(CollisionWorld, PartsAreMetByTheirHeights) {
  CollisionWorld world(cell());
  const JointVector over = tool_down(0.5, 0.0, 0.06);
  EXPECT_FALSE(world.collides(over));
  world.set_heights(block(0.45, 0.60, -0.05, 0.05, 0.05));
  EXPECT_NE(world.describe(over).find("gripper_finger - parts"), std::string::npos);
  EXPECT_FALSE(world.collides(tool_down(0.5, 0.0, 0.085)));
  EXPECT_FALSE(world.collides(tool_down(0.5, 0.18, 0.06)));
  // Onto the part itself the fingers go unchecked, the palm does not.
  Pose down(Eigen::Translation3d(0.5, 0.0, 0.02));
  down.rotate(Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX()));
  world.set_columns({motion::Column(down)});
  EXPECT_FALSE(world.collides(over));
  EXPECT_FALSE(world.collides(tool_down(0.502, 0.0, 0.06)));
  EXPECT_TRUE(world.collides(tool_down(0.505, 0.0, 0.06)));
  world.set_heights(block(0.45, 0.60, -0.05, 0.05, 0.14));
  EXPECT_NE(world.describe(over).find("gripper - parts"), std::string::npos);
  world.set_heights(grasping::HeightMap());
  world.set_columns({});
  EXPECT_FALSE(world.collides(over));
}

TEST(CollisionWorld, OneNoisyPixelIsNoPart) {
  const CellConfig config = cell();
  CollisionWorld world(config);
  const PinholeIntrinsics camera = config.camera.color;
  cv::Mat depth(camera.height, camera.width, CV_32FC1, cv::Scalar(0.6));
  depth.at<float>(400, 640) = 0.45f;  // (0.5, 0, 0.15)
  world.set_heights(grasping::HeightMap(depth, camera, config.camera.T_base_color, config));
  EXPECT_FALSE(world.collides(tool_down(0.5, 0.0, 0.06)));
}

TEST(CollisionWorld, AHeldPartReachesFartherThanTheGripper) {
  CollisionWorld world(cell());
  const TrayConfig tray = cell().tray;
  const double wall = tray.center.y() - tray.inner_size.y() / 2;
  const JointVector beside = tool_down(0.25, wall + 0.06, 0.05, M_PI / 2);
  world.set_gripper_gap(0.02);
  EXPECT_FALSE(world.collides(beside));
  motion::AttachedPart part{{0, -0.05, 0}, {0, 0.05, 0}, 0.03};
  world.set_attached(part);
  EXPECT_NE(world.describe(tool_down(0.25, wall + 0.06, 0.05, 0.0)).find("held_part - tray"), std::string::npos);
  world.set_attached(std::nullopt);
  EXPECT_FALSE(world.collides(beside));
}

TEST(CollisionWorld, EachPieceOfWhatIsHeldCounts) {
  CollisionWorld world(cell());
  world.set_gripper_gap(0.006);
  const JointVector q = tool_down(0.5, 0.0, 0.30);
  const motion::AttachedPart near{{0, -0.05, 0.02}, {0, 0.05, 0.02}, 0.02};
  const motion::AttachedPart low{{0, -0.05, 0.29}, {0, 0.05, 0.29}, 0.02};
  world.set_attached(std::vector{near});
  EXPECT_EQ(world.describe(q), "");
  world.set_attached(std::vector{near, low});
  EXPECT_EQ(world.describe(q), "held_part - table");
}

// Every vertex of the URDF's collision meshes lies in a sphere, but for 4 mm.
TEST(CollisionWorld, SpheresCoverTheRobotsMeshes) {
  const std::string robot = kSource + "/assets/robot/";
  if (!std::ifstream(robot + "ur5/collision/forearm.stl"))
    GTEST_SKIP() << "the robot's meshes are not there: run scripts/setup";
  std::stringstream urdf;
  urdf << std::ifstream(kSource + "/urdf/cell.urdf").rdbuf();
  CollisionWorld world(cell());
  const auto mesh = [&](const std::string& link, const std::string& file, const Pose& T_base_link,
                        const Pose& T_link_mesh) {
    for (const double gap : {0.002, 0.04, 0.085}) {
      if (gap > 0.002 && file.find("robotiq") == std::string::npos) continue;
      world.set_gripper_gap(gap);
      const auto spheres = world.spheres(JointVector::Constant(0.4));
      int outside = 0;
      for (const auto& v : load_stl(robot + file).vertices)
        outside += !covered(spheres, T_base_link * T_link_mesh * v.cast<double>(), 0.004);
      EXPECT_EQ(outside, 0) << link << " at gap " << gap;
    }
  };
  const auto rotated = [](double roll, double pitch, double yaw, double z) {
    Pose T = Pose::Identity();
    T.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) * Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                  Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX())).toRotationMatrix();
    T.translation().z() = z;
    return T;
  };
  const double half = M_PI / 2;
  const struct {
    const char *link, *file;
    Pose T_link_mesh;
  } arm[] = {{"shoulder_link", "shoulder", rotated(0, 0, M_PI, 0)},
             {"upper_arm_link", "upperarm", rotated(half, 0, -half, 0.13585)},
             {"forearm_link", "forearm", rotated(half, 0, -half, 0.0165)},
             {"wrist_1_link", "wrist1", rotated(half, 0, 0, -0.093)},
             {"wrist_2_link", "wrist2", rotated(0, 0, 0, -0.095)},
             {"wrist_3_link", "wrist3", rotated(half, 0, 0, -0.0818)}};
  for (const auto& a : arm) {
    const kinematics::KdlChain chain(urdf.str(), "base_link", a.link);
    const Pose T = chain.forward(Eigen::VectorXd::Constant(chain.lower().size(), 0.4));
    mesh(a.link, std::string("ur5/collision/") + a.file + ".stl", T, a.T_link_mesh);
  }
  const Pose T_tool = kinematics::forward(JointVector::Constant(0.4));
  const kinematics::KdlChain base(urdf.str(), "base_link", "robotiq_arg2f_base_link");
  mesh("robotiq_arg2f_base_link", "robotiq_2f_85/collision/base_link.stl",
       base.forward(Eigen::VectorXd::Constant(6, 0.4)), Pose::Identity());
  EXPECT_LT((base.forward(Eigen::VectorXd::Constant(6, 0.4)).translation() - T_tool.translation()).norm(), 1e-6);
}

TEST(CollisionWorld, ToolPointsDownOverWorkspaceAndTrayWithoutCollision) {
  const CellConfig config = cell();
  CollisionWorld world(config);
  for (const double gap : {0.02, 0.085}) {
    world.set_gripper_gap(gap);
    for (int yaw = 0; yaw < 8; ++yaw)
      for (double x = config.workspace_min.x(); x <= config.workspace_max.x() + 1e-9; x += 0.08)
        for (double y = config.workspace_min.y(); y <= config.workspace_max.y() + 1e-9; y += 0.08)
          for (const double z : {0.022, 0.05, 0.12}) {
            // Some configuration, with either turn of the wrist.
            bool free = false;
            for (const double turn : {0.0, M_PI})
              free = free || !world.collides(tool_down(x, y, z, yaw * M_PI / 8 + turn, gap));
            EXPECT_TRUE(free) << x << " " << y << " " << z << " yaw " << yaw << " gap " << gap << ": "
                              << world.describe(tool_down(x, y, z, yaw * M_PI / 8, gap));
          }
  }
  world.set_gripper_gap(0.034);
  for (const Eigen::Vector3d& slot : config.tray.slots())
    for (const double height : {0.024, 0.12})
      EXPECT_EQ(world.describe(tool_down(slot.x(), slot.y(), slot.z() + height, 0.0, 0.034)), "");
}
