// Rendered images against analytic geometry and photometry.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <functional>
#include <random>
#include <utility>
#include <vector>

#include "iwgnet_grasp/sensing/pinhole.h"
#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::sensing {
namespace {

const PinholeIntrinsics kCamera{322, 241, 200, 200, 160.5, 120.0};  // sizes no multiple of a tile

Pose at(double x, double y, double z) { return Pose(Eigen::Translation3d(x, y, z)); }

TriangleMesh sphere(double radius, int rings) {
  TriangleMesh mesh;
  for (int i = 0; i <= rings; ++i)
    for (int j = 0; j < 2 * rings; ++j) {
      const double a = M_PI * i / rings, b = M_PI * j / rings;
      mesh.vertices.emplace_back(radius * std::sin(a) * std::cos(b),
                                 radius * std::sin(a) * std::sin(b), radius * std::cos(a));
    }
  const auto index = [&](int i, int j) { return static_cast<std::uint32_t>(i * 2 * rings + j % (2 * rings)); };
  for (int i = 0; i < rings; ++i)
    for (int j = 0; j < 2 * rings; ++j) {
      mesh.triangles.push_back({index(i, j), index(i + 1, j), index(i + 1, j + 1)});
      mesh.triangles.push_back({index(i, j), index(i + 1, j + 1), index(i, j + 1)});
    }
  return mesh;
}

TEST(Depth, PlaneIsExact) {
  Renderer renderer;
  renderer.add_instance(renderer.add_box({4, 4, 0.2}), {}, at(0, 0, 1.1));
  const cv::Mat depth = renderer.depth(kCamera, Pose::Identity());
  ASSERT_EQ(depth.size(), cv::Size(kCamera.width, kCamera.height));
  double low, high;
  cv::minMaxLoc(depth, &low, &high);
  EXPECT_NEAR(low, 1.0, 1e-6);
  EXPECT_NEAR(high, 1.0, 1e-6);
}

TEST(Depth, SphereMatchesTheQuadratic) {
  Renderer renderer;
  const double radius = 0.3, distance = 1.0;
  renderer.add_instance(renderer.add_mesh(sphere(radius, 200)), {}, at(0, 0, distance));
  const cv::Mat depth = renderer.depth(kCamera, Pose::Identity());
  int hits = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u) {
      // |t d - c|^2 = r^2 with d = (x, y, 1)
      const Eigen::Vector3d d = deproject(kCamera, u, v, 1.0);
      const double discriminant = distance * distance - d.squaredNorm() * (distance * distance - radius * radius);
      if (discriminant > 0.01) {
        ++hits;
        const double t = (distance - std::sqrt(discriminant)) / d.squaredNorm();
        ASSERT_NEAR(depth.at<float>(v, u), t, 2e-4) << u << ", " << v;
      } else if (discriminant < -0.01) {
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u)));
      }
    }
  EXPECT_GT(hits, 5000);
}

// The table goes on beside and behind the camera, which looks down at it at 25 deg, rolled by 10 deg.
TEST(Depth, TableUnderATiltedCameraIsExact) {
  const PinholeIntrinsics camera{640, 600, 400, 400, 319.5, 250};  // several bands of rows
  Renderer renderer;
  renderer.add_instance(renderer.add_box({3, 3, 0.1}), {}, at(0, 0, -0.05));
  const double height = 0.6;
  Pose T_base_camera = at(0, 0, height);
  T_base_camera.linear() << 0, 0, 1, -1, 0, 0, 0, -1, 0;  // looks along x
  T_base_camera.rotate(Eigen::AngleAxisd(-25 * M_PI / 180, Eigen::Vector3d::UnitX()));
  T_base_camera.rotate(Eigen::AngleAxisd(10 * M_PI / 180, Eigen::Vector3d::UnitZ()));
  const cv::Mat depth = renderer.depth(camera, T_base_camera);
  int hits = 0, misses = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u) {
      const Eigen::Vector3d d = T_base_camera.linear() * deproject(camera, u, v, 1.0);
      const double z = -height / d.z();
      const double beside = (z * d).head<2>().cwiseAbs().maxCoeff() - 1.5;  // m, of the table
      if (z > 0 && beside < -1e-6) {
        ++hits;
        ASSERT_NEAR(depth.at<float>(v, u), z, 1e-6) << u << ", " << v;
      } else if (z < 0 || beside > 0.1) {
        ++misses;
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u))) << u << ", " << v;
      }
    }
  EXPECT_GT(hits, 80000);
  EXPECT_GT(misses, 40000);
}

