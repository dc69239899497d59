// Light and materials of the colour image: microfacet reflection (GGX), a lamp with an extent, a
// room that metal mirrors, procedural grain. Private to the renderer.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>

#include "iwgnet_grasp/sensing/renderer.h"

namespace iwgnet_grasp::sensing {

// Three floats without Eigen's expression templates: this is the inner loop of a million pixels.
struct Vec3 {
  float x, y, z;
};
inline Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(const Vec3& a, float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec3 operator*(const Vec3& a, const Vec3& b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline float dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vec3 normalized(const Vec3& a) { return a * (1.0f / std::sqrt(dot(a, a))); }

struct Rotation {
  Vec3 column[3];
};
inline Vec3 operator*(const Rotation& R, const Vec3& v) {
  return R.column[0] * v.x + R.column[1] * v.y + R.column[2] * v.z;
}
inline Vec3 transposed_times(const Rotation& R, const Vec3& v) {
  return {dot(R.column[0], v), dot(R.column[1], v), dot(R.column[2], v)};
}

// What a ray hit. Base frame, m, unless named object_.
struct Surface {
  Vec3 position, to_eye, face_normal, normal;
  Vec3 object_position, object_normal;
};

class Lighting {
 public:
  Lighting(const Light& light, const Pose& T_base_camera);

  Vec3 sample_lamp(int lane) const { return lamp_[lane]; }  // one of 16 points of the lamp
  // Colour (linear RGB) the eye sees of the surface: from the lamp, and from the room.
  void shade(const Surface& surface, const Material& material, const Rotation& R_base_object,
             Vec3* direct, Vec3* ambient) const;
  Vec3 background(float row) const;  // row: 0 top .. 1 bottom of the image

 private:
  Vec3 room(const Vec3& direction, float roughness) const;

  std::array<Vec3, 16> lamp_;
  Vec3 center_, intensity_;
  float ambient_, radius_, reference_;  // share; m; m^2, where the lamp's light counts 1
};

// One of 16 cosine-weighted directions about a unit normal.
Vec3 hemisphere(const Vec3& normal, int lane);

// Linear RGB (CV_32FC3) -> 8-bit sRGB (CV_8UC3) through the lens's blur and the sensor's noise.
void develop(const cv::Mat& linear, double noise_sigma, std::uint64_t seed, cv::Mat& image);

}  // namespace iwgnet_grasp::sensing
