// The complete search of a prepared pose (prepared.h), query by query.
//
// DESIGN. A query goes through the cells of its bins, which are tested side by side. What remains are pairs of a query and a
// cell, or later a part of a cell. They wait in lists, and as many as there are lanes are handled together, each with its own
// polynomial: parts that may hold several roots are cut into eight, the others are solved. So few queries keep all lanes busy.
// The bins, their entries and the bounds of the cells lie anywhere in memory: they are fetched for several queries ahead.
#pragma once

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include "bins.h"
#include "cell_lanes.h"
#include "kernels.h"
#include "lanes.h"
#include "snarf/cell.h"
#include "snarf/newton.h"
#include "snarf/search.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Records and boxes of the cells of a block that are searched; those whose transforms are not finite or absurd exclude every
// query.
template <class S>
void bounds(const S* transforms, const Geometry<S>& geometry, const Block& block, CellRecord<S>* out, S* boxes) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  for (int first = 0; first < kBlock; first += width) {
    const uint32_t active = block.active >> first & ((1u << width) - 1);
    if (!active) continue;
    CellLanes<S> cells;
    load_cells(transforms, geometry, block.x + first, block.y, block.z, cells.cell);
    bound_cell<V, S>(cells.cell, cells.bounds);
    for (uint32_t left = active; left; left &= left - 1, ++out, boxes += 3) {
      const int k = lowest_bit(left);
      bool usable = true;
      for (int i = 0; i < 3; ++i) {
        out->centre[i] = cells.cell.c[kMonomials * i][k];
        out->reach[i] = cells.bounds.reach[i][k];
        boxes[i] = cells.bounds.box[i][k];
        usable = usable && boxes[i] < S(1e15) && out->centre[i] - out->centre[i] == 0;
      }
      for (int i = 0; i < 9; ++i) out->inverse[i] = cells.bounds.inverse[i][k];
      out->curvature = cells.bounds.curvature[k];
      if (!usable) out->reach[0] = S(-1);
    }
  }
}

SNARF_HD void fetch(const void* at) {
#if defined(__GNUC__)
  __builtin_prefetch(at);
#else
  (void)at;
#endif
}

// A query that may have a root in a cell, or in the part of it at the end of `path`: three bits per level, the first lowest.
struct CellPair {
  int32_t query, cell;
  uint32_t path;
};

// The pairs that wait, and what becomes of them.
template <class S>
class PairSearch {
 public:
  using V = Lanes<S>;
  static constexpr int width = V::width;

  PairSearch(const PreparedTask<S>& task, RootSink<S>& sink)
      : task_(task),
        sink_(sink),
        per_row_(1.0 / (task.geometry.nodes[0] - 1)),
        per_layer_(1.0 / (task.geometry.nodes[1] - 1)) {}

  // Takes up to `width` pairs whose query lies in the posed box of the cell.
  void add(const CellPair* pairs, int count) {
    screen(pairs, count);
    settle(0, width);
  }
  // Handles the pairs that are left.
  void finish() {
    for (int level = 0; level <= kLevels; ++level) settle(level, 1);
  }

 private:
  struct Taken {
    const CellPair* pairs;
    int count;
  };

  struct List {
    CellPair pairs[9 * width];  // those that are left, fewer than `width`, and what one step adds
    int count = 0;
    void push(const CellPair& pair) { pairs[count++] = pair; }
    // Hands over up to `width` pairs from the end. They stay valid until something is pushed.
    Taken take() {
      const int taken = count < width ? count : width;
      count -= taken;
      return {pairs + count, taken};
    }
  };

  // Parts of as many cells as there are lanes.
  struct Parts {
    Cell<V> cell;
    V shift[3], centre[3];  // centre of the part in the cell, cell coordinates; canonical centre of the cell, metres
    V offset[3];            // of the query from the part's posed centre, metres
    S scale;                // side of the part, in cells
    int32_t number[width];  // of the cell
    int count;
  };

