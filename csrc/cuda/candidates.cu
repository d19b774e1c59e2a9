// The complete search, second of three parts: the candidates of the cells are tested.
//
// DESIGN. A candidate is a query in a bin that a cell's posed box touches. One block is one warp, so that barriers cost little
// and a block is a small share of the whole. blockIdx.y: the pose.
//   search_cells  A block takes chunks of up to as many tame units and eighths of curved ones as it has threads: fewer where
//                 others would have nothing to do. One thread reads the bounds of one; for an eighth it halves the cell's
//                 polynomial first. Then the rows of bins that the boxes touch are dealt out to the threads evenly, and so are
//                 the queries in those rows, whichever boxes they belong to. Candidates that pass queue in shared memory until
//                 there is one for each thread; then they are put on the lists of parts.cu. A block that finds a list full
//                 stops and leaves a note.
//   search_rest   The same for what is left by such notes, but the thread that finds an entry searches it at once, depth first.
//                 This is slow, and is there so that lists of a fixed length lose no root. Entries that the block had put on a
//                 list are found a second time; gather.cu drops their roots.
#include "bins.cuh"
#include "parts.cuh"

namespace snarf {
namespace SNARF_ISA {

constexpr int kCellThreads = 32;                       // maximum number of threads per block
constexpr int kBlocks = sizeof(Number) == 4 ? 20 : 8;  // on a multiprocessor, at least: 96 registers, no spill in float32

// What the threads of a block search: a unit of a tame cell each, or an eighth of one of a curved cell.
template <class S>
struct Chunk {
  Bounds<S> bounds[kCellThreads];
  int record[kCellThreads], level[kCellThreads], eighth[kCellThreads];  // as in Entry
  int slice[kCellThreads], slices[kCellThreads];
  Rows<kCellThreads> rows;
};

// How the items of a pose are dealt out: first the tame units, then the eighths of the curved ones.
struct Shares {
  long long tame, items, chunks;
};

// As few chunks as possible, and the same number for each block: reading the items of a chunk costs as much as testing several
// hundred candidates, whether one thread of the warp reads or all.
template <class S>
__device__ Shares shares_of(const Search<S>& a) {
  const int* listed = a.listed + 3 * blockIdx.y;
  const long long items = listed[0] + 8ll * listed[1], blocks = gridDim.x, threads = blockDim.x;
  const long long turns = (items + blocks * threads - 1) / (blocks * threads);
  const long long at_once = turns ? (items + turns * blocks - 1) / (turns * blocks) : 1;
  return {listed[0], items, (items + at_once - 1) / at_once};
}

// Reads this thread's item of a chunk, if it has one. All threads call it; returns the number of rows of bins that the items
// touch. They are dealt out like cards: neighbours, which are equally crowded, go to different chunks, and each chunk gets its
// share of both kinds.
template <class S>
__device__ __forceinline__ long long read_item(const Search<S>& a, const Bins<S>& bins, const Shares& shares, long long number,
                                               Chunk<S>& chunk) {
  const int pose = blockIdx.y, t = threadIdx.x;
  const long long item = t * shares.chunks + number, most = a.cells + a.cuts;
  const bool is_item = item < shares.items;
  if (is_item) {
    const Unit* list = (const Unit*)a.units + most * pose;
    const int level = item >= shares.tame, eighth = level ? int((item - shares.tame) % 8) : 0;
    const Unit unit = list[level ? most - 1 - (item - shares.tame) / 8 : item];
    const int record = pose * a.cells + unit.cell;
    Bounds<S> bounds;
    if (level) {
      Cell<S> part;
      make_part(a, Entry{0, record, level, eighth}, part);
      measure(part, level, bounds);
    } else {
      bounds = ((const Bounds<S>*)a.bounds)[record];
    }
    chunk.bounds[t] = bounds;
    chunk.record[t] = record;
    chunk.level[t] = level;
    chunk.eighth[t] = eighth;
    chunk.slice[t] = unit.slice;
    chunk.slices[t] = unit.slices;
  }
  return enter_box(bins, is_item, chunk.bounds[t].centre, chunk.bounds[t].box, chunk.rows);
}

// The entry of a candidate that passed: the query at `place` among the sorted ones, and a thread's item.
template <class S>
__device__ __forceinline__ Entry entry_of(const Search<S>& a, const Chunk<S>& chunk, int place, int item) {
  return {a.sorted_query[place], chunk.record[item], chunk.level[item], chunk.eighth[item]};
}

// The queue of candidates that passed the test: fewer than two for each thread.
struct Queue {
  int place[2 * kCellThreads], item[2 * kCellThreads];  // among the sorted queries; thread whose item may hold it
  int waiting;
};

// Puts the last `taken` of the queue on the lists. Returns false, for all threads alike, if one of them had no room.
template <class S>
__device__ __forceinline__ bool enter_queued(const Search<S>& a, const Chunk<S>& chunk, const Queue& queue, int taken) {
  Entry entry = {0, 0, 0, 0};
  int list = -1;
  if ((int)threadIdx.x < taken) {
    const int at = queue.waiting - taken + threadIdx.x, item = queue.item[at];
    entry = entry_of(a, chunk, queue.place[at], item);
    list = list_of(chunk.bounds[item], 1);
  }
  return !__syncthreads_or(!enter(a, list, entry));
}

// Tests the candidates of a chunk and returns true; or stops and returns false when a list is full. kAlone: the thread that
// finds an entry searches it at once instead.
template <class S, bool kAlone>
__device__ __forceinline__ bool search_chunk(const Search<S>& a, const Bins<S>& bins, const Shares& shares, long long number) {
  __shared__ Chunk<S> chunk;
  __shared__ int range_begin[kCellThreads], range_item[kCellThreads];  // queries in one row of bins
  __shared__ long long query_sums[kCellThreads];
  __shared__ Queue queue;

  const int t = threadIdx.x, threads = blockDim.x;
  __syncthreads();  // the block may still be at its last chunk
  if (t == 0) queue.waiting = 0;
  const long long all_rows = read_item(a, bins, shares, number, chunk);
  for (long long first_row = 0; first_row < all_rows; first_row += threads) {
    int in_row = 0;
    if (first_row + t < all_rows) {
      const Row row = row_of(bins, chunk.rows, first_row + t, a.bin_end, (long long)blockIdx.y * a.bins);
      const long long all = row.end - row.begin;
      const int slice = chunk.slice[row.owner], slices = chunk.slices[row.owner];
      range_item[t] = row.owner;
      range_begin[t] = row.begin + int(all * slice / slices);
      in_row = row.begin + int(all * (slice + 1) / slices) - range_begin[t];
    }
    const long long all_queries = sum_over_block(in_row, query_sums);
    for (long long first_query = 0; first_query < all_queries; first_query += threads) {
      SNARF_COUNT(rounds);
      long long nth = first_query + t;
      if (nth < all_queries) {
        const int range = owner_of(query_sums, nth), owner = range_item[range], place = range_begin[range] + int(nth);
        if (holds(chunk.bounds[owner], a.sorted + 3 * (long long)place)) {
          if (kAlone) {
            search_below(a, list_of(chunk.bounds[owner], 1), entry_of(a, chunk, place, owner));
          } else {
            const int at = atomicAdd(&queue.waiting, 1);
            queue.place[at] = place;
            queue.item[at] = owner;
          }
        }
      }
      __syncthreads();
      const int waiting = queue.waiting;  // fewer than one for each thread was left over, and at most one came
      __syncthreads();
      if (waiting < threads) continue;
      if (!enter_queued(a, chunk, queue, threads)) return false;
      if (t == 0) queue.waiting = waiting - threads;
      __syncthreads();
    }
  }
  __syncthreads();
  return enter_queued(a, chunk, queue, queue.waiting);
}

// Searches the chunks that are this block's, from the `first` on. Returns the number of the chunk that it stopped at, or -1.
template <class S, bool kAlone>
__device__ __forceinline__ long long search_chunks(const Search<S>& a, long long first) {
  __shared__ Bins<S> bins;
  const Shares shares = shares_of(a);
  if (first >= shares.chunks) return -1;
  if (threadIdx.x == 0) lay_out(a.region + 12 * blockIdx.y, a.bins, bins);
  __syncthreads();
  for (long long number = first; number < shares.chunks; number += gridDim.x)
    if (!search_chunk<S, kAlone>(a, bins, shares, number)) return number;
  return -1;
}

extern "C" __global__ void __launch_bounds__(kCellThreads, kBlocks) search_cells(const Search<Number> a) {
  const long long stopped = search_chunks<Number, false>(a, blockIdx.x);
  if (threadIdx.x == 0) a.stopped[(long long)gridDim.x * blockIdx.y + blockIdx.x] = int(stopped);
}

// Usually has nothing to do.
extern "C" __global__ void __launch_bounds__(kCellThreads) search_rest(const Search<Number> a) {
  const int stopped = a.stopped[(long long)gridDim.x * blockIdx.y + blockIdx.x];
  if (stopped >= 0) search_chunks<Number, true>(a, stopped);
}

}  // namespace SNARF_ISA
}  // namespace snarf
