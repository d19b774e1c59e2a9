// The complete search, which finds every root of d(x) = x' in every active cell; first of three parts: cells and queries are
// made ready.
//
// DESIGN. Cell by cell, as on the CPU (csrc/cpu/kernels.cpp). Each kernel runs once for a group of poses; blockIdx.y: the pose.
//   survey         One thread turns one cell into its polynomial and bounds (cell.h) and writes them down apart: the test of a
//                  query reads the bounds (80 bytes in float32), only halving and solving read the polynomial (240). Further
//                  blocks read the queries. Both leave the bounds of what they saw, by atomics on integers ordered like the
//                  floats.
//   count_queries  One thread a query: counting sort into uniform bins over the region that both bounds share, x fastest, so
//   place_queries  that a run of bins along x is one contiguous range. Between the two stands a running sum. Further blocks of
//                  place_queries count the candidates of cells, one cell a thread with its rows of bins dealt out evenly, and
//                  cut what has too many into units of about equal load: cells differ a thousandfold.
// Then candidates.cu tests the candidates and parts.cu solves what passed. Which bin, block or thread meets a pair of query and
// cell does not change what it computes, so the set of roots depends on nothing but the query and the pose; gather.cu puts it
// in order. No kernel needs a certain block size, up to the limits in the sources, and none waits for the host.
// Limits: B N, the cells of the grid and the roots below 2^31. Points and boxes beyond 1e30 metres have no roots.
#include "bins.cuh"
#include "parts.cuh"

namespace snarf {
namespace SNARF_ISA {

constexpr int kCandidates = 256;  // maximum number in a unit, at most, as long as there is room for more units

// ------------------------------------------------------------------------------------------------ cells
template <class S>
__device__ void read_cell(const Search<S>& a, const Grid<S>& grid, int cell, Cell<S>& polynomial) {
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
  cell_from_corners(corner, centre, grid.size, polynomial);
}

// Non-finite or absurd transforms give no root.
template <class S>
__device__ bool is_usable(const Bounds<S>& bounds) {
  bool usable = true;
  for (int i = 0; i < 3; ++i) usable = usable && bounds.box[i] < S(1e15) && bounds.centre[i] - bounds.centre[i] == 0;
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
    if (n < a.cells) {
      const long long record = (long long)pose * a.cells + n;
      Bounds<Number> bounds;
      bool searched = !a.active || a.active[a.first_cell + n];
      if (searched) {
        Polynomial<Number> polynomial;
        read_cell(a, grid_of(a), a.first_cell + n, polynomial.cell);
        measure(polynomial.cell, 0, bounds);
        searched = is_usable(bounds);
        if (searched) {
          ((Polynomial<Number>*)a.polynomials)[record] = polynomial;
          ((Bounds<Number>*)a.bounds)[record] = bounds;
          for (int i = 0; i < 3; ++i) widen(region, i, bounds.centre[i] - bounds.box[i], bounds.centre[i] + bounds.box[i]);
        }
      }
      if (!searched) ((Bounds<Number>*)a.bounds)[record].box[0] = -1;
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

// ------------------------------------------------------------------------------------------------ queries and units
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
template <class S>
__device__ void place_query(const Search<S>& a, const Bins<S>& bins, long long n) {
  const int pose = blockIdx.y;
  const long long query = a.count * (a.first_pose + pose) + n;
  const S* p = a.points + 3 * query;
  const int bin = bin_of(bins, p);
  if (bin < 0) return;
  const long long entry = (long long)pose * a.bins + bin;
  const long long place = a.bin_end[entry] - atomicSub(a.bin_count + entry, 1);
  for (int i = 0; i < 3; ++i) a.sorted[3 * place + i] = p[i];
  a.sorted_query[place] = int(query);
}

// Counts the candidates of as many cells as the block has threads, from the `first` on, and lists their units. A cell without
// any is left out.
template <class S>
__device__ __forceinline__ void list_units(const Search<S>& a, const Bins<S>& bins, long long first) {
  __shared__ Rows<kThreads> rows;
  __shared__ int candidates[kThreads], wanted[2], begin[2];
  const int pose = blockIdx.y, t = threadIdx.x, threads = blockDim.x;
  const int cell = int(first) + t;
  Bounds<S> bounds;
  const Bounds<S>* const record = (const Bounds<S>*)a.bounds + (long long)pose * a.cells + cell;
  const bool is_searched = first + t < a.cells && record->box[0] >= 0;
  if (is_searched) bounds = *record;
  candidates[t] = 0;
  if (t == 0) wanted[0] = wanted[1] = 0;
  const long long all_rows = enter_box(bins, is_searched, bounds.centre, bounds.box, rows);
  for (long long n = t; n < all_rows; n += threads) {
    const Row row = row_of(bins, rows, n, a.bin_end, (long long)pose * a.bins);
    if (row.end > row.begin) atomicAdd(candidates + row.owner, row.end - row.begin);
  }
  __syncthreads();
  int units = 0, mine = 0;
  const int is_curved = is_searched && !is_tame(bounds);
  if (candidates[t]) {
    const int cuts = (candidates[t] - 1) / kCandidates;
    const int taken = cuts ? atomicAdd(a.listed + 3 * pose + 2, cuts) : 0, room = a.cuts - taken;
    units = 1 + (cuts < room ? cuts : room > 0 ? room : 0);
    mine = atomicAdd(wanted + is_curved, units);
  }
  __syncthreads();
  for (int i = t; i < 2; i += threads)
    if (wanted[i]) begin[i] = atomicAdd(a.listed + 3 * pose + i, wanted[i]);
  __syncthreads();
  const long long most = a.cells + a.cuts;
  Unit* list = (Unit*)a.units + most * pose;
  for (int slice = 0; slice < units; ++slice) {
    const long long at = begin[is_curved] + mine + slice;
    list[is_curved ? most - 1 - at : at] = {cell, slice, units, 0};
  }
}

extern "C" __global__ void __launch_bounds__(kThreads) place_queries(const Search<Number> a) {
  __shared__ Bins<Number> bins;
  if (threadIdx.x == 0) lay_out(a.region + 12 * blockIdx.y, a.bins, bins);
  __syncthreads();
  const int cell_blocks = (a.cells + blockDim.x - 1) / blockDim.x;
  if ((int)blockIdx.x < cell_blocks) {
    if (bins.number[0]) list_units(a, bins, (long long)blockIdx.x * blockDim.x);
  } else {
    const long long n = (long long)(blockIdx.x - cell_blocks) * blockDim.x + threadIdx.x;
    if (n < a.count) place_query(a, bins, n);
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