// Triangles of any winding around the camera, many of them partly behind it. For a ray d, the solution
// of (a b c) x = d is positive where it meets the triangle, and the sum of x is the inverse depth.
TEST(Depth, IsOfTheNearestTriangleOnARaySeenFromEitherSide) {
  std::mt19937 random(5);
  std::uniform_real_distribution<float> metre(-1, 1);
  Pose T_base_camera = at(0.1, -0.2, 0.3);
  T_base_camera.rotate(Eigen::AngleAxisd(1.0, Eigen::Vector3d(1, -2, 0.5).normalized()));
  Renderer renderer;
  std::vector<Eigen::Matrix3d> inverses;
  int fronts = 0, crossing = 0;
  for (int i = 0; i < 40; ++i) {
    TriangleMesh mesh{{}, {{0, 1, 2}}};
    for (int k = 0; k < 3; ++k) mesh.vertices.emplace_back(metre(random), metre(random), metre(random));
    Pose T = at(metre(random), metre(random), metre(random));
    T.rotate(Eigen::AngleAxisd(3 * metre(random), Eigen::Vector3d::UnitY()));
    renderer.add_instance(renderer.add_mesh(mesh), {}, T);
    Eigen::Matrix3d corners;
    for (int k = 0; k < 3; ++k)
      corners.col(k) = T_base_camera.inverse() * T * mesh.vertices[k].cast<double>();
    inverses.push_back(corners.inverse());
    fronts += corners.determinant() < 0;
    crossing += corners.row(2).minCoeff() < 0 && corners.row(2).maxCoeff() > 0;
  }
  EXPECT_GT(fronts, 10);
  EXPECT_LT(fronts, 30);
  EXPECT_GT(crossing, 10);
  cv::Mat ids;
  const cv::Mat depth = renderer.depth(kCamera, T_base_camera, &ids);
  EXPECT_EQ(cv::countNonZero(renderer.instances(kCamera, T_base_camera) != ids), 0);
  int checked = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u) {
      double nearest = 0, second = 0;
      int seen = -1;
      bool on_an_edge = false;
      for (std::size_t i = 0; i < inverses.size(); ++i) {
        const Eigen::Vector3d x = inverses[i] * deproject(kCamera, u, v, 1.0);
        const double margin = 1e-6 * x.cwiseAbs().maxCoeff();
        on_an_edge |= std::abs(x.minCoeff()) < margin;
        if (x.minCoeff() <= 0) continue;
        second = std::max(second, std::min(x.sum(), nearest));
        if (x.sum() > nearest) {
          nearest = x.sum();
          seen = static_cast<int>(i);
        }
      }
      if (on_an_edge || (second > 0 && 1 / second - 1 / nearest < 1e-5)) continue;
      ++checked;
      ASSERT_EQ(ids.at<int>(v, u), seen) << u << ", " << v;
      if (seen < 0)
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u))) << u << ", " << v;
      else
        ASSERT_NEAR(depth.at<float>(v, u), 1 / nearest, 1e-6) << u << ", " << v;
    }
  EXPECT_GT(checked, 0.99 * depth.total());
}

