// Cells side by side as polynomials (cell.h), one lane per cell.
#pragma once

#include "kernels.h"
#include "lanes.h"
#include "snarf/cell.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// The polynomials of as many cells as there are lanes, laid out so that one cell's numbers can be picked out.
template <class S>
struct CellLanes {
  Cell<Lanes<S>> cell;
  CellBounds<Lanes<S>> bounds;
};

// Cells x .. x + width - 1 of a row, one per lane; beyond the end of the row the last node is repeated.
template <class S>
void load_cells(const S* transforms, const Geometry<S>& geometry, int x, int y, int z, Cell<Lanes<S>>& out) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  const int64_t row_nodes = geometry.nodes[0];
  V corner[8 * 12];
  for (int row = 0; row < 4; ++row) {
    const S* const nodes = transforms + 12 * ((int64_t(z + (row >> 1)) * geometry.nodes[1] + y + (row & 1)) * row_nodes);
    const S* node[width + 1];
    for (int i = 0; i <= width; ++i) node[i] = nodes + 12 * (x + i < row_nodes ? x + i : row_nodes - 1);
    V* const left = corner + 24 * row;
    load_rows<12>(node, left);
    for (int r = 0; r < 12; ++r) left[12 + r] = shifted(left[r], node[width][r]);
  }
  V centre[3];
  S along[width];
  for (int i = 0; i < width; ++i) along[i] = geometry.lower[0] + (S(x + i) + S(0.5)) * geometry.size[0];
  centre[0] = load<S>(along);
  centre[1] = V(geometry.lower[1] + (S(y) + S(0.5)) * geometry.size[1]);
  centre[2] = V(geometry.lower[2] + (S(z) + S(0.5)) * geometry.size[2]);
  cell_from_corners(corner, centre, geometry.size, out);
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
