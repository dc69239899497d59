#include "iwgnet_grasp/sensing/renderer.h"

#include <embree3/rtcore.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <utility>

#include "changed_tiles.h"
#include "iwgnet_grasp/sensing/pinhole.h"
#include "parallel.h"
#include "rasteriser.h"
#include "shading.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr int kTile = 4;  // pixels; 4 x 4 coherent rays make a packet
constexpr int kLanes = kTile * kTile;
constexpr int kBand = 256;  // rows of a depth image that one thread draws at a time
constexpr float kFar = std::numeric_limits<float>::infinity();
constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kOcclusionRange = 0.08f;  // m, of ambient occlusion: the size of the parts
constexpr float kSurfaceOffset = 2e-5f;   // m, keeps secondary rays off their own surface
constexpr float kCrease = 0.77f;          // cos 40 deg: sharper edges are not shaded smooth
constexpr int kPrintSamples = 6;          // a side of a pixel: the print's edges are smooth in the image
constexpr double kStill = 3e-4;  // m, a third of a pixel: an object that moves less is drawn where it was
constexpr float kFilterDepth = 0.004f;    // m, shadows are not smoothed across larger steps

struct Mesh {
  RTCScene scene = nullptr;
  TriangleMesh triangles;
  std::vector<std::array<Vec3, 3>> normals;  // of each triangle's corners, mesh frame
  Eigen::AlignedBox3d box;                   // mesh frame
  cv::Mat print;                             // of a sheet, CV_8UC1; else empty
  float print_width = 0, print_height = 0;   // m
};

struct Instance {
  int mesh;
  RTCGeometry geometry;
  Material material;
  Pose T_base_instance;
  Rotation R;  // the same in single precision
  Vec3 t;
  bool visible = true;
};

bool same(const Material& a, const Material& b) {
  return a.albedo == b.albedo && a.metallic == b.metallic && a.roughness == b.roughness &&
         a.texture == b.texture;
}
bool same(const Light& a, const Light& b) {
  return a.position == b.position && a.intensity == b.intensity && a.ambient == b.ambient &&
         a.radius == b.radius;
}
bool same(const PinholeIntrinsics& a, const PinholeIntrinsics& b) {
  return a.width == b.width && a.height == b.height && a.fx == b.fx && a.fy == b.fy &&
         a.cx == b.cx && a.cy == b.cy;
}

// What a colour image was made of, so that the next is made anew only where it may differ.
struct Drawn {
  struct Object {
    int mesh;
    Material material;
    bool visible;
    Points corners;  // of its box
  };
  PinholeIntrinsics camera{};
  Pose T_base_camera = Pose::Identity();
  Light light;
  std::vector<Object> objects;
  bool whole = false;  // there is such an image

  bool of(const PinholeIntrinsics& by, const Pose& T) const {
    return whole && same(by, camera) && T.matrix() == T_base_camera.matrix();
  }
};

// Smooth shading: a corner's normal is the mean of the faces around it, weighted by their area,
// that do not lie beyond a crease.
std::vector<std::array<Vec3, 3>> corner_normals(const TriangleMesh& mesh) {
  const std::size_t n = mesh.triangles.size();
  std::vector<Eigen::Vector3f> area(n), unit(n);
  std::vector<std::vector<std::uint32_t>> around(mesh.vertices.size());
  for (std::size_t i = 0; i < n; ++i) {
    const auto& [a, b, c] = mesh.triangles[i];
    area[i] = (mesh.vertices[b] - mesh.vertices[a]).cross(mesh.vertices[c] - mesh.vertices[a]);
    unit[i] = area[i].stableNormalized();
    for (const auto corner : mesh.triangles[i]) around[corner].push_back(i);
  }
  std::vector<std::array<Vec3, 3>> normals(n);
  for (std::size_t i = 0; i < n; ++i)
    for (int k = 0; k < 3; ++k) {
      Eigen::Vector3f sum = Eigen::Vector3f::Zero();
      for (const auto face : around[mesh.triangles[i][k]])
        if (unit[face].dot(unit[i]) > kCrease) sum += area[face];
      const Eigen::Vector3f normal = sum.stableNormalized();
      normals[i][k] = {normal.x(), normal.y(), normal.z()};
    }
  return normals;
}