// Tiles of all shapes down to slivers of 1/30 px, many with a corner or a side right on a pixel.
TEST(Depth, APlaneOfManyTrianglesHasNoHoles) {
  const Eigen::Vector3d normal = Eigen::Vector3d(0.3, -0.5, 1).normalized();
  const auto depth_at = [&](double u, double v) {  // of the plane normal * p = 0.6
    return 0.6 / normal.dot(deproject(kCamera, u, v, 1.0));
  };
  Pose turned = at(0.4, -0.3, 0.9);
  turned.rotate(Eigen::AngleAxisd(2.0, Eigen::Vector3d(3, 1, -2).normalized()));
  for (const Pose& T_base_camera : {Pose::Identity(), turned})
    for (const auto& [across, down] :
         {std::pair(1.0, 1.0), {0.5, 2.5}, {1.0 / 30, 37.0}, {53.0, 1.0 / 30}, {300.0, 250.0}}) {
      const int columns = cvCeil(kCamera.width / across), rows = cvCeil(kCamera.height / down);
      TriangleMesh mesh;
      for (int j = 0; j <= rows; ++j)
        for (int i = 0; i <= columns; ++i) {
          const double u = -1 + i * across * 1.01, v = -1 + j * down * 1.01;
          mesh.vertices.push_back(
              (T_base_camera * deproject(kCamera, u, v, depth_at(u, v))).cast<float>());
          if (i == columns || j == rows) continue;
          const std::uint32_t a = j * (columns + 1) + i, b = a + columns + 1;
          mesh.triangles.push_back({a, a + 1, b});
          mesh.triangles.push_back({b, a + 1, b + 1});
        }
      Renderer renderer;
      renderer.add_instance(renderer.add_mesh(mesh), {}, Pose::Identity());
      const cv::Mat depth = renderer.depth(kCamera, T_base_camera);
      for (int v = 0; v < depth.rows; ++v)
        for (int u = 0; u < depth.cols; ++u)
          ASSERT_NEAR(depth.at<float>(v, u), depth_at(u, v), 2e-6)
              << u << ", " << v << "; tiles of " << across << " x " << down << " px";
    }
}

TEST(Depth, AFaceSeenEdgeOnLeavesNoTrace) {
  PinholeIntrinsics camera = kCamera;
  camera.cx = 160;  // the rays of this column lie in the box's left face
  Renderer renderer;
  renderer.add_instance(renderer.add_box({0.25, 0.25, 0.25}), {}, at(0.125, 0, 1.125));
  const cv::Mat depth = renderer.depth(camera, Pose::Identity());
  for (int u : {160, 161, 184})
    for (int v = 96; v <= 144; ++v) ASSERT_NEAR(depth.at<float>(v, u), 1.0, 1e-6) << u << ", " << v;
  EXPECT_TRUE(std::isnan(depth.at<float>(120, 159)));
}

TEST(Depth, FollowsCameraAndInstancePoses) {
  Renderer renderer;
  const int box = renderer.add_instance(renderer.add_box({0.2, 0.2, 0.2}), {}, at(0.5, 0.1, 0.1));
  Pose T_base_camera = at(0.5, 0.1, 1.0);
  T_base_camera.linear() = Eigen::Vector3d(1, -1, -1).asDiagonal();
  const auto center = [&] { return renderer.depth(kCamera, T_base_camera).at<float>(120, 160); };
  EXPECT_NEAR(center(), 0.8, 1e-6);
  renderer.set_pose(box, at(0.5, 0.1, 0.3));
  EXPECT_NEAR(center(), 0.6, 1e-6);
  renderer.set_visible(box, false);
  EXPECT_TRUE(std::isnan(center()));
  renderer.set_visible(box, true);
  EXPECT_NEAR(center(), 0.6, 1e-6);
}

