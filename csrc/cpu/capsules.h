// The distance to the nearest of some line segments, for packs of points.
#pragma once

#include <math.h>

#include "lanes.h"
#include "snarf/segments.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Returns the distance of points x[3], one per lane, to the nearest segment of [S, 6] (start and end), at least 1e-6; with
// `away`, also the vector from the nearest point of that segment.
SNARF_HD Lanes<float> distance_to_segments(const Lanes<float>* x, const float* segments, int count, Lanes<float>* away) {
  using V = Lanes<float>;
  const V nearest = squared_distance_to_segments(x, segments, count, away);
  float distance[V::width];
  store(distance, larger(nearest, V(1e-12f)));
  for (int lane = 0; lane < V::width; ++lane) distance[lane] = sqrtf(distance[lane]);
  return load<float>(distance);
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