TriangleMesh box_mesh(const Eigen::Vector3d& size) {
  TriangleMesh mesh;
  for (int i = 0; i < 8; ++i)
    mesh.vertices.emplace_back(size.x() * ((i & 1) - 0.5), size.y() * ((i >> 1 & 1) - 0.5),
                               size.z() * ((i >> 2 & 1) - 0.5));
  mesh.triangles = {{0, 2, 1}, {1, 2, 3}, {4, 5, 6}, {5, 7, 6}, {0, 1, 4}, {1, 5, 4},
                    {2, 6, 3}, {3, 6, 7}, {0, 4, 2}, {2, 4, 6}, {1, 3, 5}, {3, 7, 5}};
  return mesh;
}

// Rays of a camera in the base frame, unnormalised: at parameter t the depth is t.
struct RayFrame {
  Vec3 origin, corner, right, down;  // corner: direction of pixel (0, 0)

  RayFrame(const PinholeIntrinsics& k, const Pose& T) {
    const auto vec = [](const Eigen::Vector3d& v) {
      return Vec3{static_cast<float>(v.x()), static_cast<float>(v.y()), static_cast<float>(v.z())};
    };
    const Eigen::Matrix3d R = T.rotation();
    origin = vec(T.translation());
    corner = vec(R * Eigen::Vector3d(-k.cx / k.fx, -k.cy / k.fy, 1.0));
    right = vec(R.col(0) / k.fx);
    down = vec(R.col(1) / k.fy);
  }
  Vec3 direction(int u, int v) const {
    return corner + right * static_cast<float>(u) + down * static_cast<float>(v);
  }
};

void require_camera(const PinholeIntrinsics& k) {
  if (k.width <= 0 || k.height <= 0 || k.fx <= 0 || k.fy <= 0)
    throw Error("renderer: the camera needs a positive size and focal length");
}

// The rays of 4 x 4 pixels. What is the same for all tiles of a camera is written once.
struct Packet {
  alignas(64) int valid[kLanes];
  RTCRayHit16 hit;
  alignas(64) float dx[kLanes], dy[kLanes], dz[kLanes];  // lane's direction against the tile's first

  Packet(const RayFrame& frame) {
    for (int i = 0; i < kLanes; ++i) {
      const Vec3 d = frame.right * static_cast<float>(i % kTile) +
                     frame.down * static_cast<float>(i / kTile);
      dx[i] = d.x, dy[i] = d.y, dz[i] = d.z;
      hit.ray.org_x[i] = frame.origin.x;
      hit.ray.org_y[i] = frame.origin.y;
      hit.ray.org_z[i] = frame.origin.z;
      hit.ray.tnear[i] = 0.0f;
      hit.ray.time[i] = 0.0f;
      hit.ray.mask[i] = -1u;
      hit.ray.flags[i] = 0;
    }
  }

  // Aims at the tile whose top left pixel is (u, v).
  void aim(const RayFrame& frame, const PinholeIntrinsics& camera, int u, int v) {
    const Vec3 first = frame.direction(u, v);
    for (int i = 0; i < kLanes; ++i) {
      valid[i] = u + i % kTile < camera.width && v + i / kTile < camera.height ? -1 : 0;
      hit.ray.dir_x[i] = first.x + dx[i];
      hit.ray.dir_y[i] = first.y + dy[i];
      hit.ray.dir_z[i] = first.z + dz[i];
      hit.ray.tfar[i] = kFar;
      hit.hit.geomID[i] = RTC_INVALID_GEOMETRY_ID;
      hit.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
    }
  }
};

// Rays from the surface points of a packet towards the lamp or into the open.
struct ShadowPacket {
  alignas(64) int valid[kLanes] = {};
  RTCRay16 ray = {};