  // Keeps the pairs that may have a root.
  void screen(const CellPair* pairs, int count) {
    const S* record[width];
    S points[3][width];
    for (int k = 0; k < width; ++k) {
      const CellPair& pair = pairs[k < count ? k : 0];
      record[k] = task_.cells[pair.cell].centre;
      for (int i = 0; i < 3; ++i) points[i][k] = task_.points[3 * int64_t(pair.query) + i];
    }
    V numbers[16];  // centre, inverse, reach, curvature
    load_rows<16>(record, numbers);
    const V *const inverse = numbers + 3, *const reach = numbers + 12;
    V offset[3];
    for (int i = 0; i < 3; ++i) offset[i] = SNARF_ISA::load<S>(points[i]) - numbers[i];
    LaneMask<S> may = first_lanes<S>(count);
    for (int i = 0; i < 3; ++i) {
      const V along = inverse[3 * i] * offset[0] + inverse[3 * i + 1] * offset[1] + inverse[3 * i + 2] * offset[2];
      may = may & (absolute(along) <= reach[i]);
    }
    const uint32_t is_tame = bits(numbers[15] < S(kTame));
    for (uint32_t left = bits(may); left; left &= left - 1) {
      const int lane = lowest_bit(left);
      (is_tame >> lane & 1 ? tame_ : open_)[0].push(pairs[lane]);
      fetch_corners(pairs[lane]);
    }
  }

  // The node at the first corner of a cell.
  const S* corner_of(int32_t cell, int32_t* index) const {
    const int32_t *const nodes = task_.geometry.nodes, number = task_.number[cell];
    // A product with the reciprocal, much faster than a division; half a cell is far more than its rounding.
    const int32_t row = int32_t((number + 0.5) * per_row_);
    index[2] = int32_t((row + 0.5) * per_layer_);
    index[1] = row - index[2] * (nodes[1] - 1);
    index[0] = number - row * (nodes[0] - 1);
    return task_.transforms + 12 * ((int64_t(index[2]) * nodes[1] + index[1]) * nodes[0] + index[0]);
  }

  // Numbers from the first corner of a cell to another one.
  int64_t step_to(int corner) const {
    const int32_t* const nodes = task_.geometry.nodes;
    return 12 * ((int64_t(corner >> 2) * nodes[1] + (corner >> 1 & 1)) * nodes[0] + (corner & 1));
  }

  void fetch_corners(const CellPair& pair) const {
    int32_t index[3];
    const S* const first = corner_of(pair.cell, index);
    for (int corner = 0; corner < 8; corner += 2) {
      fetch(first + step_to(corner));
      fetch(first + step_to(corner) + 23);
    }
  }

  void settle(int level, int least) {
    while (open_[level].count >= least) {
      level < kLevels ? cut(level) : solve_from_many_starts();
      if (level < kLevels) settle(level + 1, width);
    }
    while (tame_[level].count >= least) {
      const Taken taken = tame_[level].take();
      Parts parts;
      load(taken, level, parts);
      solve(parts, taken.pairs, kAffineStart);
    }
  }

  // Loads the parts of pairs, which lie `level` cuts deep in their cells. Lanes without a pair repeat the first.
  void load(const Taken& taken, int level, Parts& out) const {
    const Geometry<S>& geometry = task_.geometry;
    const CellPair* const pairs = taken.pairs;
    const int count = taken.count;
    const S* nodes[width];
    S centre[3][width], points[3][width];
    for (int k = 0; k < width; ++k) {
      const CellPair& pair = pairs[k < count ? k : 0];
      int32_t index[3];
      nodes[k] = corner_of(pair.cell, index);
      out.number[k] = task_.number[pair.cell];
      for (int i = 0; i < 3; ++i) {
        centre[i][k] = geometry.lower[i] + (S(index[i]) + S(0.5)) * geometry.size[i];
        points[i][k] = task_.points[3 * int64_t(pair.query) + i];
      }
    }
    V corner[8 * 12];
    for (int c = 0; c < 8; ++c) {
      const S* at[width];
      for (int k = 0; k < width; ++k) at[k] = nodes[k] + step_to(c);
      load_rows<12>(at, corner + 12 * c);
    }
    for (int i = 0; i < 3; ++i) {
      out.centre[i] = SNARF_ISA::load<S>(centre[i]);
      out.shift[i] = V(S(0));
    }
    cell_from_corners(corner, out.centre, geometry.size, out.cell);
    out.scale = 1;
    for (int cuts = 0; cuts < level; ++cuts) {
      V shift[3];
      for (int i = 0; i < 3; ++i) {
        S values[width];
        for (int k = 0; k < width; ++k) values[k] = quarter(pairs[k < count ? k : 0].path >> 3 * cuts, i);
        shift[i] = SNARF_ISA::load<S>(values);
        out.shift[i] = out.shift[i] + shift[i] * out.scale;
      }
      const Cell<V> whole = out.cell;
      halve_cell<V, S>(whole, shift, out.cell);
      out.scale *= S(0.5);
    }
    for (int i = 0; i < 3; ++i) out.offset[i] = SNARF_ISA::load<S>(points[i]) - out.cell.c[kMonomials * i];
    out.count = count;
  }