TEST(Instances, NameWhatEachPixelShows) {
  Renderer renderer;
  const int box = renderer.add_box({0.2, 0.2, 0.02});
  const int left = renderer.add_instance(box, {}, at(-0.2, 0, 1));
  const int right = renderer.add_instance(box, {}, at(0.2, 0, 1));
  const cv::Mat ids = renderer.instances(kCamera, Pose::Identity());
  const auto seen = [&](double x) {
    return ids.at<int>(120, cvRound(kCamera.cx + kCamera.fx * x / 0.99));
  };
  EXPECT_EQ(seen(-0.2), left);
  EXPECT_EQ(seen(0.2), right);
  EXPECT_EQ(seen(0.0), -1);
  renderer.clear_instances();
  EXPECT_EQ(cv::countNonZero(renderer.instances(kCamera, Pose::Identity()) != -1), 0);
  EXPECT_EQ(renderer.add_instance(box, {}, at(0, 0, 1)), 0);  // meshes stay
  EXPECT_EQ(renderer.instances(kCamera, Pose::Identity()).at<int>(120, 160), 0);
}

// What lies in the region looks the same to the bit; the rest is empty.
TEST(Region, LimitsWhatIsDrawn) {
  Renderer renderer;
  renderer.add_instance(renderer.add_mesh(sphere(0.3, 40)), {}, at(0.1, 0.05, 1.0));
  renderer.add_instance(renderer.add_box({4, 4, 0.2}), {}, at(0, 0, 1.4));
  cv::Mat whole_ids, ids;
  const cv::Mat whole = renderer.depth(kCamera, Pose::Identity(), &whole_ids);
  const Eigen::AlignedBox3d box(Eigen::Vector3d(-0.11, -0.07, 0.6), Eigen::Vector3d(0.23, 0.17, 1.2));
  renderer.set_region(box);
  const cv::Mat depth = renderer.depth(kCamera, Pose::Identity(), &ids);
  int inside = 0, outside = 0;
  for (int v = 0; v < depth.rows; ++v)
    for (int u = 0; u < depth.cols; ++u) {
      const float z = whole.at<float>(v, u);
      if (box.contains(deproject(kCamera, u, v, z))) {
        ++inside;
        ASSERT_EQ(depth.at<float>(v, u), z) << u << ", " << v;
        ASSERT_EQ(ids.at<int>(v, u), whole_ids.at<int>(v, u));
      } else if (u < kCamera.cx - 0.11 / 0.6 * kCamera.fx - 1 ||
                 v > kCamera.cy + 0.17 / 0.6 * kCamera.fy + 2) {
        ++outside;
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u))) << u << ", " << v;
        ASSERT_EQ(ids.at<int>(v, u), -1);
      }
    }
  EXPECT_GT(inside, 1000);
  EXPECT_GT(outside, 1000);
  renderer.set_region({});
  EXPECT_EQ(cv::countNonZero(renderer.depth(kCamera, Pose::Identity()) != whole), 0);
}

// A matt grey floor seen from above, lit by a small lamp beside the camera.
struct Scene {
  Renderer renderer;
  Light light;
  Pose T_base_camera = at(0, 0, 1);
  Scene() {
    T_base_camera.linear() = Eigen::Vector3d(1, -1, -1).asDiagonal();
    renderer.add_instance(renderer.add_box({4, 4, 0.1}), {{0.3f, 0.3f, 0.3f}, 0, 1, 0}, at(0, 0, -0.05));
    light.position = {0.8f, 0, 1};
    light.ambient = 0.2f;
    light.radius = 0.05f;
  }
  double brightness(double x, double y) {
    const cv::Mat image = renderer.color(kCamera, T_base_camera, light, 0, 0);
    const int u = cvRound(kCamera.cx + kCamera.fx * x), v = cvRound(kCamera.cy - kCamera.fy * y);
    return cv::mean(image(cv::Rect(u - 1, v - 1, 3, 3)))[1];
  }
};

