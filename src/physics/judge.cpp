#include "iwgnet_grasp/physics/judge.h"

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <set>
#include <sstream>

#include "iwgnet_grasp/core/yaml.h"
#include "iwgnet_grasp/kinematics/robotiq_2f85.h"
#include "iwgnet_grasp/kinematics/ur5.h"

namespace iwgnet_grasp::physics {
namespace {

constexpr double kEventGap = 0.5;       // s without contact that end one collision
constexpr double kRestLinear = 0.02;    // m/s, rad/s: a part below both is at rest
constexpr double kRestAngular = 0.2;
constexpr double kTrayHeadroom = 0.06;  // m above the tray's walls a centre may lie in a full tray
constexpr double kMissTime = 0.15;      // s still and closed without a part: missed

enum class Kind { kRobotBody, kFinger, kPad, kPart, kScenery };

struct Side {
  Kind kind;
  int part = -1;
};

Side side(const std::string& name) {
  if (name.rfind("part:", 0) == 0) return {Kind::kPart, std::stoi(name.substr(5))};
  if (name == "table" || name == "tray" || name == "camera" || name == "camera_mount")
    return {Kind::kScenery};
  if (name.find("finger_pad") != std::string::npos) return {Kind::kPad};
  if (name.find("finger") != std::string::npos || name.find("knuckle") != std::string::npos)
    return {Kind::kFinger};
  return {Kind::kRobotBody};
}

struct Limits {
  double slip_mm, slip_deg, firm_force, firm_time, still_speed, loss_time, drop_height,
      attempt_gap, contact_force, held_contact_force, held_clearance, body_part_force;
};

Limits load_limits(const std::string& config_dir) {
  const YamlFile file(config_dir + "/judge.yaml");
  const auto positive = [&](const std::string& key) {
    const double value = file.get<double>(key);
    if (!(value > 0)) file.fail(key, "must be above 0");
    return value;
  };
  return {positive("slip_mm"),       positive("slip_deg"),           positive("firm_force"),
          positive("firm_time"),     positive("still_speed"),        positive("loss_time"),
          positive("drop_height"),   positive("attempt_gap"),        positive("contact_force"),
          positive("held_contact_force"), positive("held_clearance"), positive("body_part_force")};
}

struct Collision {
  std::string pair;
  double begin, last, force;
};

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    out += c;
  }
  return out + "\"";
}

}  // namespace

struct Judge::Impl {
  CellConfig cell;
  Limits limits;

  enum class Phase { kOpen, kClosing, kHolding, kSpent };
  Phase phase = Phase::kOpen;
  bool started = false;
  double goal = 0.0;                     // commanded gap before this step
  double miss_since = -1.0, lost_since = -1.0;
  double near_since = -1.0, near_gap = 0.0;  // s, m: since when the gap has been near a value
  std::vector<double> touched_since;     // both pads on a part since; -1: not
  PickVerdict pick;                      // the one under way
  Pose T_tcp_part = Pose::Identity();    // at the grip
  double grip_gap = 0.0, grip_height = 0.0;
  bool lifted = false, collided = false;

  struct Released {
    std::size_t pick;
    int part;
    double height;
    bool at_rest;
  };
  std::vector<Released> released;
  std::vector<PickVerdict> picks;
  std::vector<Collision> collisions;

  void finish(const std::string& reason, double time) {
    pick.release_time = time;
    pick.reason = collided ? "collided" : reason;
    collided = false;
    picks.push_back(pick);
    lifted = false;
    miss_since = lost_since = -1.0;
  }

  Pose T_base_tcp(const World& world) const {
    return kinematics::forward(world.arm().q) * kinematics::T_tool0_tcp(grip_gap);
  }

  void note_collision(const Contact& c, double time) {
    collided = true;
    const std::string pair = c.a < c.b ? c.a + " - " + c.b : c.b + " - " + c.a;
    for (auto it = collisions.rbegin(); it != collisions.rend(); ++it)
      if (it->pair == pair && time - it->last < kEventGap) {
        it->last = time;
        it->force = std::max(it->force, c.normal_force);
        return;
      }
    collisions.push_back({pair, time, time, c.normal_force});
  }

  // How far and how much the part has moved in the gripper since the grip, at the pads' midpoint.
  void measure_slip(const World& world) {
    const Pose now = T_base_tcp(world).inverse() * world.part(pick.part).T_base_part;
    const Pose moved = now * T_tcp_part.inverse();
    pick.slip_mm = std::max(pick.slip_mm, 1e3 * moved.translation().norm());
    const double angle = Eigen::AngleAxisd(moved.linear()).angle();
    pick.slip_deg = std::max(pick.slip_deg, std::abs(angle) * 180.0 / M_PI);
  }

