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

// The bounds of a cell (cell.h). The box is kept elsewhere.
template <class S>
struct CellRecord {
  S centre[3];             // of the posed image, metres
  S inverse[9], reach[3];  // the first reach is negative for a cell whose transforms are not finite: it has no root
  S curvature;
};

// Uniform bins over the posed boxes of a pose's cells: those of level 0, and in each further level larger ones.
struct PreparedLevel {
  int32_t bins[3];
  int64_t bins_before;  // in finer levels
  bool is_empty;        // of cells
};

constexpr int kMostLevels = 6;
constexpr int kShareBits = 8;    // a place in a bin is known to 1/256 of its side
constexpr int kCoarserBits = 2;  // a bin is four times as long as one of the level before

template <class S>
struct PreparedPose {
  S lower[3], upper[3];  // of all boxes, metres
  S shares_per_metre;    // 256 in a bin of level 0
  int32_t levels;
  PreparedLevel level[kMostLevels];
  int64_t bins, groups;
};

// Cells of a bin, with their posed boxes in shares of the bin. What is not used has a lower corner above the upper one.
struct BinGroup {
  uint8_t lower[3][kBlock], upper[3][kBlock];
  int32_t cell[kBlock];
};

// A pose whose cells are sorted into bins (prepared.h).
template <class S>
struct PreparedTask {
  const S* transforms;  // of the pose, [V, 12]
  Geometry<S> geometry;
  const PreparedPose<S>* pose;
  const int32_t* number;       // of each of the C cells in the grid, x fastest
  const CellRecord<S>* cells;  // [C]
  const int32_t* first;        // first group of each bin, [bins + 1]
  const BinGroup* groups;
  const S* points;  // [N, 3]
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
  // Bounds those of a block's cells that are searched: their records, and the half extents of their posed boxes, [3] each.
  void (*bounds)(const S* transforms, const Geometry<S>&, const Block&, CellRecord<S>* cells, S* boxes);
  // Finds the roots of the queries first to last of a prepared pose.
  void (*search_prepared)(const PreparedTask<S>&, int64_t first, int64_t last, RootSink<S>&);
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
