// The complete search: every root of d(x) = x' in every active cell.
//
// DESIGN. Cell by cell, as on the CPU (csrc/cpu/kernels.cpp). Each kernel runs once for a group of poses; blockIdx.y: the pose.
//   survey         One thread turns one cell into its polynomial and bounds (cell.h) and writes them down, a Record (304 bytes
//                  in float32); tame and curved cells are listed apart. Further blocks read the queries. Both leave the bounds
//                  of what they saw, by atomics on integers ordered like the floats.
//   count_queries  One thread a query: counting sort into uniform bins over the region that both bounds share, x fastest, so
//   place_queries  that a run of bins along x is one contiguous range. Between the two stands a running sum.
//   search_tame    One block takes as many cells as it has threads. The rows of bins that their posed boxes touch are dealt out
//                  to the threads evenly, and so are the queries in those rows, whichever cells they belong to: cells differ a
//                  thousandfold in load. Candidates that pass the cell's test queue in shared memory until there is one for
//                  each thread; then Newton's method runs on full warps, with coefficients from the records.
//   search_curved  The same for the eight parts of each curved cell, halved into shared memory. A part that is still curved is
//                  halved further by the thread that holds the candidate, with a stack in local memory.
// Which bin, block or thread meets a pair of query and cell does not change what it computes, so the set of roots depends on
// nothing but the query and the pose; gather.cu puts it in order. No kernel needs a certain block size, up to the limits below,
// and none waits for the host.
// Limits: B N, the cells of the grid and the roots below 2^31. Points and boxes beyond 1e30 metres have no roots.
#include "search.cuh"
#include "snarf/cell.h"
#include "snarf/newton.h"

