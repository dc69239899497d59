#include "visp_solver.h"

#include <visp3/vision/vpHandEyeCalibration.h>

namespace iwgnet_grasp {
namespace {

vpHomogeneousMatrix to_visp(const Pose& T) {
  vpHomogeneousMatrix M;
  for (unsigned r = 0; r < 4; ++r)
    for (unsigned c = 0; c < 4; ++c) M[r][c] = T.matrix()(r, c);
  return M;
}

Pose from_visp(const vpHomogeneousMatrix& M) {
  Pose T = Pose::Identity();
  for (unsigned r = 0; r < 3; ++r)
    for (unsigned c = 0; c < 4; ++c) T.matrix()(r, c) = M[r][c];
  return T;
}

}  // namespace

// ViSP solves for the camera on the effector. The camera in the room is the same problem with the
// robot's poses inverted: the base then moves before the tool.
Pose solve_with_visp(const std::vector<calibration::PosePair>& pairs) {
  std::vector<vpHomogeneousMatrix> cMo, rMe;
  for (const auto& pair : pairs) {
    cMo.push_back(to_visp(pair.T_camera_target));
    rMe.push_back(to_visp(pair.T_base_tool.inverse()));
  }
  vpHomogeneousMatrix eMc;
  switch (vpHandEyeCalibration::calibrate(cMo, rMe, eMc)) {
    case 0: return from_visp(eMc);
    case -1: throw Error("ViSP: too little rotation between the poses; turn and tilt the target more");
    default: throw Error("ViSP: no convergence; the pairs contradict each other");
  }
}

}  // namespace iwgnet_grasp