  // Centre of an eighth along an axis.
  static S quarter(uint32_t eighth, int axis) { return eighth >> axis & 1 ? S(0.25) : S(-0.25); }

  // Cuts the parts of some pairs into eight, and keeps those that may hold a root of the query.
  void cut(int level) {
    const Taken taken = open_[level].take();
    Parts whole;
    load(taken, level, whole);
    const S wide = S(0.5) + face_tolerance<S>() * S(2) / whole.scale;
    for (uint32_t eighth = 0; eighth < 8; ++eighth) {
      Cell<V> cell;
      CellBounds<V> bounds;
      V shift[3], offset[3];
      for (int i = 0; i < 3; ++i) shift[i] = V(quarter(eighth, i));
      halve_cell<V, S>(whole.cell, shift, cell);
      bound_cell<V, S>(cell, bounds, wide);
      for (int i = 0; i < 3; ++i) offset[i] = whole.offset[i] + (whole.cell.c[kMonomials * i] - cell.c[kMonomials * i]);
      const LaneMask<S> may = may_hold(bounds.box, bounds.inverse, bounds.reach, offset) & first_lanes<S>(whole.count);
      const uint32_t is_tame = bits(bounds.curvature < S(kTame));
      for (uint32_t left = bits(may); left; left &= left - 1) {
        const int lane = lowest_bit(left);
        CellPair pair = taken.pairs[lane];
        pair.path |= eighth << 3 * level;
        (is_tame >> lane & 1 ? tame_ : open_)[level + 1].push(pair);
      }
    }
  }

  void solve_from_many_starts() {
    const Taken taken = open_[kLevels].take();
    Parts parts;
    load(taken, kLevels, parts);
    for (int start = 0; start < kStarts; ++start) solve(parts, taken.pairs, start);
  }

  // Newton's method from one of kStarts.
  void solve(const Parts& parts, const CellPair* pairs, int start) {
    V s[3], inverse[9];
    centre_inverse<V, S>(parts.cell, inverse);
    for (int i = 0; i < 3; ++i) {
      if (start == kAffineStart) {
        const V guess =
            parts.offset[0] * inverse[3 * i] + parts.offset[1] * inverse[3 * i + 1] + parts.offset[2] * inverse[3 * i + 2];
        s[i] = smaller(larger(guess, V(S(-0.5))), V(S(0.5)));
      } else {
        s[i] = V(start == kCentreStart ? S(0) : start >> i & 1 ? S(0.5) : S(-0.5));
      }
    }
    for (int i = 0; i < 9; ++i) inverse[i] = V(S(0));
    const Solver<S> solver{task_.tolerance, task_.max_steps};
    const S reach = S(0.5) + face_tolerance<S>() / parts.scale;
    const LaneMask<S> found = solve_in_cell(parts.cell.c, parts.offset, first_lanes<S>(parts.count), solver, reach, s, inverse);
    const S* const size = task_.geometry.size;
    for (uint32_t left = bits(found); left; left &= left - 1) {
      const int lane = lowest_bit(left);
      if (sink_.next == sink_.end) sink_.more(&sink_);
      Root<S>& root = *sink_.next;
      root.query = pairs[lane].query;
      root.order = parts.number[lane];
      for (int i = 0; i < 3; ++i) {
        root.canonical[i] = parts.centre[i][lane] + size[i] * (parts.shift[i][lane] + parts.scale * s[i][lane]);
        for (int j = 0; j < 3; ++j) root.inverse[3 * i + j] = inverse[3 * i + j][lane] * (size[i] * parts.scale);
      }
      S minors[9];
      if (!task_.orientation_preserving || adjugate(root.inverse, minors) > 0) ++sink_.next;
    }
  }

  const PreparedTask<S>& task_;
  RootSink<S>& sink_;
  const double per_row_, per_layer_;            // of cells in a row, and of rows in a layer
  List open_[kLevels + 1], tame_[kLevels + 1];  // by the number of cuts
};

