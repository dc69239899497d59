// Row-parallel loops and counter-based random numbers: same result on any number of threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <thread>
#include <vector>

namespace iwgnet_grasp::sensing {

// Calls body(first, last) on bands of at most `band` rows until all rows are done.
template <typename Body>
void parallel_rows(int rows, int band, Body&& body) {
  std::atomic<int> next{0};
  const auto work = [&] {
    for (int first; (first = next.fetch_add(band)) < rows;)
      body(first, std::min(first + band, rows));
  };
  const int bands = (rows + band - 1) / band;
  const int extra = std::min<int>(std::thread::hardware_concurrency(), bands) - 1;
  std::vector<std::thread> threads;
  for (int i = 0; i < extra; ++i) threads.emplace_back(work);
  work();
  for (auto& thread : threads) thread.join();
}

// SplitMix64's finaliser (Steele et al. 2014): 64 well-mixed bits from a counter.
inline std::uint64_t mix(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

}  // namespace iwgnet_grasp::sensing
