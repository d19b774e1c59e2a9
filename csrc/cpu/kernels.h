// Arguments and results of the kernels, which are compiled once per instruction set (kernels.cpp).
// Plain data only: nothing here may instantiate a template of the standard library inside a kernel.
#pragma once

#include <stdint.h>

namespace snarf {

constexpr int kBlock = 16;  // cells side by side along x that are handled together

struct Block {
  int32_t x, y, z;  // its first cell
  uint32_t active;  // bit k: cell x + k is searched
};

// Posed boxes of a block's cells, metres; empty (lower > upper) where a cell is not searched.
template <class S>
struct BlockBoxes {
  S lower[3][kBlock], upper[3][kBlock];
};

template <class S>
struct Geometry {
  S lower[3], size[3];  // canonical, metres
  int32_t nodes[3];     // W, H, D
};

// The queries of one pose, sorted into uniform bins in posed space, x fastest: a run of bins in a row is one contiguous range.
template <class S>
struct SortedQueries {
  const S* at[3];        // coordinates, readable kBlock numbers beyond the end
  const int32_t* query;  // index of the query
  const int32_t* begin;  // first query of each bin, [bins + 1]
  S lower[3], upper[3];  // region of the bins, metres
  S per_metre;           // bins per metre
  int32_t bins[3];
};

template <class S>
struct Root {
  int32_t query;
  int32_t order;  // sorts the roots of one query: the cell (complete) or the start (broyden)
  S canonical[3];
  S inverse[9];  // of dd/dx
};

// The roots of a thread; `more` makes room when next == end.
template <class S>
struct RootSink {
  Root<S>* next;
  Root<S>* end;
  void* owner;
  void (*more)(RootSink*);
};

// Growing lists of candidate queries: their coordinates, and which they are. `reserve` makes room for `count` and kBlock more.
template <class S>
struct Scratch {
  S* at[3];
  int32_t* query;
  int64_t capacity;
  void* owner;
  void (*reserve)(Scratch*, int64_t count);
};

template <class S>
struct CompleteTask {
  const S* transforms;  // of the pose, [V, 12]
  Geometry<S> geometry;
  SortedQueries<S> queries;
  S tolerance;
  int32_t max_steps;
  bool orientation_preserving;
};

template <class S>
struct BroydenTask {
  const S* transforms;  // of the pose, [V, 12]
  Geometry<S> geometry;
  const S* points;  // of the pose, [N, 3]
  const S* starts;  // of the pose, [count, 12], or of its queries, [N, count, 3]
  int64_t count;
  S tolerance, divergence, same_root;
  int32_t max_steps;
  bool starts_are_points, exact_jacobian, orientation_preserving;
};

template <class S>
struct BackwardTask {
  Geometry<S> geometry;
  const S* gradient;  // [M, 3], and so on: the roots of one pose
  const S* canonical;
  const S* inverse;
  const int64_t* query;
  int64_t roots, first_query;
  S* v_points;        // of the pose, [N, 3], or null
  S* v_transforms;    // of the pose, [V, 12], or null
  int64_t layers[2];  // only nodes with z in [layers[0], layers[1]) are written
};

constexpr int kRow = 16;  // numbers that a transform's twelve take up in `rows`

// Nodes first to last of a blend.
template <class S>
struct BlendTask {
  const S* weights;     // [V, J]
  const S* rows;        // transforms by bone, [B, J, kRow]; or by number, [B, 12, columns] (gradient of the weights)
  const uint8_t* used;  // which nodes are blended, [V], or null for all
  int64_t poses, bones, nodes, columns;
  int64_t first, last;
};

template <class S>
struct Kernels {
  // transforms [B, V, 12] of the task's nodes.
  void (*blend)(const BlendTask<S>&, S* transforms);
  // v_weights [V, J] of the task's nodes, from the gradient by the transforms, [B, V, 12]; `row` has room for the columns.
  void (*blend_weights)(const BlendTask<S>&, const S* gradient, S* row, S* v_weights);
  // Adds the task's nodes to v_rows [B, J, kRow], the gradient by the bones.
  void (*blend_bones)(const BlendTask<S>&, const S* gradient, S* v_rows);
  // Widens the box lower[3], upper[3] to hold `count` points [N, 3]; NaN is ignored.
  void (*extent)(const S* points, int64_t count, S* lower, S* upper);
  // The bin of each of `count` points [N, 3]; -1 outside the region of the bins.
  void (*bins)(const SortedQueries<S>&, const S* points, int64_t count, int32_t* bin);
  // Bounds the posed images of a block's cells.
  void (*boxes)(const S* transforms, const Geometry<S>&, const Block&, BlockBoxes<S>&);
  // Finds the roots in one block's cells.
  void (*search)(const CompleteTask<S>&, const Block&, const BlockBoxes<S>&, Scratch<S>&, RootSink<S>&);
  // Runs Broyden's method for the queries first to last.
  void (*broyden)(const BroydenTask<S>&, int64_t first, int64_t last, RootSink<S>&);
  void (*backward)(const BackwardTask<S>&);
};

namespace avx512 {
template <class S>
Kernels<S> kernels();
}
namespace avx2 {
template <class S>
Kernels<S> kernels();
}
namespace baseline {
template <class S>
Kernels<S> kernels();
}

}  // namespace snarf
