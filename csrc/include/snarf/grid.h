// The canonical grid: the positions of its nodes, and the blended transform at a point.
#pragma once

#include "platform.h"

namespace snarf {
namespace SNARF_ISA {

template <class S>
struct Grid {
  S lower[3];    // canonical position of the first node, metres
  S size[3];     // sides of a cell, metres
  int nodes[3];  // W, H, D: nodes along x, y, z
};

// Finds the cell of a canonical point; a point outside gets the nearest cell. Returns the index of the cell's first node;
// local[3] runs from 0 to 1 inside the cell and beyond outside the grid.
template <class S>
SNARF_HD long long locate(const Grid<S>& grid, const S* x, S* local) {
  long long index[3];
  for (int axis = 0; axis < 3; ++axis) {
    S scaled = (x[axis] - grid.lower[axis]) / grid.size[axis];
    S last = S(grid.nodes[axis] - 2);
    S cell = scaled > S(0) ? (scaled < last ? S((long long)scaled) : last) : S(0);
    index[axis] = (long long)cell;
    local[axis] = scaled - cell;
  }
  return (index[2] * grid.nodes[1] + index[1]) * grid.nodes[0] + index[0];
}

// Index of corner k = x + 2 y + 4 z of the cell whose first node is `first`.
template <class S>
SNARF_HD long long corner_node(const Grid<S>& grid, long long first, int k) {
  return first + (k & 1) + (long long)(k >> 1 & 1) * grid.nodes[0] + (long long)(k >> 2 & 1) * grid.nodes[0] * grid.nodes[1];
}

// Trilinear weights [8] of a cell's corners at coordinates local[3].
template <class S>
SNARF_HD void corner_weights(const S* local, S* weights) {
  for (int k = 0; k < 8; ++k)
    weights[k] = (k & 1 ? local[0] : 1 - local[0]) * (k & 2 ? local[1] : 1 - local[1]) * (k & 4 ? local[2] : 1 - local[2]);
}

}  // namespace SNARF_ISA
}  // namespace snarf