namespace snarf {
namespace SNARF_ISA {

constexpr int kThreads = 128;       // maximum number of threads per block
constexpr int kCurvedThreads = 64;  // in search_curved, whose parts fill the shared memory in float64 (39 of 48 KB)
constexpr float kFarthest = 1e30f;  // metres

// A cell or a part of one, ready to be searched. Aligned so that it moves in 16-byte pieces.
template <class S>
struct alignas(16) Record {
  Cell<S> cell;
  CellBounds<S> bounds;
};

// Uniform bins over a box in posed space.
template <class S>
struct Bins {
  S lower[3], upper[3];  // metres
  S per_metre;
  int number[3];  // 0 if nothing lies in the box
};

// ------------------------------------------------------------------------------------------------ bounds and bins
// An unsigned integer that grows with the float; 0 is below all of them. Atomic maxima of floats are made of it.
SNARF_HD unsigned ordered(float value) {
  unsigned bits = __float_as_uint(value);
  return bits >> 31 ? ~bits : bits | 0x80000000u;
}
SNARF_HD float from_ordered(unsigned bits) { return __uint_as_float(bits >> 31 ? bits & 0x7fffffffu : ~bits); }

// The next float upwards or the same.
SNARF_HD float rounded_up(float value) { return value; }
SNARF_HD float rounded_up(double value) {
  if (value > kFarthest) return kFarthest;
  if (value < -kFarthest) return -kFarthest;
  float near = float(value);
  return near < value ? near + absolute(near) * 1.2e-7f + 1e-37f : near;
}

// Widens bounds (upper, -lower) by an interval along one axis.
template <class S>
__device__ void widen(unsigned* bounds, int axis, S lower, S upper) {
  atomicMax(bounds + axis, ordered(rounded_up(upper)));
  atomicMax(bounds + 3 + axis, ordered(rounded_up(-lower)));
}

template <class S>
__device__ int number_of_bins(S extent, S per_metre) {
  return int(extent * per_metre) + 1;
}

// Lays out as many bins as allowed over the region where both cells and queries are, with equal sides.
template <class S>
__device__ void lay_out(const unsigned* region, int most, Bins<S>& bins) {
  S extent[3], longest = 0;
  bool filled = true;
  for (int i = 0; i < 3; ++i) {
    // An entry that nothing was written to decodes to NaN.
    bins.upper[i] = smaller(from_ordered(region[i]), from_ordered(region[6 + i]));
    bins.lower[i] = -smaller(from_ordered(region[3 + i]), from_ordered(region[9 + i]));
    filled = filled && region[i] && region[6 + i] && bins.lower[i] <= bins.upper[i];
    extent[i] = bins.upper[i] - bins.lower[i];
    longest = larger(longest, extent[i]);
  }
  bins.per_metre = 0;
  if (filled && longest > S(1e-30)) {
    int fits = 0, too_many = most + 1;  // bins along the longest side
    while (too_many - fits > 1) {
      int middle = fits + (too_many - fits) / 2;
      S per_metre = S(middle) / longest;
      long long number = 1;
      for (int i = 0; i < 3; ++i) number *= number_of_bins(extent[i], per_metre);
      (number <= most ? fits : too_many) = middle;
    }
    bins.per_metre = S(fits) / longest;
  }
  for (int i = 0; i < 3; ++i) bins.number[i] = filled ? number_of_bins(extent[i], bins.per_metre) : 0;
}

// Grows with the position, so that a query inside a box never lies outside the box's bins.
template <class S>
__device__ int bin_along(const Bins<S>& bins, int axis, S position) {
  S at = (position - bins.lower[axis]) * bins.per_metre;
  return at > 0 ? (at < S(bins.number[axis]) ? int(at) : bins.number[axis] - 1) : 0;
}

// The bin of a query, or -1 if the query is not in the region.
template <class S>
__device__ int bin_of(const Bins<S>& bins, const S* p) {
  if (!bins.number[0]) return -1;
  int at[3];
  for (int i = 0; i < 3; ++i) {
    if (!(p[i] >= bins.lower[i] && p[i] <= bins.upper[i])) return -1;
    at[i] = bin_along(bins, i, p[i]);
  }
  return (at[2] * bins.number[1] + at[1]) * bins.number[0] + at[0];
}

// ------------------------------------------------------------------------------------------------ cells
template <class S>
__device__ void centre_of(const Grid<S>& grid, int cell, S* centre) {
  const int x = cell % (grid.nodes[0] - 1), rest = cell / (grid.nodes[0] - 1);
  const int index[3] = {x, rest % (grid.nodes[1] - 1), rest / (grid.nodes[1] - 1)};
  for (int i = 0; i < 3; ++i) centre[i] = grid.lower[i] + (S(index[i]) + S(0.5)) * grid.size[i];
}

template <class S>
__device__ void record_cell(const Search<S>& a, const Grid<S>& grid, int cell, Record<S>& record) {
  const int x = cell % (grid.nodes[0] - 1), rest = cell / (grid.nodes[0] - 1);
  const int y = rest % (grid.nodes[1] - 1), z = rest / (grid.nodes[1] - 1);
  const long long first = ((long long)z * grid.nodes[1] + y) * grid.nodes[0] + x;
  const long long nodes = (long long)grid.nodes[0] * grid.nodes[1] * grid.nodes[2];
  const Twelve<S>* transforms = (const Twelve<S>*)(a.transforms + 12 * nodes * (a.first_pose + (int)blockIdx.y));
  S corner[8 * 12], centre[3];
  for (int k = 0; k < 8; ++k) {
    const Twelve<S> transform = transforms[corner_node(grid, first, k)];
    for (int r = 0; r < 12; ++r) corner[12 * k + r] = transform.v[r];
  }
  centre_of(grid, cell, centre);
  cell_from_corners(corner, centre, grid.size, record.cell);
  bound_cell<S, S>(record.cell, record.bounds);
}

// Non-finite or absurd transforms give no root.
template <class S>
__device__ bool is_usable(const Record<S>& record) {
  bool usable = true;
  for (int i = 0; i < 3; ++i) {
    const S centre = record.cell.c[kMonomials * i];
    usable = usable && record.bounds.box[i] < S(1e15) && centre - centre == 0;
  }
  return usable;
}

extern "C" __global__ void __launch_bounds__(kThreads) survey(const Search<Number> a) {
  __shared__ unsigned region[12];
  const int pose = blockIdx.y, threads = blockDim.x;
  for (int i = threadIdx.x; i < 12; i += threads) region[i] = 0;
  __syncthreads();
  const int cell_blocks = (a.cells + threads - 1) / threads;
  if ((int)blockIdx.x < cell_blocks) {
    const int n = blockIdx.x * threads + threadIdx.x;
    if (n < a.cells && (!a.active || a.active[a.first_cell + n])) {
      Record<Number> record;
      record_cell(a, grid_of(a), a.first_cell + n, record);
      if (is_usable(record)) {
        const bool is_curved = !(record.bounds.curvature < Number(kTame));
        const int place = atomicAdd(a.listed + 2 * pose + is_curved, 1);
        a.list[(long long)pose * a.cells + (is_curved ? a.cells - 1 - place : place)] = n;
        ((Record<Number>*)a.records)[(long long)pose * a.cells + n] = record;
        for (int i = 0; i < 3; ++i) {
          const Number centre = record.cell.c[kMonomials * i], extent = record.bounds.box[i];
          widen(region, i, centre - extent, centre + extent);
        }
      }
    }
  } else {
    const Number* points = a.points + 3 * a.count * (a.first_pose + pose);
    const long long step = (long long)(gridDim.x - cell_blocks) * threads;
    Number lower[3], upper[3];
    bool any_query = false;
    for (long long n = (long long)(blockIdx.x - cell_blocks) * threads + threadIdx.x; n < a.count; n += step) {
      if (!is_finite(points + 3 * n)) continue;
      for (int i = 0; i < 3; ++i) {
        lower[i] = any_query ? smaller(lower[i], points[3 * n + i]) : points[3 * n + i];
        upper[i] = any_query ? larger(upper[i], points[3 * n + i]) : points[3 * n + i];
      }
      any_query = true;
    }
    if (any_query)
      for (int i = 0; i < 3; ++i) widen(region + 6, i, lower[i], upper[i]);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < 12; i += threads)
    if (region[i]) atomicMax(a.region + 12 * pose + i, region[i]);
}

// ------------------------------------------------------------------------------------------------ queries
extern "C" __global__ void __launch_bounds__(kThreads) count_queries(const Search<Number> a) {
  __shared__ Bins<Number> bins;
  const int pose = blockIdx.y;
  if (threadIdx.x == 0) lay_out(a.region + 12 * pose, a.bins, bins);
  __syncthreads();
  const long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (n >= a.count) return;
  const int bin = bin_of(bins, a.points + 3 * (a.count * (a.first_pose + pose) + n));
  if (bin >= 0) atomicAdd(a.bin_count + (long long)pose * a.bins + bin, 1);
}

// Fills each bin from its end; the counts run down to zero.
extern "C" __global__ void __launch_bounds__(kThreads) place_queries(const Search<Number> a) {
  __shared__ Bins<Number> bins;
  const int pose = blockIdx.y;
  if (threadIdx.x == 0) lay_out(a.region + 12 * pose, a.bins, bins);
  __syncthreads();
  const long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (n >= a.count) return;
  const long long query = a.count * (a.first_pose + pose) + n;
  const Number* p = a.points + 3 * query;
  const int bin = bin_of(bins, p);
  if (bin < 0) return;
  const long long entry = (long long)pose * a.bins + bin;
  const long long place = a.bin_end[entry] - atomicSub(a.bin_count + entry, 1);
  for (int i = 0; i < 3; ++i) a.sorted[3 * place + i] = p[i];
  a.sorted_query[place] = int(query);
}

// ------------------------------------------------------------------------------------------------ solving
// A query and the cell, or part of a cell, that may hold a root of it.
template <class S>
struct Pair {
  int query, cell;
  S target[3];       // the query, posed, metres
  S cell_centre[3];  // canonical, metres
};

// Newton's method from one start in a part with side `scale` around `shift` (cell coordinates). Writes the canonical root and
// the inverse of dd/dx there; returns whether there is one. The same arithmetic as on the CPU.
template <class S>
__device__ __forceinline__ bool solve(const Search<S>& a, const Grid<S>& grid, const Pair<S>& pair, const Record<S>& part,
                                      const S* shift, S scale, int start, S* canonical, S* inverse) {
  const Solver<S> solver = {S(a.tolerance) * longest_side(a), a.max_steps};
  S c[3 * kMonomials], offset[3], s[3];
  for (int m = 0; m < 3 * kMonomials; ++m) c[m] = part.cell.c[m];
  for (int i = 0; i < 3; ++i) offset[i] = pair.target[i] - c[kMonomials * i];
  for (int i = 0; i < 3; ++i) {
    const S* row = part.bounds.inverse + 3 * i;
    const S guess = row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2];
    const S corner = start >> i & 1 ? S(0.5) : S(-0.5);
    s[i] = start == kAffineStart ? smaller(larger(guess, S(-0.5)), S(0.5)) : start == kCentreStart ? S(0) : corner;
  }
  for (int i = 0; i < 9; ++i) inverse[i] = 0;
  if (!solve_in_cell(c, offset, true, solver, S(0.5) + face_tolerance<S>() / scale, s, inverse)) return false;
  for (int i = 0; i < 3; ++i) {
    canonical[i] = pair.cell_centre[i] + grid.size[i] * (shift[i] + scale * s[i]);
    for (int j = 0; j < 3; ++j) inverse[3 * i + j] *= grid.size[i] * scale;
  }
  return !a.orientation_preserving || preserves_orientation(inverse);
}

template <class S>
__device__ bool holds(const Record<S>& part, const S* target) {
  S offset[3];
  for (int i = 0; i < 3; ++i) offset[i] = target[i] - part.cell.c[kMonomials * i];
  return may_hold(part.bounds.box, part.bounds.inverse, part.bounds.reach, offset);
}

template <class S>
__device__ void solve_tame(const Search<S>& a, const Grid<S>& grid, const Pair<S>& pair, const Record<S>& record) {
  const Record<S> cell = record;  // as a whole, in wide loads
  const S shift[3] = {0, 0, 0};
  S canonical[3], inverse[9];
  if (solve(a, grid, pair, cell, shift, S(1), kAffineStart, canonical, inverse))
    report_root(a, pair.query, pair.cell, canonical, inverse);
}

template <class S>
__device__ void eighth(int k, S* shift) {
  for (int i = 0; i < 3; ++i) shift[i] = k >> i & 1 ? S(0.25) : S(-0.25);
}

// `level` is that of the part: a root may lie as far beyond its faces as beyond those of the cell.
template <class S>
__device__ void halve(const Cell<S>& whole, int k, int level, Record<S>& part) {
  S shift[3];
  eighth(k, shift);
  halve_cell<S, S>(whole, shift, part.cell);
  bound_cell<S, S>(part.cell, part.bounds, S(0.5) + face_tolerance<S>() * S(1 << level));
}

// The roots in eighth k of a cell, of which `first` is the record: depth first through its parts, down to tame ones or to the
// last level, where several starts are tried. What several starts or neighbouring parts report is only counted once here
// already, so that few slots are needed.
template <class S>
__device__ void solve_curved(const Search<S>& a, const Grid<S>& grid, const Pair<S>& pair, const Record<S>& first, int k) {
  constexpr int kSeen = 8;
  Cell<S> split[kLevels];    // the parts on the way down, by level; level 0, the cell, is not needed
  S centre[kLevels + 1][3];  // their centres, cell coordinates
  int following[kLevels];    // the next eighth of each
  S seen[kSeen][3], canonical[3], inverse[9];
  bool preserved[kSeen];
  int roots = 0, level = 1;
  const S distance = same_root_distance(a, grid);
  Record<S> part = first;
  eighth(k, centre[1]);
  for (int deepest = 0;;) {  // level of the deepest part that is being split
    const bool is_tame = part.bounds.curvature < S(kTame);
    if (is_tame || level == kLevels) {
      const S scale = S(1) / S(1 << level);
      for (int start = is_tame ? kAffineStart : 0; start < kStarts; ++start) {
        if (!solve(a, grid, pair, part, centre[level], scale, start, canonical, inverse)) continue;
        const bool preserves = preserves_orientation(inverse);
        bool is_new = true;
        for (int r = 0; r < roots && r < kSeen; ++r)
          if (preserved[r] == preserves && squared_distance(seen[r], canonical) < distance * distance) is_new = false;
        if (!is_new) continue;
        if (roots < kSeen) {
          for (int i = 0; i < 3; ++i) seen[roots][i] = canonical[i];
          preserved[roots++] = preserves;
        }
        report_root(a, pair.query, pair.cell, canonical, inverse);
      }
    } else {
      deepest = level;
      split[deepest] = part.cell;
      following[deepest] = 0;
    }
    do {  // on to the next part that may hold the query
      while (deepest > 0 && following[deepest] == 8) --deepest;
      if (deepest == 0) return;
      S shift[3];
      eighth(following[deepest], shift);
      level = deepest + 1;
      halve(split[deepest], following[deepest]++, level, part);
      for (int i = 0; i < 3; ++i) centre[level][i] = centre[deepest][i] + shift[i] / S(1 << deepest);
    } while (!holds(part, pair.target));
  }
}

// ------------------------------------------------------------------------------------------------ searching
// Running sums over the block: sums[t] becomes that of the values of the threads 0 .. t. Returns the total.
__device__ __forceinline__ long long sum_over_block(long long value, long long* sums) {
  const int t = threadIdx.x, threads = blockDim.x;
  __syncthreads();  // all threads have read the last sums
  sums[t] = value;
  for (int step = 1; step < threads; step *= 2) {
    __syncthreads();
    const long long before = t >= step ? sums[t - step] : 0;
    __syncthreads();
    sums[t] += before;
  }
  __syncthreads();
  return sums[threads - 1];
}

// Whose share the n-th item is: the first thread whose running sum exceeds n. `n` becomes its number within that share.
__device__ __forceinline__ int owner_of(const long long* sums, long long& n) {
  int first = 0, last = blockDim.x - 1;
  while (first < last) {
    const int middle = (first + last) / 2;
    if (sums[middle] > n)
      last = middle;
    else
      first = middle + 1;
  }
  if (first) n -= sums[first - 1];
  return first;
}

// Searches the items of one chunk: as many as the block has threads. kCurved: an item is an eighth of a curved cell, otherwise
// a tame cell. kMost: maximum number of threads per block.
template <class S, bool kCurved, int kMost>
__device__ __forceinline__ void search_chunk(const Search<S>& a, const Grid<S>& grid, const Bins<S>& bins, long long chunk,
                                             long long chunks, long long items) {
  __shared__ Record<S> parts[kCurved ? kMost : 1];
  __shared__ int item_cell[kMost];                                                        // number in the group
  __shared__ int low_x[kMost], high_x[kMost], low_y[kMost], low_z[kMost], size_y[kMost];  // bins that the item's box touches
  __shared__ int range_begin[kMost], range_item[kMost];                                   // queries in one row of bins
  __shared__ long long row_sums[kMost], query_sums[kMost];
  __shared__ int queued_place[2 * kMost], queued_item[2 * kMost], queued;

  const int pose = blockIdx.y, t = threadIdx.x, threads = blockDim.x;
  const int* list = a.list + (long long)pose * a.cells;
  const Record<S>* records = (const Record<S>*)a.records + (long long)pose * a.cells;
  // Tame cells are dealt out like cards: neighbours, which are equally crowded, go to different chunks. The eighths of a curved
  // cell stay side by side.
  const long long item = kCurved ? chunk * threads + t : t * chunks + chunk;
  long long rows = 0;
  __syncthreads();  // the block may still be at its last chunk
  if (t == 0) queued = 0;
  if (item < items) {
    item_cell[t] = kCurved ? list[a.cells - 1 - item / 8] : list[item];
    if (kCurved) halve(records[item_cell[t]].cell, int(item % 8), 1, parts[t]);
    const Record<S>& record = kCurved ? parts[t] : records[item_cell[t]];
    int low[3], high[3];
    bool touched = true;
    for (int i = 0; i < 3; ++i) {
      const S centre = record.cell.c[kMonomials * i], extent = record.bounds.box[i];
      touched = touched && centre + extent >= bins.lower[i] && centre - extent <= bins.upper[i];
      low[i] = bin_along(bins, i, centre - extent);
      high[i] = bin_along(bins, i, centre + extent);
    }
    low_x[t] = low[0];
    high_x[t] = high[0];
    low_y[t] = low[1];
    low_z[t] = low[2];
    size_y[t] = high[1] - low[1] + 1;
    if (touched) rows = (long long)size_y[t] * (high[2] - low[2] + 1);
  }

  const long long all_rows = sum_over_block(rows, row_sums);
  for (long long first_row = 0;; first_row += threads) {
    const bool is_over = first_row >= all_rows;  // only what still queues is left to do
    int in_row = 0;
    long long nth = first_row + t;
    if (nth < all_rows) {
      const int owner = owner_of(row_sums, nth);
      const int y = low_y[owner] + int(nth % size_y[owner]), z = low_z[owner] + int(nth / size_y[owner]);
      const long long row = (long long)pose * a.bins + ((long long)z * bins.number[1] + y) * bins.number[0];
      const long long first_bin = row + low_x[owner];
      range_item[t] = owner;
      range_begin[t] = first_bin ? a.bin_end[first_bin - 1] : 0;
      in_row = a.bin_end[row + high_x[owner]] - range_begin[t];
    }
    const long long all_queries = sum_over_block(in_row, query_sums);
    for (long long first_query = 0; first_query < all_queries || is_over; first_query += threads) {
      nth = first_query + t;
      if (nth < all_queries) {
        const int range = owner_of(query_sums, nth), owner = range_item[range], place = range_begin[range] + int(nth);
        if (holds(kCurved ? parts[owner] : records[item_cell[owner]], a.sorted + 3 * (long long)place)) {
          const int at = atomicAdd(&queued, 1);
          queued_place[at] = place;
          queued_item[at] = owner;
        }
      }
      __syncthreads();
      const int waiting = queued;  // fewer than two for each thread: fewer than one was left over, and at most one came
      __syncthreads();
      if (waiting < threads && !is_over) continue;
      const int solved = waiting < threads ? waiting : threads;
      if (t < solved) {
        const int at = waiting - solved + t, place = queued_place[at], owner = queued_item[at];
        Pair<S> pair;
        pair.query = a.sorted_query[place];
        pair.cell = a.first_cell + item_cell[owner];
        for (int i = 0; i < 3; ++i) pair.target[i] = a.sorted[3 * (long long)place + i];
        centre_of(grid, pair.cell, pair.cell_centre);
        if (kCurved)
          solve_curved(a, grid, pair, parts[owner], int((chunk * threads + owner) % 8));
        else
          solve_tame(a, grid, pair, records[item_cell[owner]]);
      }
      if (is_over) return;
      if (t == 0) queued = waiting - threads;
      __syncthreads();
    }
  }
}

// Searches all items of a pose, chunk by chunk; their number is known on the device only.
template <class S, bool kCurved, int kMost>
__device__ __forceinline__ void search_items(const Search<S>& a) {
  __shared__ Bins<S> bins;
  const int listed = a.listed[2 * blockIdx.y + kCurved];
  const long long items = kCurved ? 8ll * listed : listed, chunks = (items + blockDim.x - 1) / blockDim.x;
  if (blockIdx.x >= chunks) return;
  if (threadIdx.x == 0) lay_out(a.region + 12 * blockIdx.y, a.bins, bins);
  __syncthreads();
  if (!bins.number[0]) return;
  const Grid<S> grid = grid_of(a);
  for (long long chunk = blockIdx.x; chunk < chunks; chunk += gridDim.x)
    search_chunk<S, kCurved, kMost>(a, grid, bins, chunk, chunks, items);
}

// At least four blocks on a multiprocessor: 127 registers per thread in float32 without a spill.
extern "C" __global__ void __launch_bounds__(kThreads, sizeof(Number) == 4 ? 4 : 2) search_tame(const Search<Number> a) {
  search_items<Number, false, kThreads>(a);
}

extern "C" __global__ void __launch_bounds__(kCurvedThreads) search_curved(const Search<Number> a) {
  search_items<Number, true, kCurvedThreads>(a);
}

}  // namespace SNARF_ISA
}  // namespace snarf
