// The slope of what is interpolated in a cell of a feature grid.
#pragma once

#include "places.h"

namespace snarf {
namespace SNARF_ISA {

// Adds the gradient by a point inside the level to total[3]. along[8]: the products of the gradient by the point's features
// with the features of each corner; they are interpolated as the features are.
SNARF_HD void add_slope(const FeatureLevel& level, const Place& place, const float* along, float* total) {
  const float x = place.local[0], y = place.local[1], z = place.local[2];
  float edge[4], rise[4];  // between and along the edges in x
  for (int k = 0; k < 4; ++k) {
    rise[k] = along[2 * k + 1] - along[2 * k];
    edge[k] = along[2 * k] + x * rise[k];
  }
  const float low = rise[0] + y * (rise[1] - rise[0]), high = rise[2] + y * (rise[3] - rise[2]);
  const float front = edge[1] - edge[0], back = edge[3] - edge[2];
  total[0] += level.per_metre[0] * (low + z * (high - low));
  total[1] += level.per_metre[1] * (front + z * (back - front));
  total[2] += level.per_metre[2] * (edge[2] + y * back - edge[0] - y * front);
}

}  // namespace SNARF_ISA
}  // namespace snarf
