// Shared by the kernels of a search: their arguments, and the report of a root.
//
// Every kernel of a search takes the same structure by value; snarfcli/native/cuda_launches.py fills it in. SNARF_NUMBER is
// float or double: NVRTC compiles each source once for either.
#pragma once

#include "snarf/grid.h"
#include "snarf/search.h"

// The tests' emulation counts what the threads do; on a GPU this is nothing.
#ifndef SNARF_COUNT
#define SNARF_COUNT(what) ((void)0)
#endif

namespace snarf {
namespace SNARF_ISA {

typedef SNARF_NUMBER Number;

constexpr int kThreads = 128;  // maximum number of threads per block, unless a kernel says otherwise
constexpr int kLists = 5;      // of a complete search, see Entry in parts.cuh

// Twelve numbers that move in 16-byte pieces: a blended transform, or a root with its inverse Jacobian.
template <class S>
struct alignas(16) Twelve {
  S v[12];
};

// A search handles the queries of all poses, and the cells of one group at a time (P poses, C cells of the grid, to bound the
// memory). A query is known by its flat number b N + n, a root by its slot, in which order of time decides.
template <class S>
struct Search {
  // Given.
  const S* points;              // [B, N, 3], posed, metres
  const S* transforms;          // [B, V, 12], 16-byte aligned
  const S* lower;               // [3], canonical position of the first node, metres
  const S* upper;               // [3], and of the last
  const unsigned char* active;  // [all cells], or null
  const S* starts;              // [B, I, 12], posed to canonical, or canonical points [B, N, I, 3], metres (broyden)
  // Cells of the group.
  S* bounds;         // [P, C], Bounds
  S* polynomials;    // [P, C], Polynomial
  int* units;        // [P, C + cuts, 4], Unit: those of the tame cells from the front, of the others from the back
  int* listed;       // [P, 3]: number of each, and of the cuts that were wanted
  unsigned* region;  // [P, 12]: ordered() bounds of the cells' boxes and of the queries: upper, -lower each
  int* entries;      // Entry, in kLists lists: list k is entries[list_begin[k] .. list_begin[k + 1] - 1]
  int* entered;      // [kLists]: number in each list; may exceed its room
  int* stopped;      // [P, blocks of search_cells]: the chunk that found a list full, or -1
  // Queries of the group's poses, sorted into bins.
  int* bin_count;      // [P, bins]
  const int* bin_end;  // [P * bins]: running sum of bin_count
  S* sorted;           // [P * N, 3]
  int* sorted_query;   // [P * N]
  // Roots as they are found: a list for each query, linked by slot + 1, with 0 for its end.
  S* root;          // [slots, 12]: canonical [3], inverse Jacobian [9]
  int* root_order;  // [slots]: cell or start, which sorts the roots of one query
  int* root_next;   // [slots]
  int* staged;      // [1]: roots reported, may exceed `slots`
  int* head;        // [B * N]
  int* kept;        // [B * N]: roots of each query without duplicates
  const int* end;   // [B * N]: running sum of `kept`
  // Results.
  S* canonical;         // [capacity, 3]
  long long* query;     // [capacity]
  S* jacobian_inverse;  // [capacity, 9]
  long long* found;     // [1]: may exceed `capacity`; null if not wanted
  long long count;      // N
  long long queries;    // B N
  long long list_begin[kLists + 1];
  double tolerance, divergence;  // as shares of the grid's longest side
  double same_root;              // as a share of a cell's shortest side
  int nodes[3];                  // W, H, D
  int first_pose, first_cell;    // of the group
  int cells;                     // C
  int bins;                      // most bins of a pose
  int cuts;                      // most cuts of a pose's cells into units
  int level;                     // of the parts that are halved
  int slots, capacity;
  int start_count;  // I
  int starts_are_points;
  int max_steps;
  int exact_jacobian;
  int orientation_preserving;
};

template <class S>
SNARF_HD Grid<S> grid_of(const Search<S>& a) {
  Grid<S> grid;
  for (int i = 0; i < 3; ++i) {
    grid.lower[i] = a.lower[i];
    grid.size[i] = (a.upper[i] - a.lower[i]) / S(a.nodes[i] - 1);
    grid.nodes[i] = a.nodes[i];
  }
  return grid;
}

template <class S>
SNARF_HD S longest_side(const Search<S>& a) {
  return larger(a.upper[0] - a.lower[0], larger(a.upper[1] - a.lower[1], a.upper[2] - a.lower[2]));
}

template <class S>
SNARF_HD S same_root_distance(const Search<S>& a, const Grid<S>& grid) {
  return S(a.same_root) * smaller(grid.size[0], smaller(grid.size[1], grid.size[2]));
}

template <class S>
SNARF_HD bool is_finite(const S* p) {
  return p[0] - p[0] == 0 && p[1] - p[1] == 0 && p[2] - p[2] == 0;
}

template <class S>
SNARF_HD S squared_distance(const S* p, const S* q) {
  S sum = 0;
  for (int i = 0; i < 3; ++i) sum += (p[i] - q[i]) * (p[i] - q[i]);
  return sum;
}

template <class S>
SNARF_HD bool preserves_orientation(const S* inverse) {
  S minors[9];
  return adjugate(inverse, minors) > 0;
}

// Puts a root on its query's list. Which slot it gets is a matter of time; collect_roots() sorts that out. Roots for which
// there is no slot are only counted.
template <class S>
__device__ __forceinline__ void report_root(const Search<S>& a, int query, int order, const S* canonical, const S* inverse) {
  int slot = atomicAdd(a.staged, 1);
  if (slot >= a.slots) return;
  Twelve<S> root;
  for (int i = 0; i < 3; ++i) root.v[i] = canonical[i];
  for (int i = 0; i < 9; ++i) root.v[3 + i] = inverse[i];
  ((Twelve<S>*)a.root)[slot] = root;
  a.root_order[slot] = order;
  a.root_next[slot] = atomicExch(a.head + query, slot + 1);
}

}  // namespace SNARF_ISA
}  // namespace snarf
