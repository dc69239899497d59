// Python extension iwgnet_grasp._core: the ROS-free core, for in-process trials and data generation.
#include "numpy_image.h"

namespace iwgnet_grasp::bindings {

PYBIND11_MODULE(_core, m) {
  m.doc() =
      "The C++ core of iwgnet_grasp. SI units; poses are 4 x 4 float64 arrays T_to_from; depth "
      "images are (H, W) float32 in metres with NaN where nothing was measured; colour images are "
      "(H, W, 3) uint8 RGB. Errors are CoreError with one line.";
  py::register_exception<Error>(m, "CoreError", PyExc_RuntimeError);
  bind_cell_config(m);
  bind_kinematics(m);
  bind_sensing(m);
  bind_grasping(m);
  bind_motion(m);
  bind_physics(m);
  bind_planning(m);
  bind_calibration(m);
}

}  // namespace iwgnet_grasp::bindings
