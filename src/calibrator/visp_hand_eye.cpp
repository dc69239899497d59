// ViSP's hand-eye solution as a filter, for programs that must not link libvisp (GPL-2+), as this
// one does. Standard input: any number of problems, each a line with the number of pairs and, a
// line a pair, T_base_tool and T_camera_target as 12 numbers each (the upper three rows). Standard
// output, a line a problem: "OK", T_base_camera (12 numbers) and the solver's time in ms; or
// "REFUSED" and the reason.
#include <chrono>
#include <iomanip>
#include <iostream>
#include <sstream>

#include "visp_solver.h"

using namespace iwgnet_grasp;

namespace {

bool read(std::istream& in, Pose& T) {
  T = Pose::Identity();
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 4; ++c)
      if (!(in >> T.matrix()(r, c))) return false;
  return true;
}

}  // namespace

int main() {
  std::size_t count = 0;
  std::cout << std::setprecision(17);
  while (std::cin >> count) {
    std::vector<calibration::PosePair> pairs(count);
    for (auto& pair : pairs)
      if (!read(std::cin, pair.T_base_tool) || !read(std::cin, pair.T_camera_target)) {
        std::cerr << "visp_hand_eye: a problem ends before its " << count << " pairs\n";
        return 2;
      }
    // ViSP prints its residuals to standard output, which is ours.
    std::ostringstream swallowed;
    std::streambuf* const ours = std::cout.rdbuf(swallowed.rdbuf());
    std::string reason;
    Pose T;
    const auto start = std::chrono::steady_clock::now();
    try {
      T = solve_with_visp(pairs);
    } catch (const std::exception& error) {
      reason = error.what();
    }
    const std::chrono::duration<double, std::milli> time = std::chrono::steady_clock::now() - start;
    std::cout.rdbuf(ours);
    if (!reason.empty()) {
      std::cout << "REFUSED " << reason << std::endl;
      continue;
    }
    std::cout << "OK";
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 4; ++c) std::cout << ' ' << T.matrix()(r, c);
    std::cout << ' ' << time.count() << std::endl;
  }
  return 0;
}
