#include "rasteriser.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace iwgnet_grasp::sensing {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
// px. Triangles overlap by this, which is more than rounding: no pixel falls between two of them.
constexpr double kOverlap = 1e-7;
// A triangle whose plane passes the eye this closely, relative to its distance, is a line in the
// image, where the triangles beside it are seen.
constexpr double kEdgeOn = 1e-7;

// One edge of a triangle in the image: on the row v its inside begins (or ends) at slope * v + offset.
struct Edge {
  double slope, offset;
  bool begins;

  // line: (l1, l2, l3) with l1 u + l2 v + l3 >= 0 inside.
  explicit Edge(Eigen::Vector3d line) {
    line.z() += kOverlap * (std::abs(line.x()) + std::abs(line.y()));
    if (line.x() == 0.0) line.x() = 1e-200;  // level: crosses a row infinitely far to either side
    const double inverse = -1.0 / line.x();
    slope = line.y() * inverse;
    offset = line.z() * inverse;
    begins = line.x() > 0.0;
  }
};

// Draws pixels first to last of a surface whose inverse depth is at_0 + step * i where it is nearer.
void draw_row(int first, int last, float at_0, float step, int id, float* __restrict nearest,
              int* __restrict ids) {
  for (int i = first; i <= last; ++i) {
    const float inverse_depth = at_0 + step * i;
    const int nearer = -(inverse_depth > nearest[i]);  // all bits or none: no jump, so vectorised
    ids[i] = (id & nearer) | (ids[i] & ~nearer);
    nearest[i] = std::max(nearest[i], inverse_depth);
  }
}

}  // namespace

Rasteriser::Rasteriser(const PinholeIntrinsics& k, const Pose& T_base_camera,
                       const cv::Rect& region, const cv::Mat& depth, const cv::Mat& ids)
    : region_(region), depth_(depth), ids_(ids) {
  depth_(region).setTo(0.0f);
  ids_(region).setTo(-1);
  Eigen::Matrix3d K;
  K << k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1;
  to_pixels_ = K * T_base_camera.inverse();
}

void Rasteriser::draw(const TriangleMesh& mesh, const Eigen::AlignedBox3d& box,
                      const Pose& T_base_mesh, int id) {
  const Eigen::Affine3d T = to_pixels_ * T_base_mesh;
  Eigen::Array<double, 3, 8> corners;
  for (int i = 0; i < 8; ++i)
    corners.col(i) = T * box.corner(static_cast<Eigen::AlignedBox3d::CornerType>(i));
  const auto u = corners.row(0), v = corners.row(1), z = corners.row(2);  // u and v times z
  if ((z <= 0).all() || (u < region_.x * z).all() || (u > region_.br().x * z).all() ||
      (v < region_.y * z).all() || (v > region_.br().y * z).all())
    return;
  vertices_.resize(mesh.vertices.size());
  for (std::size_t i = 0; i < vertices_.size(); ++i) {
    const Eigen::Vector3d p = T * mesh.vertices[i].cast<double>();
    const double inverse = 1.0 / p.z();
    vertices_[i] = {p, p.x() * inverse, p.y() * inverse};
  }
  for (const auto& [a, b, c] : mesh.triangles) draw(vertices_[a], vertices_[b], vertices_[c], id);
}

// In homogeneous coordinates (Olano and Greer 1997), which need no clipping of what lies behind the
// camera: the pixel d = (u, v, 1) sees the triangle where d (a x b), d (b x c) and d (c x a) have the
// sign of det(a b c); the inverse depth there is n d / n a with the normal n.
void Rasteriser::draw(const Vertex& a, const Vertex& b, const Vertex& c, int id) {
  double left = 0, right = depth_.cols - 1, top = region_.y, bottom = region_.br().y - 1;
  const Eigen::Vector3d &pa = a.homogeneous, &pb = b.homogeneous, &pc = c.homogeneous;
  if (std::max({pa.z(), pb.z(), pc.z()}) <= 0) return;
  if (std::min({pa.z(), pb.z(), pc.z()}) > 0) {
    left = std::max(left, std::min({a.u, b.u, c.u}) - kOverlap);
    right = std::min(right, std::max({a.u, b.u, c.u}) + kOverlap);
    top = std::max(top, std::min({a.v, b.v, c.v}) - kOverlap);
    bottom = std::min(bottom, std::max({a.v, b.v, c.v}) + kOverlap);
    if (left > right || top > bottom || left >= region_.br().x || right < region_.x ||
        cvCeil(left) > cvFloor(right))  // most triangles of a fine mesh fall between pixels
      return;
  }
  const int first = cvCeil(top), last = cvFloor(bottom);
  if (first > last) return;
  const Eigen::Vector3d n = (pb - pa).cross(pc - pa);
  const double det = n.dot(pa);
  if (!(std::abs(det) > kEdgeOn * n.cwiseProduct(pa).cwiseAbs().sum())) return;
  const double side = det > 0 ? 1.0 : -1.0;
  const Edge edges[] = {Edge(side * pa.cross(pb)), Edge(side * pb.cross(pc)),
                        Edge(side * pc.cross(pa))};
  const Eigen::Vector3d plane = n / det;
  for (int row = first; row <= last; ++row) {
    double begin = left, end = right;
    for (const Edge& edge : edges) {
      const double u = edge.slope * row + edge.offset;
      if (edge.begins) begin = std::max(begin, u);
      else end = std::min(end, u);
    }
    if (!(begin <= end)) continue;
    // In single precision from the row's first pixel on: exact, and the same in any region.
    const int origin = cvCeil(begin);
    draw_row(std::max(0, region_.x - origin), std::min(cvFloor(end), region_.br().x - 1) - origin,
             plane.x() * origin + plane.y() * row + plane.z(), plane.x(), id,
             depth_.ptr<float>(row) + origin, ids_.ptr<int>(row) + origin);
  }
}

void Rasteriser::finish() {
  for (int v = region_.y; v < region_.br().y; ++v) {
    float* row = depth_.ptr<float>(v);
    for (int u = region_.x; u < region_.br().x; ++u) row[u] = row[u] > 0.0f ? 1.0f / row[u] : kNaN;
  }
}

}  // namespace iwgnet_grasp::sensing
