#include "iwgnet_grasp/motion/collision_world.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"

namespace iwgnet_grasp::motion {
namespace {

constexpr int kBlock = 8;              // cells a side of a block of the height map
constexpr double kColumnRadius = 0.003;  // m
constexpr double kColumnTilt = 0.9995;   // cosine of the tool's tilt that still counts as along it

const char* const kBodyNames[] = {"base_link",     "shoulder_link", "upper_arm_link", "forearm_link",
                                  "wrist_1_link",  "wrist_2_link",  "wrist_3_link",   "gripper",
                                  "gripper_finger", "held_part"};

using Body = CollisionWorld::Body;

// Bodies that can meet: the first may touch any of [from, to].
struct SelfPair {
  Body moving, from, to;
};
constexpr SelfPair kSelfPairs[] = {
    {Body::kForearm, Body::kBase, Body::kShoulder},   {Body::kWrist1, Body::kBase, Body::kUpperArm},
    {Body::kWrist2, Body::kBase, Body::kUpperArm},    {Body::kWrist3, Body::kBase, Body::kForearm},
    {Body::kGripper, Body::kBase, Body::kForearm},    {Body::kFingers, Body::kBase, Body::kForearm},
    {Body::kHeldPart, Body::kBase, Body::kForearm}};

// Whether any sphere [from, to) comes nearer to the box than its radius.
bool any_in_box(const double* x, const double* y, const double* z, const double* r, int from, int to,
                const double* center, const double* half) {
  int hits = 0;
  for (int i = from; i < to; ++i) {
    const double dx = std::max(std::abs(x[i] - center[0]) - half[0], 0.0);
    const double dy = std::max(std::abs(y[i] - center[1]) - half[1], 0.0);
    const double dz = std::max(std::abs(z[i] - center[2]) - half[2], 0.0);
    hits += dx * dx + dy * dy + dz * dz < r[i] * r[i];
  }
  return hits > 0;
}

bool any_in_sphere(const double* x, const double* y, const double* z, const double* r, int from,
                   int to, int other) {
  int hits = 0;
  for (int i = from; i < to; ++i) {
    const double dx = x[i] - x[other], dy = y[i] - y[other], dz = z[i] - z[other];
    const double reach = r[i] + r[other];
    hits += dx * dx + dy * dy + dz * dz < reach * reach;
  }
  return hits > 0;
}

}  // namespace

CollisionWorld::CollisionWorld(const CellConfig& cell) : gap_(kinematics::max_gap()) {
  const auto add = [&](const std::string& name, const Box& box) {
    obstacles_.push_back({name, box.center, box.size / 2});
  };
  add("table", cell.table);
  for (const Box& box : cell.tray.boxes()) add("tray", box);
  // The camera's body as the box around it in base_link, for a camera that is not quite level.
  const Pose T = cell.camera.T_base_camera_link();
  add("camera", {T * cell.camera.body_center, T.linear().cwiseAbs() * cell.camera.body_size});
  for (const Box& box : cell.camera_mount) add("camera_mount", box);
  rebuild();
}

void CollisionWorld::set_heights(const grasping::HeightMap& heights) {
  heights_ = Heights();
  if (heights.grid().empty()) return;
  cv::Mat grid;
  cv::morphologyEx(heights.grid(), grid, cv::MORPH_OPEN, cv::Mat::ones(3, 3, CV_8U));
  heights_.columns = grid.cols;
  heights_.rows = grid.rows;
  heights_.resolution = heights.resolution();
  heights_.origin = heights.origin();
  heights_.block_columns = (grid.cols + kBlock - 1) / kBlock;
  heights_.block_rows = (grid.rows + kBlock - 1) / kBlock;
  heights_.cells.resize(static_cast<std::size_t>(grid.total()));
  heights_.blocks.assign(static_cast<std::size_t>(heights_.block_columns) * heights_.block_rows, 0.0f);
  for (int row = 0; row < grid.rows; ++row)
    for (int column = 0; column < grid.cols; ++column) {
      const float h = grid.at<float>(row, column);
      heights_.cells[static_cast<std::size_t>(row) * grid.cols + column] = h;
      float& block = heights_.blocks[(row / kBlock) * heights_.block_columns + column / kBlock];
      block = std::max(block, h);
      heights_.max = std::max(heights_.max, static_cast<double>(h));
    }
}

void CollisionWorld::set_gripper_gap(double gap) {
  gap_ = gap;
  rebuild();
}

void CollisionWorld::set_attached(const std::optional<AttachedPart>& part) {
  set_attached(part ? std::vector<AttachedPart>{*part} : std::vector<AttachedPart>{});
}

void CollisionWorld::set_attached(const std::vector<AttachedPart>& pieces) {
  attached_ = pieces;
  rebuild();
}

void CollisionWorld::set_columns(const std::vector<Column>& columns) { columns_ = columns; }

// Sphere sizes: fitted to the collision meshes of ur_description and of the 2F-85, which they cover
// (test_motion_collision).
void CollisionWorld::rebuild() {
  spheres_.clear();
  const auto row = [&](Body body, int frame, Eigen::Vector3d from, Eigen::Vector3d to, double radius,
                       int count) {
    for (int i = 0; i < count; ++i) {
      const double t = count > 1 ? static_cast<double>(i) / (count - 1) : 0.0;
      spheres_.push_back({body, frame, from + t * (to - from), radius});
    }
  };
  const double upper = kinematics::kUr5Dh[1].a, fore = kinematics::kUr5Dh[2].a;  // negative
  row(kBase, 0, {0, 0, 0.01}, {0, 0, 0.01}, 0.095, 1);
  row(kBase, 0, {0, -0.080, 0.01}, {0, -0.080, 0.01}, 0.040, 1);  // the connector
  row(kShoulder, 1, {0, -0.035, 0}, {0, 0.035, 0}, 0.075, 2);  // DH y of frame 1 is up
  row(kShoulder, 1, {0, 0, 0.030}, {0, 0, 0.030}, 0.072, 1);
  row(kUpperArm, 2, {-upper, 0, 0.105}, {-upper, 0, 0.170}, 0.072, 2);
  row(kUpperArm, 2, {0.365, 0, 0.1375}, {0.06, 0, 0.1375}, 0.061, 7);
  row(kUpperArm, 2, {0, 0, 0.105}, {0, 0, 0.170}, 0.072, 2);
  row(kForearm, 3, {-fore, 0, -0.004}, {-fore, 0, 0.030}, 0.070, 2);
  row(kForearm, 3, {0.340, 0, 0.0165}, {0.045, 0, 0.0165}, 0.053, 8);
  row(kForearm, 3, {0, 0, -0.010}, {0, 0, 0.040}, 0.053, 2);
  row(kWrist1, 4, {0, -0.005, -0.010}, {0, -0.005, 0.015}, 0.056, 2);
  row(kWrist2, 5, {0, 0.005, -0.010}, {0, 0.005, 0.015}, 0.056, 2);
  row(kWrist3, 6, {0, 0, -0.017}, {0, 0, -0.017}, 0.048, 1);

  // Gripper, in tool0: body, then for each finger the linkage, the finger and the pad.
  row(kGripper, 6, {0, 0, 0.020}, {0, 0, 0.020}, 0.052, 1);
  for (const double sx : {-1.0, 1.0})
    for (const double sy : {-1.0, 1.0})
      row(kGripper, 6, {sx * 0.021, sy * 0.019, 0.062}, {sx * 0.021, sy * 0.019, 0.062}, 0.033, 1);
  row(kGripper, 6, {0, 0, 0.068}, {0, 0, 0.068}, 0.026, 1);
  const double pad_z = kinematics::pad_center_height(gap_), tip = kinematics::finger_tip_height(gap_);
  const double face = kinematics::gap_from_joint(kinematics::joint_from_gap(gap_)) / 2;
  const double joint_x = face + 0.0251953, joint_z = pad_z - 0.03242;  // inner finger's joint
  const Eigen::Vector3d pivot(0.0306011, 0, 0.054904), joint(joint_x, 0, joint_z);
  const double turn = kinematics::joint_from_gap(gap_), c = std::cos(turn), sn = std::sin(turn);
  const Eigen::Vector3d elbow =  // between outer knuckle and outer finger
      pivot + Eigen::Vector3d(0.0315 * c + 0.0041 * sn, 0, 0.0315 * sn - 0.0041 * c);
  for (const double side : {-1.0, 1.0}) {
    const auto mirrored = [&](Eigen::Vector3d p) { return Eigen::Vector3d(side * p.x(), p.y(), p.z()); };
    row(kFingers, 6, mirrored(pivot), mirrored(elbow), 0.017, 3);
    row(kFingers, 6, mirrored(elbow), mirrored(joint), 0.017, 4);
    const Eigen::Vector3d knuckle(0.0127, 0, 0.06142);  // inner knuckle, wide and parallel to it
    for (const double y : {-0.012, 0.012})
      row(kFingers, 6, mirrored(knuckle + Eigen::Vector3d(0.006, y, 0.006)),
          mirrored(knuckle + (joint - pivot) * 0.8 + Eigen::Vector3d(-0.006, y, 0.0)), 0.015, 3);
    row(kFingers, 6, mirrored({joint_x - 0.006, 0, joint_z + 0.006}),
        mirrored({face + 0.011, 0, tip - 0.026}), 0.013, 3);
    row(kFingers, 6, mirrored({face + 0.0085, 0, tip - 0.018}), mirrored({face + 0.007, 0, tip - 0.0095}),
        0.0095, 2);
    // The tip is met exactly in height, its edges by small spheres.
    for (const double y : {-0.006, 0.006})
      row(kFingers, 6, mirrored({face + 0.005, y, pad_z - 0.014}), mirrored({face + 0.005, y, tip - 0.007}),
          0.007, 3);
  }
  for (const AttachedPart& piece : attached_) {
    const double length = (piece.b - piece.a).norm();
    const int count = std::clamp(1 + static_cast<int>(std::ceil(length / piece.radius)), 2, 8);
    const double step = length / (count - 1) / 2;
    const Eigen::Vector3d tcp(0, 0, pad_z);
    row(kHeldPart, 6, tcp + piece.a, tcp + piece.b, std::hypot(piece.radius, step), count);
  }
  if (static_cast<int>(spheres_.size()) > kCapacity)
    throw Error("CollisionWorld: more than " + std::to_string(kCapacity) + " spheres");
  int i = 0;
  const int count = static_cast<int>(spheres_.size());
  for (int body = 0; body < kBodies; ++body) {
    BodySpheres& range = bodies_[body];
    range = BodySpheres();
    range.first = i;
    Eigen::AlignedBox3d extent;
    for (; i < count && spheres_[i].body == body; ++i) {
      range.frame = spheres_[i].frame;
      extent.extend(spheres_[i].center);
    }
    range.end = i;
    if (range.first == range.end) continue;
    range.center = extent.center();
    for (int k = range.first; k < range.end; ++k)
      range.radius = std::max(range.radius, (spheres_[k].center - range.center).norm() + spheres_[k].radius);
  }
}

void CollisionWorld::place(Body body, const Frames& frames, Placed& placed) const {
  const BodySpheres& range = bodies_[body];
  const Pose T = range.frame == 0 ? Pose::Identity() : frames[range.frame - 1];
  for (int i = range.first; i < range.end; ++i) {
    const Eigen::Vector3d p = T * spheres_[i].center;
    placed.x[i] = p.x();
    placed.y[i] = p.y();
    placed.z[i] = p.z();
    placed.r[i] = spheres_[i].radius;
  }
}

bool CollisionWorld::in_column(const Pose& T_base_tool0) const {
  const Eigen::Vector3d pointing = T_base_tool0.linear().col(2);
  return std::any_of(columns_.begin(), columns_.end(), [&](const Column& column) {
    return pointing.dot(column.axis) > kColumnTilt &&
           (T_base_tool0.translation() - column.point).cross(column.axis).norm() < kColumnRadius;
  });
}

bool CollisionWorld::touches_heights(double x, double y, double z, double radius) const {
  const double low = z - radius;
  if (low >= heights_.max) return false;
  const double scale = 1.0 / heights_.resolution;
  const auto index = [&](double value, double origin) {  // of the cell whose centre is nearest
    return static_cast<int>(std::floor((value - origin) * scale + 0.5));
  };
  const int c0 = std::max(index(x - radius, heights_.origin.x()), 0);
  const int c1 = std::min(index(x + radius, heights_.origin.x()), heights_.columns - 1);
  const int r0 = std::max(index(y - radius, heights_.origin.y()), 0);
  const int r1 = std::min(index(y + radius, heights_.origin.y()), heights_.rows - 1);
  if (c0 > c1 || r0 > r1) return false;
  const double half_cell = heights_.resolution / 2, r2 = radius * radius;
  for (int br = r0 / kBlock; br <= r1 / kBlock; ++br)
    for (int bc = c0 / kBlock; bc <= c1 / kBlock; ++bc) {
      if (heights_.blocks[br * heights_.block_columns + bc] <= low) continue;
      const int row_end = std::min(r1, br * kBlock + kBlock - 1);
      const int column_end = std::min(c1, bc * kBlock + kBlock - 1);
      for (int r = std::max(r0, br * kBlock); r <= row_end; ++r) {
        const double dy =
            std::max(std::abs(heights_.origin.y() + r * heights_.resolution - y) - half_cell, 0.0);
        for (int c = std::max(c0, bc * kBlock); c <= column_end; ++c) {
          const double h = heights_.cells[static_cast<std::size_t>(r) * heights_.columns + c];
          if (h <= low) continue;
          const double dx =
              std::max(std::abs(heights_.origin.x() + c * heights_.resolution - x) - half_cell, 0.0);
          const double depth2 = r2 - dx * dx - dy * dy;
          if (depth2 > 0 && h > z - std::sqrt(depth2)) return true;
        }
      }
    }
  return false;
}

template <typename Report>
bool CollisionWorld::check(const JointVector& q, Report&& report) const {
  const Frames frames = kinematics::link_frames(q);
  const bool column = in_column(frames[kJoints - 1]);
  const int last = !attached_.empty() && !column ? kHeldPart : kFingers;

  // Spheres around whole bodies come first; the spheres of a body are placed when it is near.
  Placed p;
  const double *x = p.x.data(), *y = p.y.data(), *z = p.z.data(), *r = p.r.data();
  std::array<Eigen::Vector3d, kBodies> around;
  for (int body = 0; body <= last; ++body)
    around[body] = bodies_[body].frame == 0 ? bodies_[body].center
                                            : frames[bodies_[body].frame - 1] * bodies_[body].center;
  unsigned placed = 0;
  const auto near = [&](int body) {
    if (!(placed >> body & 1u)) place(static_cast<Body>(body), frames, p);
    placed |= 1u << body;
  };

  // The base and the shoulder stand on the table and never leave it.
  for (int body = kUpperArm; body <= last; ++body) {
    const BodySpheres& range = bodies_[body];
    for (const Obstacle& box : obstacles_) {
      const Eigen::Vector3d away = ((around[body] - box.center).cwiseAbs() - box.half).cwiseMax(0.0);
      if (away.squaredNorm() >= range.radius * range.radius) continue;
      near(body);
      if (any_in_box(x, y, z, r, range.first, range.end, box.center.data(), box.half.data()) &&
          report(kBodyNames[body], box.name))
        return true;
    }
  }
  for (int body = kUpperArm; body <= last; ++body) {
    const BodySpheres& range = bodies_[body];
    if (around[body].z() - range.radius >= heights_.max || (column && body >= kFingers)) continue;
    near(body);
    for (int i = range.first; i < range.end; ++i)
      if (touches_heights(x[i], y[i], z[i], r[i]) && report(kBodyNames[body], "parts")) return true;
  }
  for (const SelfPair& pair : kSelfPairs) {
    if (pair.moving > last) continue;
    const BodySpheres& moving = bodies_[pair.moving];
    for (int body = pair.from; body <= pair.to; ++body) {
      const BodySpheres& other = bodies_[body];
      const double reach = moving.radius + other.radius;
      if ((around[pair.moving] - around[body]).squaredNorm() >= reach * reach) continue;
      near(pair.moving);
      near(body);
      for (int i = moving.first; i < moving.end; ++i)
        if (any_in_sphere(x, y, z, r, other.first, other.end, i) &&
            report(kBodyNames[pair.moving], kBodyNames[body]))
          return true;
    }
  }
  return false;
}

bool CollisionWorld::collides(const JointVector& q) const {
  return check(q, [](const auto&, const auto&) { return true; });
}

std::string CollisionWorld::describe(const JointVector& q) const {
  std::vector<std::string> contacts;
  check(q, [&](const auto& a, const auto& b) {
    const std::string contact = std::string(a) + " - " + std::string(b);
    if (std::find(contacts.begin(), contacts.end(), contact) == contacts.end())
      contacts.push_back(contact);
    return false;
  });
  std::string text;
  for (const std::string& contact : contacts) text += (text.empty() ? "" : ", ") + contact;
  return text;
}

std::vector<CollisionWorld::Sphere> CollisionWorld::spheres(const JointVector& q) const {
  const Frames frames = kinematics::link_frames(q);
  std::vector<Sphere> result;
  for (const LocalSphere& s : spheres_)
    result.push_back({s.body, s.frame == 0 ? s.center : frames[s.frame - 1] * s.center, s.radius});
  return result;
}

}  // namespace iwgnet_grasp::motion
