// The distance to the nearest of some line segments (snarfcli/segments.py).
#pragma once

#include <math.h>

#include "lanes.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Returns the distance of points x[3], one per lane, to the nearest segment of [S, 6] (start and end), at least 1e-6; with
// `away`, also the vector from the nearest point of that segment.
SNARF_HD Lanes<float> distance_to_segments(const Lanes<float>* x, const float* segments, int count, Lanes<float>* away) {
  using V = Lanes<float>;
  V nearest(3.4e38f);
  for (int s = 0; s < count; ++s) {
    const float* const start = segments + 6 * s;
    float along[3], length = 0;
    for (int axis = 0; axis < 3; ++axis) {
      along[axis] = start[3 + axis] - start[axis];
      length += along[axis] * along[axis];
    }
    V from[3], share(0.f), squared(0.f);
    for (int axis = 0; axis < 3; ++axis) {
      from[axis] = x[axis] - start[axis];
      share = share + from[axis] * along[axis];
    }
    share = smaller(larger(share * V(1.f / (length > 1e-12f ? length : 1e-12f)), V(0.f)), V(1.f));
    for (int axis = 0; axis < 3; ++axis) {
      from[axis] = from[axis] - share * along[axis];
      squared = squared + from[axis] * from[axis];
    }
    if (away) {
      const LaneMask<float> is_nearer = squared < nearest;
      for (int axis = 0; axis < 3; ++axis) away[axis] = s ? select(is_nearer, from[axis], away[axis]) : from[axis];
    }
    nearest = smaller(squared, nearest);
  }
  float distance[V::width];
  store(distance, larger(nearest, V(1e-12f)));
  for (int lane = 0; lane < V::width; ++lane) distance[lane] = sqrtf(distance[lane]);
  return load<float>(distance);
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
