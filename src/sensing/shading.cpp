#include "shading.h"

#include <algorithm>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "parallel.h"

namespace iwgnet_grasp::sensing {
namespace {

constexpr int kTexels = 512;             // side of a noise texture; it repeats
constexpr float kMottleTexel = 0.0006f;  // m, of the grain of matt surfaces
constexpr float kBrushTexel = 0.00025f;  // m, across the brushing of metal ...
constexpr float kBrushStretch = 24.0f;   // ... and so many times longer along it
constexpr float kBrushTilt = 0.10f;      // rad, how far brushing tilts the surface
constexpr float kBrushSpread = 0.12f;    // what brushing too fine to see adds to the highlight's width
constexpr float kMinRoughness = 0.04f;
constexpr float kDielectricF0 = 0.04f;   // reflectance of plastics and paint seen head-on
constexpr float kHorizon = 0.45f, kCeiling = 1.25f, kFloor = 0.16f;  // brightness of the room
constexpr float kBlurSigma = 0.6f;       // px, of the lens
constexpr int kToneSteps = 8192;
constexpr float kToneRange = 2.0f;       // linear value of the last step
constexpr float kShoulder = 0.60f;       // linear value from which highlights are compressed

using Texture = std::vector<float>;

// Sum of smoothed random lattices, octave by octave; values have mean 0 and deviation 1.
Texture noise_texture(std::uint64_t seed, int first_cell, int octaves) {
  Texture texture(kTexels * kTexels, 0.0f);
  float amplitude = 1.0f;
  for (int octave = 0, cell = first_cell; octave < octaves; ++octave, cell = std::max(1, cell / 2)) {
    const int lattice = kTexels / cell;
    const auto value = [&](int i, int j) {
      const std::uint64_t key = (seed * 64 + octave) * 0x10001ull * kTexels +
                                static_cast<std::uint64_t>(j % lattice) * kTexels + i % lattice;
      return static_cast<float>(mix(key) >> 40) / (1 << 23) - 1.0f;
    };
    for (int y = 0; y < kTexels; ++y)
      for (int x = 0; x < kTexels; ++x) {
        const int i = x / cell, j = y / cell;
        float s = static_cast<float>(x % cell) / cell, t = static_cast<float>(y % cell) / cell;
        s = s * s * (3 - 2 * s);
        t = t * t * (3 - 2 * t);
        const float top = value(i, j) * (1 - s) + value(i + 1, j) * s;
        const float bottom = value(i, j + 1) * (1 - s) + value(i + 1, j + 1) * s;
        texture[y * kTexels + x] += amplitude * (top * (1 - t) + bottom * t);
      }
    amplitude *= 0.65f;
  }
  double sum = 0, squares = 0;
  for (const float v : texture) {
    sum += v;
    squares += v * v;
  }
  const double mean = sum / texture.size();
  const double deviation = std::sqrt(squares / texture.size() - mean * mean);
  for (float& v : texture) v = static_cast<float>((v - mean) / deviation);
  return texture;
}

const Texture& mottle() {
  static const Texture texture = noise_texture(1, 32, 6);
  return texture;
}
const Texture& brushing() {
  static const Texture texture = noise_texture(2, 8, 3);
  return texture;
}

float lookup(const Texture& texture, float x, float y) {
  const int i = cvFloor(x) & (kTexels - 1);
  const int j = cvFloor(y) & (kTexels - 1);
  return texture[j * kTexels + i];
}

struct Grain {
  float value;  // mean 0, deviation 1
  Vec3 across;  // object frame: unit direction across the brushing
};

// Projects the texture along the axis that the surface faces.
Grain grain(const Surface& surface, bool metal) {
  const Vec3 p = surface.object_position, n = surface.object_normal;
  const float ax = std::abs(n.x), ay = std::abs(n.y), az = std::abs(n.z);
  float along, across;
  Vec3 direction;
  if (az >= ax && az >= ay) {
    along = p.x, across = p.y, direction = {0, 1, 0};
  } else if (ay >= ax) {
    along = p.x, across = p.z, direction = {0, 0, 1};
  } else {
    along = p.y, across = p.z, direction = {0, 0, 1};
  }
  if (!metal) return {lookup(mottle(), along / kMottleTexel, across / kMottleTexel), direction};
  return {lookup(brushing(), along / (kBrushTexel * kBrushStretch), across / kBrushTexel), direction};
}

float smoothstep(float low, float high, float x) {
  const float t = std::clamp((x - low) / (high - low), 0.0f, 1.0f);
  return t * t * (3.0f - 2.0f * t);
}

float pow5(float x) {
  const float x2 = x * x;
  return x2 * x2 * x;
}

// Two unit vectors that with n make a right-handed frame (Duff et al. 2017).
void frame(const Vec3& n, Vec3* a, Vec3* b) {
  const float sign = std::copysign(1.0f, n.z);
  const float k = -1.0f / (sign + n.z);
  const float m = n.x * n.y * k;
  *a = {1.0f + sign * n.x * n.x * k, sign * m, -sign * n.x};
  *b = {m, sign + n.y * n.y * k, -n.y};
}

// 16 points spread over the unit disk (Vogel's sunflower), in an order that puts neighbouring
// pixels of a 4 x 4 block far apart.
std::array<std::array<float, 2>, 16> disk() {
  static constexpr int kOrder[16] = {0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5};
  std::array<std::array<float, 2>, 16> points{};
  for (int i = 0; i < 16; ++i) {
    const double radius = std::sqrt((kOrder[i] + 0.5) / 16), turn = kOrder[i] * 2.39996322972865;
    points[i] = {static_cast<float>(radius * std::cos(turn)),
                 static_cast<float>(radius * std::sin(turn))};
  }
  return points;
}

const std::array<std::uint8_t, kToneSteps>& tone_curve() {
  static const auto table = [] {
    std::array<std::uint8_t, kToneSteps> bytes{};
    for (int i = 0; i < kToneSteps; ++i) {
      float x = kToneRange * i / (kToneSteps - 1);
      // Highlights roll off towards white instead of clipping.
      if (x > kShoulder) x = 1 - (1 - kShoulder) * std::exp(-(x - kShoulder) / (1 - kShoulder));
      const float srgb = x <= 0.0031308f ? 12.92f * x : 1.055f * std::pow(x, 1 / 2.4f) - 0.055f;
      bytes[i] = static_cast<std::uint8_t>(std::lrint(255.0f * srgb));
    }
    return bytes;
  }();
  return table;
}

}  // namespace

Lighting::Lighting(const Light& light, const Pose& T_base_camera)
    : center_{light.position.x(), light.position.y(), light.position.z()},
      intensity_{light.intensity.x(), light.intensity.y(), light.intensity.z()},
      ambient_(std::clamp(light.ambient, 0.0f, 1.0f)),
      radius_(std::max(0.0f, light.radius)) {
  // The exposure is set for the point of the table that the camera looks at.
  const Eigen::Vector3d eye = T_base_camera.translation();
  const Eigen::Vector3d axis = T_base_camera.rotation().col(2);
  const double distance = axis.z() < -0.1 ? -eye.z() / axis.z() : 1.0;
  const Eigen::Vector3f target = (eye + axis * std::max(distance, 0.1)).cast<float>();
  const Eigen::Vector3f toward = target - light.position;
  reference_ = std::max(toward.squaredNorm(), 1e-4f);
  const Vec3 n = normalized({toward.x(), toward.y(), toward.z() - 1e-6f});
  Vec3 a, b;
  frame(n, &a, &b);
  const auto points = disk();
  for (int i = 0; i < 16; ++i)
    lamp_[i] = center_ + a * (radius_ * points[i][0]) + b * (radius_ * points[i][1]);
}

Vec3 hemisphere(const Vec3& normal, int lane) {
  static const auto points = disk();
  const auto [x, y] = points[lane];
  Vec3 a, b;
  frame(normal, &a, &b);
  return a * x + b * y + normal * std::sqrt(std::max(0.0f, 1.0f - x * x - y * y));
}

Vec3 Lighting::background(float row) const {
  const float value = 0.10f + 0.10f * row;
  return Vec3{value * 0.95f, value, value * 1.06f} * (0.4f + ambient_);
}

Vec3 Lighting::room(const Vec3& direction, float roughness) const {
  const float blur = 0.10f + 0.75f * roughness;
  const float up = std::max(0.0f, direction.z);
  // Ceiling with rows of strip lights, which only smooth metal resolves.
  const float sharp = (1.0f - roughness) * (1.0f - roughness);
  const float phase = direction.x / std::max(up, 0.25f) * 1.7f;
  const float wave = 1.0f - 4.0f * std::abs(phase - cvFloor(phase) - 0.5f);
  const float sky = kHorizon + (kCeiling - kHorizon) * up + 0.9f * sharp * wave * up;
  const float s = smoothstep(-blur, blur, direction.z);
  const float value = kFloor + (sky - kFloor) * s;
  return {value * (0.97f + 0.03f * (1 - s)), value, value * (1.0f + 0.05f * s)};
}

void Lighting::shade(const Surface& surface, const Material& material,
                     const Rotation& R_base_object, Vec3* direct, Vec3* ambient) const {
  const float metallic = material.metallic;
  Vec3 albedo{material.albedo.x(), material.albedo.y(), material.albedo.z()};
  float roughness = std::clamp(material.roughness, kMinRoughness, 1.0f);
  Vec3 normal = surface.normal;
  if (material.texture > 0.0f) {
    const Grain g = grain(surface, metallic > 0.5f);
    const float strength = material.texture * g.value;
    albedo = albedo * std::max(0.1f, 1.0f + (0.18f - 0.10f * metallic) * strength);
    roughness = std::clamp(roughness + 0.05f * strength, kMinRoughness, 1.0f);
    if (metallic > 0.5f)
      normal = normalized(normal + (R_base_object * g.across) * (kBrushTilt * strength));
  }
  const Vec3 diffuse = albedo * (1.0f - metallic);
  const float f0 = kDielectricF0 * (1.0f - metallic);
  const Vec3 reflectance = albedo * metallic + Vec3{f0, f0, f0};
  const float to_eye = std::max(dot(normal, surface.to_eye), 0.02f);

  // From the lamp: Lambert and GGX, its lobe widened by the lamp's angular size.
  const Vec3 lamp = center_ - surface.position;
  const float distance2 = dot(lamp, lamp);
  const float distance = std::sqrt(distance2);
  const Vec3 to_lamp = lamp * (1.0f / distance);
  const float cosine = dot(normal, to_lamp);
  *direct = {0, 0, 0};
  if (cosine > 0.0f) {
    const Vec3 half = normalized(to_lamp + surface.to_eye);
    const float alpha =
        std::min(1.0f, roughness * roughness + 0.5f * radius_ / distance + kBrushSpread * metallic);
    const float alpha2 = alpha * alpha;
    const float nh = dot(normal, half);
    const float denominator = nh * nh * (alpha2 - 1.0f) + 1.0f;
    const float facets = alpha2 / (denominator * denominator);
    const float k = 0.5f * alpha;
    const float masking = 1.0f / ((cosine * (1 - k) + k) * (to_eye * (1 - k) + k));
    const float fresnel = pow5(1.0f - std::max(0.0f, dot(half, surface.to_eye)));
    const float specular = 0.25f * facets * masking;
    const Vec3 mirrored = (reflectance + (Vec3{1, 1, 1} - reflectance) * fresnel) * specular;
    *direct = intensity_ * (diffuse + mirrored) *
              ((1.0f - ambient_) * cosine * reference_ / distance2);
  }

  // From the room: the part above the horizon, and its mirror image in glossy surfaces.
  const Vec3 mirror = normal * (2.0f * to_eye) - surface.to_eye;
  const float fresnel = pow5(1.0f - to_eye) * (1.0f - roughness);
  const Vec3 mirrored = (reflectance + (Vec3{1, 1, 1} - reflectance) * fresnel);
  *ambient = (diffuse * (0.75f + 0.25f * normal.z) + mirrored * room(mirror, roughness)) *
             intensity_ * ambient_;
}

void develop(const cv::Mat& linear, double noise_sigma, std::uint64_t seed, cv::Mat& image) {
  const auto& curve = tone_curve();
  cv::Mat sharp(linear.rows, linear.cols, CV_8UC3);
  parallel_rows(linear.rows, 32, [&](int first, int last) {
    for (int y = first; y < last; ++y) {
      const float* in = linear.ptr<float>(y);
      std::uint8_t* out = sharp.ptr<std::uint8_t>(y);
      for (int i = 0; i < 3 * linear.cols; ++i)
        out[i] = curve[static_cast<int>(std::clamp(in[i], 0.0f, kToneRange) *
                                        ((kToneSteps - 1) / kToneRange))];
    }
  });
  cv::GaussianBlur(sharp, image, {3, 3}, kBlurSigma);
  if (noise_sigma <= 0.0) return;
  // A pixel's 64 bits make three draws of mean 0: each the sum of three 7-bit numbers, whose
  // deviation is sqrt(3 (128^2 - 1) / 12).
  const float scale = static_cast<float>(noise_sigma / std::sqrt(3.0 * (128.0 * 128.0 - 1) / 12));
  const std::uint64_t stream = mix(seed);
  parallel_rows(image.rows, 32, [&](int first, int last) {
    for (int y = first; y < last; ++y) {
      std::uint8_t* row = image.ptr<std::uint8_t>(y);
      for (int x = 0; x < image.cols; ++x) {
        const std::uint64_t bits = mix(stream + static_cast<std::uint64_t>(y) * image.cols + x);
        for (int c = 0; c < 3; ++c) {
          const std::uint64_t draw = bits >> (21 * c);
          const int sum = (draw & 127) + (draw >> 7 & 127) + (draw >> 14 & 127);
          const float value = row[3 * x + c] + scale * (sum - 190.5f);
          row[3 * x + c] = static_cast<std::uint8_t>(std::clamp(value + 0.5f, 0.0f, 255.0f));
        }
      }
    }
  });
}

}  // namespace iwgnet_grasp::sensing
