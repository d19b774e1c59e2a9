// Features at the nodes of grids, interpolated at points (snarfcli/shape/features.py).
#pragma once

#include "lanes.h"
#include "network_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// The cell of a level that a point lies in: rows of the features at its corners, and the point's place between them.
struct Place {
  int32_t row[8];
  float local[3];
};

SNARF_HD bool find_place(const FeatureLevel& level, const float* point, Place& place) {
  int cell[3];
  for (int axis = 0; axis < 3; ++axis) {
    const float at = (point[axis] - level.lower[axis]) * level.per_metre[axis];
    if (!(at >= 0.f && at <= float(level.nodes[axis] - 1))) return false;
    cell[axis] = int(at) < level.nodes[axis] - 2 ? int(at) : level.nodes[axis] - 2;
    place.local[axis] = at - float(cell[axis]);
  }
  const int64_t width = level.nodes[0], layer = width * level.nodes[1];
  const int32_t* const rows = level.rows + cell[2] * layer + cell[1] * width + cell[0];
  for (int k = 0; k < 8; ++k) place.row[k] = rows[(k >> 2) * layer + (k >> 1 & 1) * width + (k & 1)];
  return true;
}

// Trilinear weights of the eight corners.
SNARF_HD void corner_weights(const Place& place, float* weights) {
  const float x[2] = {1.f - place.local[0], place.local[0]};
  for (int k = 0; k < 4; ++k) {
    const float yz = (k & 1 ? place.local[1] : 1.f - place.local[1]) * (k >> 1 ? place.local[2] : 1.f - place.local[2]);
    weights[2 * k] = x[0] * yz;
    weights[2 * k + 1] = x[1] * yz;
  }
}

// F numbers per node where that is known when this is compiled, else 0.
template <int F>
SNARF_HD void interpolate(const float* table, int count, const FeatureLevel& level, const float* point, float* out) {
  const int features = F ? F : count;
  for (int f = 0; f < features; ++f) out[f] = 0.f;
  Place place;
  if (!find_place(level, point, place)) return;
  float weights[8];
  corner_weights(place, weights);
  for (int k = 0; k < 8; ++k) {
    if (place.row[k] < 0) continue;
    const float* const row = table + int64_t(place.row[k]) * features;
    for (int f = 0; f < features; ++f) out[f] += weights[k] * row[f];
  }
}

SNARF_HD void interpolate(const float* table, int count, const FeatureLevel& level, const float* point, float* out) {
  if (count == 4) {
    interpolate<4>(table, count, level, point, out);
  } else if (count == 2) {
    interpolate<2>(table, count, level, point, out);
  } else {
    interpolate<0>(table, count, level, point, out);
  }
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