TEST(Color, BlockerCastsItsShadowWhereTheRayFromTheLampFalls) {
  Scene scene;
  const double before = scene.brightness(-0.2, 0);
  // A plate 0.2 m above the floor between lamp and (-0.2, 0): the ray passes x = 0 at z = 0.2.
  scene.renderer.add_instance(scene.renderer.add_box({0.1, 0.1, 0.01}), {}, at(0.0, 0, 0.2));
  EXPECT_LT(scene.brightness(-0.2, 0), 0.75 * before);
  EXPECT_NEAR(scene.brightness(-0.2, 0.3), before, 0.15 * before);  // beside the shadow
  EXPECT_GT(scene.brightness(-0.2, 0), 0);                           // ambient light remains
}

TEST(Color, PenumbraGrowsWithTheLamp) {
  const auto penumbra = [](float radius) {
    Scene scene;
    scene.light.radius = radius;
    scene.renderer.add_instance(scene.renderer.add_box({0.1, 0.6, 0.01}), {}, at(0.0, 0, 0.2));
    const cv::Mat image = scene.renderer.color(kCamera, scene.T_base_camera, scene.light, 0, 0);
    double low = 255, high = 0;
    const auto value = [&](int u) { return image.at<cv::Vec3b>(120, u)[1]; };
    const int from = cvRound(kCamera.cx - kCamera.fx * 0.34), to = cvRound(kCamera.cx - kCamera.fx * 0.19);
    for (int u = from; u < to; ++u) {
      low = std::min<double>(low, value(u));
      high = std::max<double>(high, value(u));
    }
    int width = 0;
    for (int u = from; u < to; ++u)
      width += value(u) > low + 0.15 * (high - low) && value(u) < high - 0.15 * (high - low);
    return width;
  };
  EXPECT_LE(penumbra(0.0f), 4);  // the filter's four pixels
  EXPECT_GT(penumbra(0.15f), penumbra(0.0f) + 4);
}

TEST(Color, NoiseHasTheAskedDeviationAndComesFromTheSeed) {
  Scene scene;
  const auto shot = [&](double sigma, std::uint64_t seed) {
    return scene.renderer.color(kCamera, scene.T_base_camera, scene.light, sigma, seed);
  };
  const cv::Mat clean = shot(0, 1), noisy = shot(4, 1);
  cv::Mat difference;
  cv::subtract(noisy, clean, difference, cv::noArray(), CV_32FC3);
  cv::Scalar mean, deviation;
  cv::meanStdDev(difference, mean, deviation);
  for (int c = 0; c < 3; ++c) {
    EXPECT_NEAR(mean[c], 0, 0.1);
    EXPECT_NEAR(deviation[c], 4, 0.15);
  }
  const cv::Mat again = shot(4, 1), other = shot(4, 2);
  EXPECT_EQ(std::memcmp(again.data, noisy.data, noisy.total() * 3), 0);
  EXPECT_NE(std::memcmp(other.data, noisy.data, noisy.total() * 3), 0);
}

TEST(Color, AlbedoAndHueReachTheImage) {
  Scene scene;
  const int box = scene.renderer.add_instance(scene.renderer.add_box({0.3, 0.3, 0.01}), {}, at(0, 0, 0.005));
  scene.renderer.set_material(box, {{0.6f, 0.1f, 0.05f}, 0, 1, 0});
  const cv::Vec3b red = scene.renderer.color(kCamera, scene.T_base_camera, scene.light, 0, 0).at<cv::Vec3b>(120, 160);
  EXPECT_GT(red[0], 1.5 * red[1]);  // RGB order
  EXPECT_GT(red[1], red[2]);
  scene.renderer.set_material(box, {{0.02f, 0.02f, 0.02f}, 0, 1, 0});
  const cv::Vec3b dark = scene.renderer.color(kCamera, scene.T_base_camera, scene.light, 0, 0).at<cv::Vec3b>(120, 160);
  EXPECT_LT(dark[0], 0.5 * red[0]);
}

