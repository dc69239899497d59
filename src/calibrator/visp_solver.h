// ViSP's hand-eye solver on this package's pairs. Links libvisp (GPL-2+).
#pragma once

#include <vector>

#include "iwgnet_grasp/calibration/hand_eye.h"

namespace iwgnet_grasp {

// T_base_camera by vpHandEyeCalibration. Throws Error for too little rotation or no convergence.
Pose solve_with_visp(const std::vector<calibration::PosePair>& pairs);

}  // namespace iwgnet_grasp
