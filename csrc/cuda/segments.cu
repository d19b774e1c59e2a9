// The distance of points to the nearest of some line segments, and its gradient (snarfcli/networks/capsules.py), float32.
//
// DESIGN. One thread a point. All threads of a block read the same segment at the same time, a few dozen in all, which stay in
// the first-level cache. No sum has more than one thread: the same bits every time.
#include "snarf/segments.h"

namespace snarf {
namespace SNARF_ISA {

struct SegmentDistance {
  const float* points;    // [N, 3], metres
  const float* segments;  // [S, 6]: start and end
  float* distance;        // [N], at least 1e-6
  float* direction;       // [N, 3], unit vectors away from the nearest segment: the gradient
  long long count;        // N
  int segment_count;      // S, at least 1
};

extern "C" __global__ void __launch_bounds__(256) measure_distances(const SegmentDistance a) {
  const long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (n >= a.count) return;
  float x[3], away[3];
  for (int axis = 0; axis < 3; ++axis) x[axis] = a.points[3 * n + axis];
  const float squared = squared_distance_to_segments(x, a.segments, a.segment_count, away);
  const float distance = sqrtf(larger(squared, 1e-12f));
  a.distance[n] = distance;
  for (int axis = 0; axis < 3; ++axis) a.direction[3 * n + axis] = away[axis] / distance;
}

}  // namespace SNARF_ISA
}  // namespace snarf