  bool in_tray(const Pose& T) const {
    const Eigen::Vector3d p = T.translation();
    return cell.tray.covers(p.head<2>()) && p.z() > cell.tray.floor_height &&
           p.z() < cell.tray.wall_height + kTrayHeadroom;
  }
};

Judge::Judge(const CellConfig& cell, const std::string& config_dir)
    : impl_(std::make_shared<Impl>()) {
  impl_->cell = cell;
  impl_->limits = load_limits(config_dir);
}

void Judge::reset(const World& world) {
  auto fresh = std::make_shared<Impl>();
  fresh->cell = impl_->cell;
  fresh->limits = impl_->limits;
  fresh->touched_since.assign(world.part_count(), -1.0);
  impl_ = std::move(fresh);
}

void Judge::observe(const World& world, double commanded_gap) {
  Impl& m = *impl_;
  const Limits& l = m.limits;
  const double time = world.time();
  const GripperState gripper = world.gripper();
  const int parts = world.part_count();
  m.touched_since.resize(parts, -1.0);
  if (!m.started) {
    m.started = true;
    m.goal = commanded_gap;
  }

  std::vector<std::set<std::string>> pads(parts);
  for (const Contact& c : world.contacts()) {
    Side a = side(c.a), b = side(c.b);
    if (a.kind == Kind::kPad && b.kind == Kind::kPart) pads[b.part].insert(c.a);
    if (b.kind == Kind::kPad && a.kind == Kind::kPart) pads[a.part].insert(c.b);
    if (static_cast<int>(a.kind) > static_cast<int>(b.kind)) std::swap(a, b);
    const bool robot = a.kind == Kind::kRobotBody || a.kind == Kind::kFinger || a.kind == Kind::kPad;
    const bool held = m.phase == Impl::Phase::kHolding && m.lifted && a.kind == Kind::kPart &&
                      a.part == m.pick.part && b.kind == Kind::kScenery;
    double limit = -1.0;
    if (robot && b.kind != Kind::kPart) limit = l.contact_force;
    if (a.kind == Kind::kRobotBody && b.kind == Kind::kPart) limit = l.body_part_force;
    if (held) limit = l.held_contact_force;
    if (limit > 0 && c.normal_force > limit) m.note_collision(c, time);
  }

  // By the way of the gap where its speed trembles on an elastic grip.
  if (m.near_since < 0 || std::abs(gripper.gap - m.near_gap) > l.still_speed * l.firm_time) {
    m.near_since = time;
    m.near_gap = gripper.gap;
  }
  const bool still =
      std::abs(gripper.speed) < l.still_speed || time - m.near_since >= l.firm_time;
  const bool squeezing = gripper.force >= l.firm_force && still && commanded_gap < gripper.gap;
  int firm = -1;
  for (int p = 0; p < parts; ++p) {
    const bool both = pads[p].size() == 2;
    if (!both || !squeezing) m.touched_since[p] = -1.0;
    else if (m.touched_since[p] < 0) m.touched_since[p] = time;
    if (both && squeezing && time - m.touched_since[p] >= l.firm_time) firm = p;
  }

  const bool closes = commanded_gap < m.goal && commanded_gap < l.attempt_gap;
  const bool opens = commanded_gap > m.goal;
  m.goal = commanded_gap;

  if (opens && m.phase == Impl::Phase::kClosing) m.finish("missed", time);
  if (opens && m.phase == Impl::Phase::kHolding) {
    m.measure_slip(world);
    m.finish("", time);
    m.released.push_back({m.picks.size() - 1, m.pick.part,
                          world.part(m.pick.part).T_base_part.translation().z(), false});
  }
  if (opens) m.phase = Impl::Phase::kOpen;
  if (closes && m.phase == Impl::Phase::kOpen) {
    m.phase = Impl::Phase::kClosing;
    m.pick = PickVerdict();
    m.pick.grip_time = time;
  }

  if ((m.phase == Impl::Phase::kClosing || m.phase == Impl::Phase::kOpen) && firm >= 0) {
    if (m.phase == Impl::Phase::kOpen) m.pick = PickVerdict();
    m.phase = Impl::Phase::kHolding;
    m.pick.part = firm;
    m.pick.grip_time = time;
    m.grip_gap = gripper.gap;
    m.T_tcp_part = m.T_base_tcp(world).inverse() * world.part(firm).T_base_part;
    m.grip_height = world.part(firm).T_base_part.translation().z();
    m.lifted = false;
  } else if (m.phase == Impl::Phase::kClosing) {
    // Closed as far as it goes, or squeezing something that is not one part between two pads.
    if (!still) m.miss_since = -1.0;
    else if (m.miss_since < 0) m.miss_since = time;
    else if (time - m.miss_since > kMissTime + l.firm_time) {
      m.finish("missed", time);
      m.phase = Impl::Phase::kSpent;
    }
  } else if (m.phase == Impl::Phase::kHolding) {
    const PartState part = world.part(m.pick.part);
    if (part.T_base_part.translation().z() > m.grip_height + l.held_clearance) m.lifted = true;
    if (pads[m.pick.part].empty()) {
      if (m.lost_since < 0) m.lost_since = time;
      if (time - m.lost_since >= l.loss_time) {
        m.finish("dropped", time);
        m.phase = Impl::Phase::kSpent;
      }
    } else {
      m.lost_since = -1.0;
      m.measure_slip(world);
    }
  }

  for (auto& r : m.released) {
    if (r.at_rest) continue;
    const PartState part = world.part(r.part);
    const double fallen = r.height - part.T_base_part.translation().z();
    auto& reason = m.picks[r.pick].reason;
    if (fallen > l.drop_height && (reason.empty() || reason == "slipped")) reason = "dropped";
    const bool apart = pads[r.part].empty();
    r.at_rest = apart && time - m.picks[r.pick].release_time > l.loss_time &&
                part.linear.norm() < kRestLinear && part.angular.norm() < kRestAngular;
  }
}