  // Without AVX-512 Embree also reads lanes that are not valid; an empty range keeps them out.
  void skip(int lane) {
    valid[lane] = 0;
    ray.tfar[lane] = -kFar;
  }
  void set(int lane, const Vec3& origin, const Vec3& direction, float range) {
    valid[lane] = -1;
    ray.org_x[lane] = origin.x;
    ray.org_y[lane] = origin.y;
    ray.org_z[lane] = origin.z;
    ray.dir_x[lane] = direction.x;
    ray.dir_y[lane] = direction.y;
    ray.dir_z[lane] = direction.z;
    ray.tnear[lane] = 0.0f;
    ray.tfar[lane] = range;
    ray.time[lane] = 0.0f;
    ray.mask[lane] = -1u;
    ray.flags[lane] = 0;
  }
  bool free(int lane) const { return ray.tfar[lane] >= 0.0f; }  // Embree sets -inf when occluded
};

// Whether the four pixels from x0 in each of the rows hold `value`.
bool uniform(const cv::Mat& image, int x0, int y0, int y1, std::uint8_t value) {
  const std::uint32_t all = value * 0x01010101u;
  for (int y = y0; y < y1; ++y) {
    std::uint32_t four;
    std::memcpy(&four, image.ptr<std::uint8_t>(y) + x0, sizeof four);
    if (four != all) return false;
  }
  return true;
}

}  // namespace

struct Renderer::Impl {
  RTCDevice device = nullptr;
  RTCScene scene = nullptr;
  std::vector<Mesh> meshes;
  std::vector<Instance> instances;
  bool dirty = true;
  Eigen::AlignedBox3d region;  // empty: everywhere
  struct { cv::Mat visibility, direct, ambient, depth, ids, linear; } frame;  // of color()
  Drawn drawn_color;
  float lowest_seen = 0.0f;  // m, z of the lowest surface in the last colour image

  Impl() : device(rtcNewDevice(nullptr)) {
    if (!device) throw Error("renderer: Embree cannot start on this machine");
    new_scene();
  }
  ~Impl() {
    drop_instances();
    rtcReleaseScene(scene);
    for (const Mesh& mesh : meshes) rtcReleaseScene(mesh.scene);
    rtcReleaseDevice(device);
  }

