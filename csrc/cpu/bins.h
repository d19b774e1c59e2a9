// The bins of the sorted queries that a point or a box touches. The library, which marks bins, and the kernels, which read
// them, must agree.
#pragma once

#include "kernels.h"
#include "snarf/platform.h"

namespace snarf {
namespace SNARF_ISA {

// Grows with the position, so that a query inside a box never lies outside the box's bins.
template <class S>
SNARF_HD int32_t bin_along(const SortedQueries<S>& queries, int axis, S position) {
  const S at = (position - queries.lower[axis]) * queries.per_metre;
  return at > 0 ? (at < S(queries.bins[axis]) ? int32_t(at) : queries.bins[axis] - 1) : 0;
}

// The place of a position in the bins of a prepared pose along an axis, in shares of a bin of level 0. Grows with the position.
template <class S>
SNARF_HD int32_t share_along(const PreparedPose<S>& pose, int axis, S position) {
  const S at = (position - pose.lower[axis]) * pose.shares_per_metre;
  const int32_t last = (pose.level[0].bins[axis] << kShareBits) - 1;
  return at > 0 ? (at < S(last) ? int32_t(at) : last) : 0;
}

// The bin, and the place in it in shares of its side, of a level of a prepared pose.
SNARF_HD int32_t bin_of_share(int32_t share, int level) { return share >> (kShareBits + kCoarserBits * level); }
SNARF_HD uint8_t place_in_bin(int32_t share, int level) { return uint8_t(share >> (kCoarserBits * level)); }

// Calls visit(first, behind the last) for each row of bins that the box of cell k of a block touches.
template <class S, class F>
SNARF_HD void each_bin_row(const SortedQueries<S>& queries, const BlockBoxes<S>& boxes, int k, const F& visit) {
  int32_t low[3], high[3];
  for (int i = 0; i < 3; ++i) {
    const S lower = boxes.lower[i][k], upper = boxes.upper[i][k];
    if (!(lower <= upper && upper >= queries.lower[i] && lower <= queries.upper[i])) return;
    low[i] = bin_along(queries, i, lower);
    high[i] = bin_along(queries, i, upper);
  }
  for (int32_t z = low[2]; z <= high[2]; ++z)
    for (int32_t y = low[1]; y <= high[1]; ++y) {
      const int64_t row = (int64_t(z) * queries.bins[1] + y) * queries.bins[0];
      visit(row + low[0], row + high[0] + 1);
    }
}

}  // namespace SNARF_ISA
}  // namespace snarf
