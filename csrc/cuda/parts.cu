// The complete search, last of three parts: the curved parts of cells, level by level, and the roots.
//
// DESIGN. candidates.cu leaves lists of entries: a query and the cell, or the eighth of a cell, that may hold a root of it.
//   halve_parts  One thread takes one eighth of one entry of a level: halves the cell's polynomial down to it (at most four
//                times), bounds it, and where it may hold the query puts it on the list of tame parts or on that of the next
//                level. Runs once for each level, over the entries of all poses of the group.
//   solve_parts  One thread takes one entry of a tame cell or part: Newton's method from one start. Of the parts that are still
//                curved at the last level, one thread takes one start; what several starts report is dropped in shared memory.
// All threads of a launch do about the same amount of work, for any poses and queries. Which thread takes which entry may vary
// between runs; what it computes does not. Only what a list has no room for is searched depth first by the
// thread that found it.
#include "parts.cuh"

namespace snarf {
namespace SNARF_ISA {

// Blocks on a multiprocessor, at least: in float32 with 168 and 128 registers per thread, without a spill.
constexpr int kHalvingBlocks = sizeof(Number) == 4 ? 3 : 2, kSolvingBlocks = sizeof(Number) == 4 ? 4 : 2;

extern "C" __global__ void __launch_bounds__(kThreads, kHalvingBlocks) halve_parts(const Search<Number> a) {
  const Entry* entries = (const Entry*)a.entries + a.list_begin[a.level];
  const long long items = 8ll * length_of(a, a.level);
  const long long step = (long long)gridDim.x * blockDim.x;
  for (long long first = (long long)blockIdx.x * blockDim.x; first < items; first += step) {
    const long long item = first + threadIdx.x;
    Entry entry;
    int list = -1;
    if (item < items) {
      SNARF_COUNT(rounds);
      entry = entries[item / 8];
      entry.path = 8 * entry.path + int(item % 8);
      ++entry.level;
      Cell<Number> part;
      Bounds<Number> bounds;
      make_part(a, entry, part);
      measure(part, entry.level, bounds);
      if (holds(bounds, a.points + 3 * (long long)entry.query)) list = list_of(bounds, entry.level);
    }
    if (!enter(a, list, entry)) search_below(a, list, entry);
  }
}

// Solves a list of parts from several starts: as many parts at a time as the block has threads for.
template <class S>
__device__ __forceinline__ void solve_from_all_starts(const Search<S>& a) {
  constexpr int kParts = kThreads / kStarts;
  __shared__ Twelve<S> roots[kParts * kStarts];
  __shared__ bool found[kParts * kStarts];
  const Entry* entries = (const Entry*)a.entries + a.list_begin[kLevels];
  const int length = length_of(a, kLevels), t = threadIdx.x, threads = blockDim.x;
  const int at_once = threads < kStarts ? 1 : threads / kStarts;
  for (long long first = (long long)blockIdx.x * at_once; first < length; first += (long long)gridDim.x * at_once) {
    const int parts = length - first < at_once ? int(length - first) : at_once;
    for (int item = t; item < parts * kStarts; item += threads) {
      const Entry entry = entries[first + item / kStarts];
      Cell<S> part;
      make_part(a, entry, part);
      Twelve<S> root;
      found[item] = solve(a, entry, part, item % kStarts, root);
      roots[item] = root;
    }
    __syncthreads();
    for (int n = t; n < parts; n += threads) report_once(a, entries[first + n], roots + kStarts * n, found + kStarts * n);
    __syncthreads();
  }
}

extern "C" __global__ void __launch_bounds__(kThreads, kSolvingBlocks) solve_parts(const Search<Number> a) {
  solve_from_all_starts(a);
  const Entry* entries = (const Entry*)a.entries + a.list_begin[0];
  const int length = length_of(a, 0);
  const long long step = (long long)gridDim.x * blockDim.x;
  for (long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x; n < length; n += step) {
    SNARF_COUNT(rounds);
    const Entry entry = entries[n];
    Cell<Number> part;
    Twelve<Number> root;
    make_part(a, entry, part);
    if (solve(a, entry, part, kAffineStart, root)) report(a, entry, root);
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