  void new_scene() {
    scene = rtcNewScene(device);
    rtcSetSceneFlags(scene, RTC_SCENE_FLAG_DYNAMIC);
    rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_LOW);
    dirty = true;
  }
  void drop_instances() {
    for (const Instance& instance : instances) rtcReleaseGeometry(instance.geometry);
    instances.clear();
  }

  Instance& instance(int handle) {
    if (handle < 0 || handle >= static_cast<int>(instances.size()))
      throw Error("renderer: there is no instance " + std::to_string(handle));
    return instances[handle];
  }

  void place(Instance& instance, const Pose& T) {
    instance.T_base_instance = T;
    const Eigen::Matrix3f R = T.rotation().cast<float>();
    const Eigen::Vector3f t = T.translation().cast<float>();
    const float columns[12] = {R(0, 0), R(1, 0), R(2, 0), R(0, 1), R(1, 1), R(2, 1),
                               R(0, 2), R(1, 2), R(2, 2), t.x(),   t.y(),   t.z()};
    for (int i = 0; i < 3; ++i) instance.R.column[i] = {R(0, i), R(1, i), R(2, i)};
    instance.t = {t.x(), t.y(), t.z()};
    rtcSetGeometryTransform(instance.geometry, 0, RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR, columns);
    rtcCommitGeometry(instance.geometry);
    dirty = true;
  }

  Points corners(const Instance& instance) const {
    Points corners = corners_of(meshes[instance.mesh].box);
    for (Eigen::Vector3d& corner : corners) {
      const Eigen::Vector3f c = corner.cast<float>();
      const Vec3 p = instance.R * Vec3{c.x(), c.y(), c.z()} + instance.t;
      corner = {p.x, p.y, p.z};
    }
    return corners;
  }

  // The tiles in which a colour image may differ from the one that was drawn, for objects also shade
  // others; it becomes what is drawn.
  ChangedTiles changes(const PinholeIntrinsics& camera, const Pose& T_base_camera,
                       const Light& light) {
    Drawn& drawn = drawn_color;
    ChangedTiles tiles(camera, T_base_camera, kTile);
    bool whole = !drawn.of(camera, T_base_camera) || !same(light, drawn.light) ||
                 drawn.objects.size() != instances.size();
    drawn.objects.resize(instances.size());
    const auto mark = [&](const Points& corners) {
      const Points reached = shaded(corners, light.position.cast<double>(), light.radius,
                                    kOcclusionRange, lowest_seen);
      if (reached.empty()) whole = true;
      tiles.mark(reached);
    };
    for (std::size_t i = 0; i < instances.size(); ++i) {
      const Instance& instance = instances[i];
      Drawn::Object& object = drawn.objects[i];
      Drawn::Object now{instance.mesh, instance.material, instance.visible, corners(instance)};
      if (!whole) {
        double moved = 0.0;
        for (std::size_t k = 0; k < now.corners.size(); ++k)
          moved = std::max(moved, (now.corners[k] - object.corners[k]).norm());
        if (moved < kStill && now.mesh == object.mesh && now.visible == object.visible &&
            same(now.material, object.material))
          continue;
        if (object.visible) mark(object.corners);
        if (now.visible) mark(now.corners);
      }
      object = std::move(now);
    }
    if (whole) tiles.mark_all();
    drawn.camera = camera;
    drawn.T_base_camera = T_base_camera;
    drawn.light = light;
    drawn.whole = true;
    return tiles;
  }

  void commit() {
    if (dirty) rtcCommitScene(scene);
    dirty = false;
  }

  // The pixels that may see the region.
  cv::Rect seen_region(const PinholeIntrinsics& camera, const Pose& T_base_camera) const {
    const cv::Rect image(0, 0, camera.width, camera.height);
    if (region.isEmpty()) return image;
    const Pose T_camera_base = T_base_camera.inverse();
    Eigen::AlignedBox2d seen;
    for (const Eigen::Vector3d& corner : corners_of(region)) {
      const Eigen::Vector3d p = T_camera_base * corner;
      if (!(p.z() > 0)) return image;  // beside or behind the camera: no rectangle bounds it
      seen.extend(project(camera, p));
    }
    const cv::Point first(cvFloor(seen.min().x()), cvFloor(seen.min().y()));
    const cv::Point last(cvCeil(seen.max().x()) + 1, cvCeil(seen.max().y()) + 1);
    return cv::Rect(first, last) & image;
  }

  // Depth and instances.
  std::pair<cv::Mat, cv::Mat> rasterised(const PinholeIntrinsics& camera,
                                         const Pose& T_base_camera) const {
    require_camera(camera);
    const cv::Rect seen = seen_region(camera, T_base_camera);
    cv::Mat depth(camera.height, camera.width, CV_32FC1, kNaN);
    cv::Mat ids(camera.height, camera.width, CV_32SC1, -1);
    parallel_rows(seen.height, kBand, [&](int first, int last) {
      const cv::Rect band(seen.x, seen.y + first, seen.width, last - first);
      Rasteriser rasteriser(camera, T_base_camera, band, depth, ids);
      for (std::size_t i = 0; i < instances.size(); ++i) {
        if (!instances[i].visible) continue;
        const Mesh& mesh = meshes[instances[i].mesh];
        rasteriser.draw(mesh.triangles, mesh.box, instances[i].T_base_instance,
                        static_cast<int>(i));
      }
      rasteriser.finish();
    });
    return {depth, ids};
  }

  Surface surface(const Packet& packet, int lane) const {
    const auto& ray = packet.hit.ray;
    const auto& hit = packet.hit.hit;
    const Instance& instance = instances[hit.instID[0][lane]];
    const auto& corner = meshes[instance.mesh].normals[hit.primID[lane]];
    Surface surface;
    const Vec3 direction{ray.dir_x[lane], ray.dir_y[lane], ray.dir_z[lane]};
    const Vec3 origin{ray.org_x[lane], ray.org_y[lane], ray.org_z[lane]};
    surface.position = origin + direction * ray.tfar[lane];
    surface.to_eye = normalized(direction * -1.0f);
    surface.object_position = transposed_times(instance.R, surface.position - instance.t);
    const float u = hit.u[lane], v = hit.v[lane];
    surface.object_normal =
        normalized(corner[0] * (1.0f - u - v) + corner[1] * u + corner[2] * v);
    surface.face_normal =
        normalized(instance.R * Vec3{hit.Ng_x[lane], hit.Ng_y[lane], hit.Ng_z[lane]});
    if (dot(surface.face_normal, surface.to_eye) < 0.0f) {  // an open mesh seen from behind
      surface.face_normal = surface.face_normal * -1.0f;
      surface.object_normal = surface.object_normal * -1.0f;
    }
    surface.normal = instance.R * surface.object_normal;
    return surface;
  }

  // Mean albedo of the part of a printed sheet that a pixel covers.
  float printed(const Instance& instance, const RayFrame& frame, const Packet& packet,
                int lane) const {
    const Mesh& mesh = meshes[instance.mesh];
    const auto& ray = packet.hit.ray;
    const Rotation& R = instance.R;
    const Vec3 eye = transposed_times(R, frame.origin - instance.t);
    const Vec3 middle =
        transposed_times(R, Vec3{ray.dir_x[lane], ray.dir_y[lane], ray.dir_z[lane]});
    const Vec3 right = transposed_times(R, frame.right), down = transposed_times(R, frame.down);
    int sum = 0;
    for (int i = 0; i < kPrintSamples; ++i)
      for (int j = 0; j < kPrintSamples; ++j) {
        const Vec3 d = middle + right * ((i + 0.5f) / kPrintSamples - 0.5f) +
                       down * ((j + 0.5f) / kPrintSamples - 0.5f);
        const float t = -eye.z / d.z;
        const float x = (eye.x + t * d.x) / mesh.print_width + 0.5f;
        const float y = 0.5f - (eye.y + t * d.y) / mesh.print_height;
        sum += mesh.print.ptr<std::uint8_t>(
            std::clamp(cvFloor(y * mesh.print.rows), 0, mesh.print.rows - 1))[std::clamp(
            cvFloor(x * mesh.print.cols), 0, mesh.print.cols - 1)];
      }
    return sum / (255.0f * kPrintSamples * kPrintSamples);
  }
};