Verdict Judge::verdict(const World& world) const {
  const Impl& m = *impl_;
  Verdict v;
  v.parts = world.part_count();
  std::vector<bool> delivered(v.parts, false);
  for (int i = 0; i < v.parts; ++i) {
    const PartState part = world.part(i);
    const Eigen::Vector3d p = part.T_base_part.translation();
    const bool rests = part.linear.norm() < kRestLinear && part.angular.norm() < kRestAngular;
    const bool inside = (p.head<2>().array() >= m.cell.workspace_min.array()).all() &&
                        (p.head<2>().array() <= m.cell.workspace_max.array()).all() && p.z() > 0;
    const bool carried = m.phase == Impl::Phase::kHolding && m.pick.part == i;
    delivered[i] = m.in_tray(part.T_base_part) && rests && !carried;
    if (delivered[i]) ++v.in_tray;
    else if (inside || carried) ++v.on_table;
    else ++v.lost;
  }
  v.picks = m.picks;
  if (m.phase == Impl::Phase::kHolding) {
    v.picks.push_back(m.pick);  // still under way: not delivered
    v.picks.back().reason = m.collided ? "collided" : "";
  }
  bool all = static_cast<int>(v.picks.size()) == v.parts;
  for (auto& pick : v.picks) {
    if (pick.reason.empty() &&
        (pick.slip_mm > m.limits.slip_mm || pick.slip_deg > m.limits.slip_deg))
      pick.reason = "slipped";
    if (pick.reason.empty() && !delivered[pick.part]) pick.reason = "not_in_tray";
    pick.success = pick.reason.empty();
    if (pick.part >= 0) pick.position = world.part(pick.part).T_base_part.translation();
    all = all && pick.success;
  }
  for (const auto& c : m.collisions) {
    std::ostringstream text;
    text << c.pair << " at " << std::fixed << std::setprecision(1) << c.begin << " s, "
         << std::setprecision(0) << c.force << " N";
    v.collisions.push_back(text.str());
  }
  v.success = all && v.in_tray == v.parts && v.collisions.empty();
  return v;
}

std::string to_json(const Verdict& v) {
  std::ostringstream out;
  out << std::setprecision(6) << std::boolalpha;
  out << "{\"success\": " << v.success << ", \"parts\": " << v.parts << ", \"in_tray\": " << v.in_tray
      << ", \"on_table\": " << v.on_table << ", \"lost\": " << v.lost << ", \"picks\": [";
  for (std::size_t i = 0; i < v.picks.size(); ++i) {
    const auto& p = v.picks[i];
    out << (i ? ", " : "") << "{\"part\": " << p.part << ", \"success\": " << p.success
        << ", \"reason\": " << quoted(p.reason) << ", \"slip_mm\": " << p.slip_mm
        << ", \"slip_deg\": " << p.slip_deg << ", \"grip_time\": " << p.grip_time
        << ", \"release_time\": " << p.release_time;
    if (p.part >= 0)
      out << ", \"position\": [" << p.position.x() << ", " << p.position.y() << ", "
          << p.position.z() << "]";
    out << "}";
  }
  out << "], \"collisions\": [";
  for (std::size_t i = 0; i < v.collisions.size(); ++i)
    out << (i ? ", " : "") << quoted(v.collisions[i]);
  out << "]}";
  return out.str();
}

}  // namespace iwgnet_grasp::physics
