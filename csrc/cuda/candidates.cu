// The complete search, second of three parts: the candidates of the cells are tested.
//
// DESIGN. A candidate is a query in a bin that a cell's posed box touches. One block is one warp, so that barriers cost little
// and a block is a small share of the whole. blockIdx.y: the pose.
//   search_cells  A block takes chunks of up to as many tame units, or eighths of curved ones, as it has threads: fewer where
//                 the grid's other blocks would have nothing to do. One thread reads the bounds of one; for an eighth it halves
//                 the cell's polynomial first. Then the rows of bins that the boxes touch are dealt out to the threads evenly,
//                 and so are the queries in those rows, whichever boxes they belong to. Candidates that pass queue in shared
//                 memory until there is one for each thread; then they are put on the lists of parts.cu. A block that finds a
//                 list full stops and leaves a note.
//   search_rest   The same for what is left by such notes, but the thread that finds an entry searches it at once, depth first.
//                 This is slow, and is there so that lists of a fixed length lose no root. Entries that the block had put on a
//                 list are found a second time; gather.cu drops their roots.
#include "bins.cuh"
#include "parts.cuh"

namespace snarf {
namespace SNARF_ISA {

constexpr int kCellThreads = 32;                       // maximum number of threads per block
constexpr int kBlocks = sizeof(Number) == 4 ? 20 : 8;  // on a multiprocessor, at least: 96 registers, no spill in float32
constexpr int kTurns = 8;                              // chunks that a block takes, where there are enough items

// What the threads of a block search: a unit of a tame cell each, or an eighth of a curved one.
template <class S>
struct Chunk {
  Bounds<S> bounds[kCellThreads];
  int record[kCellThreads], eighth[kCellThreads], slice[kCellThreads], slices[kCellThreads];
  Rows<kCellThreads> rows;
};

// Reads this thread's item of a chunk. All threads call it; returns the number of rows of bins that the items touch.
template <class S>
__device__ __forceinline__ long long read_item(const Search<S>& a, const Bins<S>& bins, bool is_curved, long long item,
                                               bool is_item, Chunk<S>& chunk) {
  const int pose = blockIdx.y, t = threadIdx.x;
  if (is_item) {
    const long long most = a.cells + a.cuts;
    const Unit* list = (const Unit*)a.units + most * pose;
    const Unit unit = is_curved ? list[most - 1 - item / 8] : list[item];
    const int record = pose * a.cells + unit.cell;
    chunk.record[t] = record;
    chunk.eighth[t] = int(item % 8);
    chunk.slice[t] = unit.slice;
    chunk.slices[t] = unit.slices;
    Bounds<S> bounds;
    if (is_curved) {
      Cell<S> part;
      make_part(a, Entry{0, record, 1, int(item % 8)}, part);
      measure(part, 1, bounds);
    } else {
      bounds = ((const Bounds<S>*)a.bounds)[record];
    }
    chunk.bounds[t] = bounds;
  }
  return enter_box(bins, is_item, chunk.bounds[t].centre, chunk.bounds[t].box, chunk.rows);
}

// The queue of candidates that passed the test: fewer than two for each thread.
struct Queue {
  int place[2 * kCellThreads], item[2 * kCellThreads];  // among the sorted queries; thread whose item may hold it
  int waiting;
};

// Puts the last `taken` of the queue on the lists. Returns false, for all threads alike, if one of them had no room.
template <class S>
__device__ __forceinline__ bool enter_queued(const Search<S>& a, bool is_curved, const Chunk<S>& chunk, const Queue& queue,
                                             int taken) {
  Entry entry = {0, 0, 0, 0};
  int list = -1;
  if ((int)threadIdx.x < taken) {
    const int at = queue.waiting - taken + threadIdx.x, item = queue.item[at];
    entry = {a.sorted_query[queue.place[at]], chunk.record[item], is_curved, is_curved ? chunk.eighth[item] : 0};
    list = list_of(chunk.bounds[item], 1);
  }
  return !__syncthreads_or(!enter(a, list, entry));
}

// Tests the candidates of a chunk and returns true; or stops and returns false when a list is full. kAlone: the thread that
// finds an entry searches it at once instead.
template <class S, bool kAlone>
__device__ __forceinline__ bool search_chunk(const Search<S>& a, const Bins<S>& bins, bool is_curved, long long item,
                                             bool is_item) {
  __shared__ Chunk<S> chunk;
  __shared__ int range_begin[kCellThreads], range_item[kCellThreads];  // queries in one row of bins
  __shared__ long long query_sums[kCellThreads];
  __shared__ Queue queue;

  const int t = threadIdx.x, threads = blockDim.x;
  __syncthreads();  // the block may still be at its last chunk
  if (t == 0) queue.waiting = 0;
  const long long all_rows = read_item(a, bins, is_curved, item, is_item, chunk);
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
            const Entry entry = {a.sorted_query[place], chunk.record[owner], is_curved, is_curved ? chunk.eighth[owner] : 0};
            search_below(a, list_of(chunk.bounds[owner], 1), entry);
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
      if (!enter_queued(a, is_curved, chunk, queue, threads)) return false;
      if (t == 0) queue.waiting = waiting - threads;
      __syncthreads();
    }
  }
  __syncthreads();
  return enter_queued(a, is_curved, chunk, queue, queue.waiting);
}

