// The distance to the nearest of some line segments (snarfcli/segments.py).
#pragma once

#include "platform.h"

namespace snarf {
namespace SNARF_ISA {

// Returns the squared distance of points x[3] to the nearest segment of [S, 6] (start and end); with `away`, also the vector
// from the nearest point of that segment.
template <class V>
SNARF_HD V squared_distance_to_segments(const V* x, const float* segments, int count, V* away) {
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
      const auto is_nearer = squared < nearest;
      for (int axis = 0; axis < 3; ++axis) away[axis] = s ? select(is_nearer, from[axis], away[axis]) : from[axis];
    }
    nearest = smaller(squared, nearest);
  }
  return nearest;
}

}  // namespace SNARF_ISA
}  // namespace snarf