Renderer::Renderer() : impl_(std::make_unique<Impl>()) {}
Renderer::~Renderer() = default;

int Renderer::add_mesh(const TriangleMesh& mesh) {
  if (mesh.triangles.empty()) throw Error("renderer: a mesh needs at least one triangle");
  for (const auto& triangle : mesh.triangles)
    for (const auto corner : triangle)
      if (corner >= mesh.vertices.size())
        throw Error("renderer: a triangle names vertex " + std::to_string(corner) + " of " +
                    std::to_string(mesh.vertices.size()));
  const RTCGeometry geometry = rtcNewGeometry(impl_->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  void* vertices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                           3 * sizeof(float), mesh.vertices.size());
  std::memcpy(vertices, mesh.vertices.data(), mesh.vertices.size() * 3 * sizeof(float));
  void* triangles = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                            3 * sizeof(std::uint32_t), mesh.triangles.size());
  std::memcpy(triangles, mesh.triangles.data(), mesh.triangles.size() * 3 * sizeof(std::uint32_t));
  rtcCommitGeometry(geometry);
  Mesh built;
  built.scene = rtcNewScene(impl_->device);
  rtcAttachGeometry(built.scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(built.scene);
  built.triangles = mesh;
  built.normals = corner_normals(mesh);
  for (const auto& vertex : mesh.vertices) built.box.extend(vertex.cast<double>());
  impl_->meshes.push_back(std::move(built));
  return static_cast<int>(impl_->meshes.size()) - 1;
}

int Renderer::add_box(const Eigen::Vector3d& size) { return add_mesh(box_mesh(size)); }

int Renderer::add_sheet(const Eigen::Vector2d& size, const cv::Mat& print) {
  if (print.type() != CV_8UC1 || print.empty() || !(size.minCoeff() > 0))
    throw Error("renderer: a sheet needs a positive size and a print of type 8UC1");
  const float x = size.x() / 2, y = size.y() / 2;
  const int handle = add_mesh(
      {{{-x, -y, 0}, {x, -y, 0}, {x, y, 0}, {-x, y, 0}}, {{0, 1, 2}, {0, 2, 3}}});
  Mesh& mesh = impl_->meshes[handle];
  mesh.print = print.clone();
  mesh.print_width = size.x();
  mesh.print_height = size.y();
  return handle;
}

