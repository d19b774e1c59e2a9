// Cells and their parts as polynomials (cell.h): what of them is kept, where they may hold a query, and their roots.
#pragma once

#include "search.cuh"
#include "snarf/cell.h"
#include "snarf/newton.h"

namespace snarf {
namespace SNARF_ISA {

// All that the test of a query reads, apart from the polynomial, which only halving and solving do. Both are aligned so that
// they move in 16-byte pieces, and are filled to the last byte: padding would be copied byte by byte, and read without ever
// having been written.
template <class S>
struct alignas(16) Bounds {
  S centre[3], box[3];  // posed, metres; box[0] < 0: the cell is not searched, and all else is undefined
  S inverse[9], reach[3], curvature, zero;
};
template <class S>
struct alignas(16) Polynomial {
  Cell<S> cell;
};

// A cell, or one of several slices of its candidates.
struct alignas(16) Unit {
  int cell;  // number in the group
  int slice, slices, zero;
};

// A query and the cell, or part of a cell, that may hold a root of it. The lists: 0 has tame cells and parts, to be solved from
// one start; 1 to kLevels - 1 curved parts of that level, to be halved; kLevels those of the last, to be solved from several.
struct alignas(16) Entry {
  int query, record;  // record: pose in the group times C, plus the cell's number in the group
  int level, path;    // halvings of the cell, and which eighth was taken at each, 3 bits a level, the last one lowest
};
static_assert(kLists == kLevels + 1, "one list for each level, and one to solve");

template <class S>
__device__ void eighth(int k, S* shift) {
  for (int i = 0; i < 3; ++i) shift[i] = k >> i & 1 ? S(0.25) : S(-0.25);
}

// Coordinate up to which a root counts as in a part: it may lie as far beyond its faces as beyond those of the cell.
template <class S>
__device__ S width_at(int level) {
  return S(0.5) + face_tolerance<S>() * S(1 << level);
}

template <class S>
__device__ __forceinline__ void measure(const Cell<S>& cell, int level, Bounds<S>& bounds) {
  CellBounds<S> found;
  bound_cell<S, S>(cell, found, width_at<S>(level));
  for (int i = 0; i < 3; ++i) {
    bounds.centre[i] = cell.c[kMonomials * i];
    bounds.box[i] = found.box[i];
    bounds.reach[i] = found.reach[i];
  }
  for (int i = 0; i < 9; ++i) bounds.inverse[i] = found.inverse[i];
  bounds.curvature = found.curvature;
  bounds.zero = 0;
}

template <class S>
__device__ bool is_tame(const Bounds<S>& bounds) {
  return bounds.curvature < S(kTame);
}

// Where an entry for a cell or a part of this level belongs.
template <class S>
__device__ int list_of(const Bounds<S>& bounds, int level) {
  return is_tame(bounds) ? 0 : level;
}

template <class S>
__device__ __forceinline__ bool holds(const Bounds<S>& bounds, const S* target) {
  S offset[3];
  for (int i = 0; i < 3; ++i) offset[i] = target[i] - bounds.centre[i];
  return may_hold(bounds.box, bounds.inverse, bounds.reach, offset);
}

// The polynomial of an entry's part, halved from that of its cell.
template <class S>
__device__ __forceinline__ void make_part(const Search<S>& a, const Entry& entry, Cell<S>& part) {
  part = ((const Polynomial<S>*)a.polynomials)[entry.record].cell;
  for (int level = entry.level - 1; level >= 0; --level) {
    SNARF_COUNT(halvings);
    const Cell<S> whole = part;
    S shift[3];
    eighth(entry.path >> 3 * level & 7, shift);
    halve_cell<S, S>(whole, shift, part);
  }
}

template <class S>
__device__ void centre_of(const Grid<S>& grid, int cell, S* centre) {
  const int x = cell % (grid.nodes[0] - 1), rest = cell / (grid.nodes[0] - 1);
  const int index[3] = {x, rest % (grid.nodes[1] - 1), rest / (grid.nodes[1] - 1)};
  for (int i = 0; i < 3; ++i) centre[i] = grid.lower[i] + (S(index[i]) + S(0.5)) * grid.size[i];
}

// Newton's method from one start in an entry's part. Writes the canonical root and the inverse of dd/dx there; returns whether
// there is one. The same arithmetic as on the CPU.
template <class S>
__device__ __forceinline__ bool solve(const Search<S>& a, const Entry& entry, const Cell<S>& part, int start, Twelve<S>& root) {
  SNARF_COUNT(solves);
  const Grid<S> grid = grid_of(a);
  const Solver<S> solver = {S(a.tolerance) * longest_side(a), a.max_steps};
  S offset[3], s[3], inverse[9];
  for (int i = 0; i < 3; ++i) offset[i] = a.points[3 * (long long)entry.query + i] - part.c[kMonomials * i];
  centre_inverse<S, S>(part, inverse);
  for (int i = 0; i < 3; ++i) {
    const S* row = inverse + 3 * i;
    const S guess = row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2];
    const S corner = start >> i & 1 ? S(0.5) : S(-0.5);
    s[i] = start == kAffineStart ? smaller(larger(guess, S(-0.5)), S(0.5)) : start == kCentreStart ? S(0) : corner;
  }
  const S scale = S(1) / S(1 << entry.level);
  for (int i = 0; i < 9; ++i) inverse[i] = 0;
  if (!solve_in_cell(part.c, offset, true, solver, S(0.5) + face_tolerance<S>() / scale, s, inverse)) return false;
  S centre[3], within[3] = {0, 0, 0};  // of the cell, metres; of the part within it, cell coordinates
  centre_of(grid, a.first_cell + entry.record % a.cells, centre);
  for (int level = 1; level <= entry.level; ++level) {
    S shift[3];
    eighth(entry.path >> 3 * (entry.level - level) & 7, shift);
    for (int i = 0; i < 3; ++i) within[i] += shift[i] / S(1 << (level - 1));
  }
  for (int i = 0; i < 3; ++i) {
    root.v[i] = centre[i] + grid.size[i] * (within[i] + scale * s[i]);
    for (int j = 0; j < 3; ++j) root.v[3 + 3 * i + j] = inverse[3 * i + j] * (grid.size[i] * scale);
  }
  return !a.orientation_preserving || preserves_orientation(root.v + 3);
}

template <class S>
__device__ void report(const Search<S>& a, const Entry& entry, const Twelve<S>& root) {
  report_root(a, entry.query, a.first_cell + entry.record % a.cells, root.v, root.v + 3);
}

// Reports what the starts of one part found, [kStarts], each root once, so that few slots are needed.
template <class S>
__device__ void report_once(const Search<S>& a, const Entry& entry, const Twelve<S>* roots, bool* found) {
  const S distance = same_root_distance(a, grid_of(a));
  for (int start = 0; start < kStarts; ++start) {
    if (!found[start]) continue;
    const bool preserves = preserves_orientation(roots[start].v + 3);
    for (int before = 0; before < start && found[start]; ++before)
      if (found[before] && preserves_orientation(roots[before].v + 3) == preserves)
        found[start] = squared_distance(roots[before].v, roots[start].v) >= distance * distance;
    if (found[start]) report(a, entry, roots[start]);
  }
}

// ------------------------------------------------------------------------------------------------ lists
// Puts this thread's entry on a list, or none if list < 0; all threads of the block call it. Returns whether there was room.
template <class S>
__device__ __forceinline__ bool enter(const Search<S>& a, int list, const Entry& entry) {
  __shared__ int wanted[kLists], first[kLists];
  const int t = threadIdx.x, threads = blockDim.x;
  __syncthreads();  // all threads have read `first`
  for (int i = t; i < kLists; i += threads) wanted[i] = 0;
  __syncthreads();
  const int mine = list < 0 ? 0 : atomicAdd(wanted + list, 1);
  __syncthreads();
  for (int i = t; i < kLists; i += threads)
    if (wanted[i]) first[i] = atomicAdd(a.entered + i, wanted[i]);
  __syncthreads();
  if (list < 0) return true;
  const long long at = a.list_begin[list] + first[list] + mine;
  if (at >= a.list_begin[list + 1]) return false;
  ((Entry*)a.entries)[at] = entry;
  return true;
}

// Number of entries on a list.
template <class S>
__device__ __forceinline__ int length_of(const Search<S>& a, int list) {
  const long long room = a.list_begin[list + 1] - a.list_begin[list];
  return a.entered[list] < room ? a.entered[list] : int(room);
}

// What a list has no room for: one thread does all that would have become of the entry, depth first.
template <class S>
__device__ void search_below(const Search<S>& a, int list, Entry entry) {
  const int top = entry.level;
  bool may_be_held = true;  // as is known of the entry itself
  for (;;) {
    Cell<S> part;
    make_part(a, entry, part);
    if (entry.level > top) {
      Bounds<S> bounds;
      measure(part, entry.level, bounds);
      may_be_held = holds(bounds, a.points + 3 * (long long)entry.query);
      list = list_of(bounds, entry.level);
    }
    if (may_be_held && list > 0 && list < kLevels) {
      ++entry.level;
      entry.path *= 8;
      continue;
    }
    if (may_be_held) {
      Twelve<S> roots[kStarts];
      bool found[kStarts];
      for (int start = 0; start < kStarts; ++start)
        found[start] = (list > 0 || start == kAffineStart) && solve(a, entry, part, start, roots[start]);
      report_once(a, entry, roots, found);
    }
    for (; entry.level > top && entry.path % 8 == 7; --entry.level) entry.path /= 8;
    if (entry.level == top) return;
    ++entry.path;
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
