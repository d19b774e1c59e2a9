// The levels of feature grids and where points lie in them (snarfcli/shape/features.py).
#pragma once

#include "platform.h"

namespace snarf {

// A level of feature grids.
struct FeatureLevel {
  float lower[3];      // of the first node, metres
  float per_metre[3];  // cells per metre
  int nodes[3];        // W, H, D
  const int* rows;     // row of each node's features, [D, H, W]; nodes with a row that does not exist, as -1, count as zeros
  unsigned row_count;  // R, rows of the table
};

namespace SNARF_ISA {

// The cell of a level that a point lies in: rows of the features at its corners, kNoRow where there are none, and the point's
// place between them.
struct Place {
  unsigned row[8];
  float local[3];
  bool is_inside;
};

constexpr unsigned kNoRow = 0xffffffffu;

SNARF_HD void find_place(const FeatureLevel& level, const float* point, Place& place) {
  int cell[3];
  place.is_inside = false;
  for (int axis = 0; axis < 3; ++axis) {
    const float at = (point[axis] - level.lower[axis]) * level.per_metre[axis];
    if (!(at >= 0.f && at <= float(level.nodes[axis] - 1))) return;
    cell[axis] = int(at) < level.nodes[axis] - 2 ? int(at) : level.nodes[axis] - 2;
    place.local[axis] = at - float(cell[axis]);
  }
  place.is_inside = true;
  const long long width = level.nodes[0], layer = width * level.nodes[1];
  const int* const rows = level.rows + cell[2] * layer + cell[1] * width + cell[0];
  for (int k = 0; k < 8; ++k) {
    const unsigned row = unsigned(rows[(k >> 2) * layer + (k >> 1 & 1) * width + (k & 1)]);
    place.row[k] = row < level.row_count ? row : kNoRow;
  }
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

}  // namespace SNARF_ISA
}  // namespace snarf