int Renderer::add_instance(int mesh, const Material& material, const Pose& T_base_instance) {
  if (mesh < 0 || mesh >= static_cast<int>(impl_->meshes.size()))
    throw Error("renderer: there is no mesh " + std::to_string(mesh));
  const int handle = static_cast<int>(impl_->instances.size());
  Instance instance;
  instance.mesh = mesh;
  instance.material = material;
  instance.geometry = rtcNewGeometry(impl_->device, RTC_GEOMETRY_TYPE_INSTANCE);
  rtcSetGeometryInstancedScene(instance.geometry, impl_->meshes[mesh].scene);
  rtcSetGeometryTimeStepCount(instance.geometry, 1);
  impl_->place(instance, T_base_instance);
  rtcAttachGeometryByID(impl_->scene, instance.geometry, handle);
  impl_->instances.push_back(instance);
  return handle;
}

void Renderer::set_pose(int instance, const Pose& T_base_instance) {
  impl_->place(impl_->instance(instance), T_base_instance);
}

void Renderer::set_material(int instance, const Material& material) {
  impl_->instance(instance).material = material;
}

void Renderer::set_visible(int instance, bool visible) {
  const RTCGeometry geometry = impl_->instance(instance).geometry;
  impl_->instance(instance).visible = visible;
  visible ? rtcEnableGeometry(geometry) : rtcDisableGeometry(geometry);
  impl_->dirty = true;
}

void Renderer::clear_instances() {
  impl_->drop_instances();
  impl_->drawn_color.whole = false;  // a scene's images do not depend on the scene before
  rtcReleaseScene(impl_->scene);
  impl_->new_scene();
}

void Renderer::set_region(const Eigen::AlignedBox3d& box) { impl_->region = box; }

cv::Mat Renderer::depth(const PinholeIntrinsics& camera, const Pose& T_base_camera,
                        cv::Mat* instances) {
  const auto [depth, ids] = impl_->rasterised(camera, T_base_camera);
  if (instances) *instances = ids;
  return depth;
}

cv::Mat Renderer::instances(const PinholeIntrinsics& camera, const Pose& T_base_camera) {
  return impl_->rasterised(camera, T_base_camera).second;
}