// How a pose's items are dealt out: tame units and eighths of curved ones, `at_once` in a chunk.
struct Shares {
  long long tame, curved, tame_chunks, chunks;
  int at_once;
};

template <class S>
__device__ Shares shares_of(const Search<S>& a, int pose, int blocks) {
  Shares shares;
  shares.tame = a.listed[3 * pose];
  shares.curved = 8ll * a.listed[3 * pose + 1];
  const long long turns = (long long)blocks * kTurns, share = (shares.tame + shares.curved + turns - 1) / turns;
  shares.at_once = int(share < 1 ? 1 : share < blockDim.x ? share : blockDim.x);
  shares.tame_chunks = (shares.tame + shares.at_once - 1) / shares.at_once;
  shares.chunks = shares.tame_chunks + (shares.curved + shares.at_once - 1) / shares.at_once;
  return shares;
}

// Searches every `step`-th chunk of a pose from the given one on. Returns the number of the chunk that it stopped at, or -1.
// The eighths of a curved cell stay side by side. Tame units are dealt out like cards: neighbours, which are equally crowded,
// go to different chunks.
template <class S, bool kAlone>
__device__ __forceinline__ long long search_chunks(const Search<S>& a, const Shares& shares, long long chunk, int step) {
  __shared__ Bins<S> bins;
  const int t = threadIdx.x;
  if (chunk >= shares.chunks) return -1;
  if (t == 0) lay_out(a.region + 12 * blockIdx.y, a.bins, bins);
  __syncthreads();
  for (; chunk < shares.chunks; chunk += step) {
    const long long curved_chunk = chunk - shares.tame_chunks;
    const bool is_curved = curved_chunk >= 0;
    const long long item = is_curved ? curved_chunk * shares.at_once + t : t * shares.tame_chunks + chunk;
    const bool is_item = t < shares.at_once && item < (is_curved ? shares.curved : shares.tame);
    if (!search_chunk<S, kAlone>(a, bins, is_curved, item, is_item)) return chunk;
  }
  return -1;
}

extern "C" __global__ void __launch_bounds__(kCellThreads, kBlocks) search_cells(const Search<Number> a) {
  const Shares shares = shares_of(a, blockIdx.y, gridDim.x);
  const long long stopped = search_chunks<Number, false>(a, shares, blockIdx.x, gridDim.x);
  if (threadIdx.x == 0) a.stopped[(long long)gridDim.x * blockIdx.y + blockIdx.x] = int(stopped);
}

// Usually has nothing to do.
extern "C" __global__ void __launch_bounds__(kCellThreads) search_rest(const Search<Number> a) {
  const int stopped = a.stopped[(long long)gridDim.x * blockIdx.y + blockIdx.x];
  if (stopped >= 0) search_chunks<Number, true>(a, shares_of(a, blockIdx.y, gridDim.x), stopped, gridDim.x);
}

}  // namespace SNARF_ISA
}  // namespace snarf