// Left half black, right half white, in light without shadow. The lens's blur acts on display values,
// where light weighs less: the edge is seen up to a fifth of a pixel on the dark side of its place,
// nowhere half a pixel off, as it would be with one look a pixel.
TEST(Color, APrintsEdgeIsSmoothAndInItsPlace) {
  Scene scene;
  cv::Mat print(100, 200, CV_8UC1, cv::Scalar(0));
  print.colRange(100, 200).setTo(255);
  const int sheet = scene.renderer.add_instance(scene.renderer.add_sheet({0.4, 0.2}, print),
                                                {{0, 0, 0}, 0, 1, 0}, Pose::Identity());
  scene.light.ambient = 1.0f;
  // Where it is seen minus where it belongs, px.
  const auto error = [&](double x) {
    scene.renderer.set_pose(sheet, at(x, 0, 0.05));
    const cv::Mat image = scene.renderer.color(kCamera, scene.T_base_camera, scene.light, 0, 0);
    const double edge =
        project(kCamera, scene.T_base_camera.inverse() * Eigen::Vector3d(x, 0, 0.05)).x();
    const int from = cvFloor(edge) - 8, to = cvFloor(edge) + 9;
    const auto light = [&](int u) { return std::pow(image.at<cv::Vec3b>(120, u)[1] / 255.0, 2.2); };
    const double black = light(from), white = light(to);
    EXPECT_GT(white, 3 * black);
    double dark = 0;  // px, the transition's share of black
    for (int u = from; u <= to; ++u) dark += (white - light(u)) / (white - black);
    return from - 0.5 + dark - edge;
  };
  for (const double x : {0.0, 0.0007, 0.0013, 0.0021, 0.0029}) EXPECT_NEAR(error(x), 0.1, 0.2) << x;
}

// A cell of its own for each image, or one whose images follow each other and are drawn anew only
// where something has changed.
struct Moving {
  struct Object {
    Pose T;
    Material material;
    bool visible = true;
  };
  Renderer renderer;
  Pose T_base_camera = at(0, 0, 0.6);
  Light light{{0.1f, -0.7f, 1.7f}, {1, 1, 1}, 0.4f, 0.1f};
  std::vector<Object> objects;

  Moving() {
    T_base_camera.linear() = Eigen::Vector3d(1, -1, -1).asDiagonal();
    renderer.add_instance(renderer.add_box({2, 2, 0.1}), {}, at(0, 0, -0.05));
    const int block = renderer.add_box({0.15, 0.04, 0.03}), ball = renderer.add_mesh(sphere(0.04, 12));
    const int beam = renderer.add_box({0.1, 0.1, 0.5});
    for (const auto& [mesh, T] : {std::pair(block, at(0.1, 0, 0.015)), {block, at(0.11, 0.02, 0.046)},
                                  {ball, at(-0.15, 0.05, 0.04)}, {beam, at(0.1, -0.45, 0.65)}}) {
      objects.push_back({T, {}});
      renderer.add_instance(mesh, {}, T);
    }
  }
  void put(const std::vector<Object>& as) {
    objects = as;
    for (std::size_t i = 0; i < objects.size(); ++i) {
      const int handle = static_cast<int>(i) + 1;
      renderer.set_pose(handle, objects[i].T);
      renderer.set_material(handle, objects[i].material);
      renderer.set_visible(handle, objects[i].visible);
    }
  }
  cv::Mat color() { return renderer.color(kCamera, T_base_camera, light, 1.0, 3); }
  cv::Mat depth() { return renderer.depth(kCamera, T_base_camera); }
};