// The cells of a group whose boxes hold a query, given its place in the bin, one bit each.
SNARF_HD uint32_t cells_around(const BinGroup& group, const uint8_t* place) {
#if defined(__SSE2__)
  __m128i out = _mm_set1_epi8(-1);
  for (int i = 0; i < 3; ++i) {
    const __m128i at = _mm_set1_epi8(char(place[i]));
    const __m128i lower = _mm_loadu_si128(reinterpret_cast<const __m128i*>(group.lower[i]));
    const __m128i upper = _mm_loadu_si128(reinterpret_cast<const __m128i*>(group.upper[i]));
    out = _mm_and_si128(
        out, _mm_and_si128(_mm_cmpeq_epi8(_mm_max_epu8(lower, at), at), _mm_cmpeq_epi8(_mm_min_epu8(upper, at), at)));
  }
  return uint32_t(_mm_movemask_epi8(out));
#else
  uint32_t out = 0;
  for (int k = 0; k < kBlock; ++k) {
    bool inside = true;
    for (int i = 0; i < 3; ++i) inside &= group.lower[i][k] <= place[i] && place[i] <= group.upper[i][k];
    out |= uint32_t(inside) << k;
  }
  return out;
#endif
}

constexpr int kQueriesAhead = 16;

// Where a query is looked for.
struct QueryBin {
  int64_t bin;
  int32_t query, first, last;  // groups
  uint8_t place[3];
};

template <class S>
void search_prepared(const PreparedTask<S>& task, int64_t first, int64_t last, RootSink<S>& sink) {
  constexpr int width = Lanes<S>::width;
  const PreparedPose<S>& pose = *task.pose;
  PairSearch<S> search(task, sink);
  QueryBin bins[kQueriesAhead * kMostLevels];
  CellPair pairs[width + kBlock];  // fewer than `width` that are left, and those of one group
  int waiting = 0;
  for (int64_t start = first; start < last; start += kQueriesAhead) {
    const int64_t end = start + kQueriesAhead < last ? start + kQueriesAhead : last;
    int count = 0;
    for (int64_t n = start; n < end; ++n) {
      const S* const point = task.points + 3 * n;
      bool inside = true;
      for (int i = 0; i < 3; ++i) inside = inside && point[i] >= pose.lower[i] && point[i] <= pose.upper[i];
      if (!inside) continue;
      int32_t share[3];
      for (int i = 0; i < 3; ++i) share[i] = share_along(pose, i, point[i]);
      for (int level = 0; level < pose.levels; ++level) {
        const PreparedLevel& in = pose.level[level];
        if (in.is_empty) continue;
        QueryBin& to = bins[count++];
        int64_t at[3];
        for (int i = 0; i < 3; ++i) {
          at[i] = bin_of_share(share[i], level);
          to.place[i] = place_in_bin(share[i], level);
        }
        to.query = int32_t(n);
        to.bin = in.bins_before + (at[2] * in.bins[1] + at[1]) * in.bins[0] + at[0];
        fetch(task.first + to.bin);
      }
    }
    for (int k = 0; k < count; ++k) {
      bins[k].first = task.first[bins[k].bin];
      bins[k].last = task.first[bins[k].bin + 1];
      if (bins[k].first < bins[k].last) {
        const char* const at = reinterpret_cast<const char*>(task.groups + bins[k].first);
        for (int line = 0; line < 5; ++line) fetch(at + 64 * line);
      }
    }
    for (int k = 0; k < count; ++k)
      for (int32_t n = bins[k].first; n < bins[k].last; ++n) {
        const BinGroup& group = task.groups[n];
        for (uint32_t around = cells_around(group, bins[k].place); around; around &= around - 1) {
          const int32_t cell = group.cell[lowest_bit(around)];
          fetch(task.cells + cell);
          pairs[waiting++] = {bins[k].query, cell, 0};
        }
        int done = 0;
        for (; waiting - done >= width; done += width) search.add(pairs + done, width);
        waiting -= done;
        for (int i = 0; done && i < waiting; ++i) pairs[i] = pairs[done + i];
      }
  }
  for (int done = 0; done < waiting; done += width) search.add(pairs + done, waiting - done < width ? waiting - done : width);
  search.finish();
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