cv::Mat Renderer::color(const PinholeIntrinsics& camera, const Pose& T_base_camera,
                        const Light& light, double noise_sigma, std::uint64_t seed) {
  require_camera(camera);
  const Lighting lighting(light, T_base_camera);
  // Each pixel of a 4 x 4 block looks at another part of the lamp and of the sky; the mean over
  // the block's 16 neighbours then is a soft shadow at the price of one ray (interleaved sampling).
  enum : std::uint8_t { kLit = 1, kOpen = 2 };
  const int width = camera.width, height = camera.height;
  auto& [visibility, direct, ambient, depth, ids, linear] = impl_->frame;
  visibility.create(height, width, CV_8UC1);
  direct.create(height, width, CV_32FC3);
  ambient.create(height, width, CV_32FC3);
  linear.create(height, width, CV_32FC3);
  depth.create(height, width, CV_32FC1);
  ids.create(height, width, CV_32SC1);

  const ChangedTiles changed = impl_->changes(camera, T_base_camera, light);
  impl_->commit();
  const RayFrame frame(camera, T_base_camera);
  std::vector<float> lowest((height + kTile - 1) / kTile, impl_->lowest_seen);  // of each tile row
  parallel_rows(height, kTile, [&](int first, int) {
    RTCIntersectContext context, shadow_context;
    rtcInitIntersectContext(&context);
    rtcInitIntersectContext(&shadow_context);
    context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
    Packet packet(frame);
    ShadowPacket lamp, sky;
    for (int u = 0; u < width; u += kTile) {
      if (!changed.at(first / kTile, u / kTile)) continue;
      packet.aim(frame, camera, u, first);
      rtcIntersect16(packet.valid, impl_->scene, &context, &packet.hit);
      for (int i = 0; i < kLanes; ++i) {
        lamp.skip(i);
        sky.skip(i);
        if (!packet.valid[i]) continue;
        const int x = u + i % kTile, y = first + i / kTile;
        visibility.ptr<std::uint8_t>(y)[x] = kLit | kOpen;
        auto& direct_px = direct.ptr<Vec3>(y)[x];
        auto& ambient_px = ambient.ptr<Vec3>(y)[x];
        ids.ptr<int>(y)[x] = static_cast<int>(packet.hit.hit.instID[0][i]);
        depth.ptr<float>(y)[x] = packet.hit.ray.tfar[i];
        if (packet.hit.hit.geomID[i] == RTC_INVALID_GEOMETRY_ID) {
          direct_px = {0, 0, 0};
          ambient_px = lighting.background(static_cast<float>(y) / height);
          continue;
        }
        Surface surface = impl_->surface(packet, i);
        lowest[first / kTile] = std::min(lowest[first / kTile], surface.position.z);
        const Instance& instance = impl_->instances[packet.hit.hit.instID[0][i]];
        const Vec3 origin = surface.position + surface.face_normal * kSurfaceOffset;
        const Vec3 to_lamp = lighting.sample_lamp(i) - origin;
        if (impl_->meshes[instance.mesh].print.empty()) {
          lighting.shade(surface, instance.material, instance.R, &direct_px, &ambient_px);
        } else {
          Material printed = instance.material;
          printed.albedo.setConstant(impl_->printed(instance, frame, packet, i));
          lighting.shade(surface, printed, instance.R, &direct_px, &ambient_px);
        }
        if (dot(to_lamp, surface.face_normal) > 0.0f) {
          lamp.set(i, origin, to_lamp, 1.0f);
        } else {
          visibility.ptr<std::uint8_t>(y)[x] &= ~kLit;
        }
        sky.set(i, origin, hemisphere(surface.face_normal, i), kOcclusionRange);
      }
      rtcOccluded16(lamp.valid, impl_->scene, &shadow_context, &lamp.ray);
      rtcOccluded16(sky.valid, impl_->scene, &shadow_context, &sky.ray);
      for (int i = 0; i < kLanes; ++i) {
        if (!sky.valid[i]) continue;
        std::uint8_t& seen = visibility.ptr<std::uint8_t>(first + i / kTile)[u + i % kTile];
        if (lamp.valid[i] && !lamp.free(i)) seen &= ~kLit;
        if (!sky.free(i)) seen &= ~kOpen;
      }
    }
  });

  impl_->lowest_seen = *std::min_element(lowest.begin(), lowest.end());

  parallel_rows(height, 16, [&](int first, int last) {
    for (int y = first; y < last; ++y) {
      const int y0 = std::clamp(y - 1, 0, std::max(0, height - kTile));
      const int y1 = std::min(y0 + kTile, height);
      for (int x = 0; x < width; ++x) {
        if (!changed.at(y / kTile, x / kTile)) continue;
        const int x0 = std::clamp(x - 1, 0, std::max(0, width - kTile));
        const int x1 = std::min(x0 + kTile, width);
        const Vec3 own_direct = direct.ptr<Vec3>(y)[x], own_ambient = ambient.ptr<Vec3>(y)[x];
        Vec3& out = linear.ptr<Vec3>(y)[x];
        const std::uint8_t own = visibility.ptr<std::uint8_t>(y)[x];
        if (width >= kTile && uniform(visibility, x0, y0, y1, own)) {  // most of the image
          out = own_direct * static_cast<float>(own & kLit) +
                own_ambient * static_cast<float>(own >> 1);
          continue;
        }
        const int id = ids.ptr<int>(y)[x];
        const float z = depth.ptr<float>(y)[x];
        int lit = 0, open = 0, count = 0;
        for (int yy = y0; yy < y1; ++yy) {
          const auto* seen = visibility.ptr<std::uint8_t>(yy);
          const int* other = ids.ptr<int>(yy);
          const float* other_z = depth.ptr<float>(yy);
          for (int xx = x0; xx < x1; ++xx) {
            const int same = (other[xx] == id) & (std::abs(other_z[xx] - z) < kFilterDepth);
            count += same;
            lit += same & (seen[xx] & kLit);
            open += same & (seen[xx] >> 1);
          }
        }
        const float weight = count > 0 ? 1.0f / count : 0.0f;
        out = own_direct * (lit * weight) + own_ambient * (count > 0 ? open * weight : 1.0f);
      }
    }
  });

  cv::Mat image(height, width, CV_8UC3);
  develop(linear, noise_sigma, seed, image);
  return image;
}

}  // namespace iwgnet_grasp::sensing