TEST(Renderer, ImagesAfterAChangeAreThoseOfANewRendererToTheBit) {
  Moving one;
  one.color();
  one.depth();
  const std::vector<std::pair<const char*, std::function<void(Moving&)>>> changes{
      {"a block moves", [](Moving& m) { m.objects[0].T = at(0.05, -0.03, 0.015); }},
      {"the upper block turns in the air", [](Moving& m) {
         m.objects[1].T = at(0.0, 0.08, 0.2) * Eigen::AngleAxisd(0.7, Eigen::Vector3d(1, 2, 3).normalized());
       }},
      {"a beam beside the view moves its shadow", [](Moving& m) { m.objects[3].T = at(0.0, -0.5, 0.7); }},
      {"a beam passes the camera's height", [](Moving& m) { m.objects[3].T = at(0.15, -0.3, 0.62); }},
      {"a beam comes to the lamp", [](Moving& m) { m.objects[3].T = at(0.2, -0.6, 1.5); }},
      {"the ball goes", [](Moving& m) { m.objects[2].visible = false; }},
      {"the ball comes back, dark", [](Moving& m) {
         m.objects[2].visible = true;
         m.objects[2].material.albedo = {0.05f, 0.05f, 0.1f};
       }},
      {"the lamp moves", [](Moving& m) { m.light.position.x() = -0.4f; }},
      {"the camera moves", [](Moving& m) { m.T_base_camera.translation().x() = 0.02; }},
      {"nothing", [](Moving&) {}},
  };
  cv::Mat before = one.color();
  for (const auto& [name, change] : changes) {
    change(one);
    one.put(one.objects);
    Moving fresh;
    fresh.light = one.light;
    fresh.T_base_camera = one.T_base_camera;
    fresh.put(one.objects);
    const cv::Mat color = one.color(), depth = one.depth();
    const cv::Mat expected = fresh.color(), expected_depth = fresh.depth();
    EXPECT_EQ(std::memcmp(color.data, expected.data, color.total() * 3), 0) << name;
    EXPECT_EQ(std::memcmp(depth.data, expected_depth.data, depth.total() * 4), 0) << name;
    EXPECT_EQ(std::memcmp(color.data, before.data, color.total() * 3) == 0,
              std::string(name) == "nothing")
        << name;
    before = color;
  }
}

TEST(Renderer, ImagesOfASceneDoNotDependOnTheSceneBefore) {
  const auto image = [](Renderer& renderer, double x) {
    renderer.clear_instances();
    renderer.add_instance(0, {}, at(x, 0, 0.5) * Eigen::AngleAxisd(0.5, Eigen::Vector3d::UnitY()));
    return std::pair(renderer.depth(kCamera, Pose::Identity()),
                     renderer.color(kCamera, Pose::Identity(), {}, 0, 0));
  };
  Renderer first, second;
  for (Renderer* renderer : {&first, &second}) renderer->add_box({0.1, 0.1, 0.1});
  const double hair = 5e-5;  // m, less than what makes an object of the same scene be drawn anew
  image(first, 0.0);
  const auto [depth, color] = image(first, hair);
  const auto [expected_depth, expected_color] = image(second, hair);
  EXPECT_EQ(std::memcmp(depth.data, expected_depth.data, depth.total() * 4), 0);
  EXPECT_EQ(std::memcmp(color.data, expected_color.data, color.total() * 3), 0);
}

TEST(Renderer, BadInputIsRefused) {
  Renderer renderer;
  EXPECT_THROW(renderer.add_mesh({}), Error);
  TriangleMesh broken;
  broken.vertices.resize(3);
  broken.triangles.push_back({0, 1, 7});
  EXPECT_THROW(renderer.add_mesh(broken), Error);
  EXPECT_THROW(renderer.add_instance(0, {}, Pose::Identity()), Error);
  EXPECT_THROW(renderer.set_pose(3, Pose::Identity()), Error);
  EXPECT_THROW(renderer.depth({}, Pose::Identity()), Error);
  EXPECT_THROW(renderer.add_sheet({0.1, 0.1}, cv::Mat()), Error);
  EXPECT_THROW(renderer.add_sheet({0.1, 0.0}, cv::Mat(4, 4, CV_8UC1)), Error);
  EXPECT_THROW(renderer.add_sheet({0.1, 0.1}, cv::Mat(4, 4, CV_8UC3)), Error);
}

}  // namespace
}  // namespace iwgnet_grasp::sensing
