// The change of skinning weights from node to node, and its gradient (snarfcli/deformer/variation.py), float32.
//
// DESIGN. Nothing is summed by atomics: the same input gives the same bits.
//   count_pairs      Each of a few blocks counts pairs of used neighbours along each axis; not called if all nodes are used.
//   measure_changes  Every block adds up the counts first. Then one thread takes one weight at a time, with those of the same
//                    bone at the six neighbouring nodes, and writes the gradient by it; neighbouring threads take neighbouring
//                    weights, so that all reads stand side by side. Each block writes its share of the sum.
//   sum_changes      One block adds up the shares, in double precision.
#include "snarf/variation.h"

namespace snarf {
namespace SNARF_ISA {

constexpr int kVariationThreads = 256;  // maximum number of threads per block

struct Variation {
  const float* weights;       // [D, H, W, J]
  const unsigned char* used;  // [D, H, W], or null for all
  const float* size;          // [3], sides of a cell, metres
  int* pairs;                 // [pair_blocks, 3], from count_pairs
  double* shares;             // [blocks], from measure_changes
  float* total;               // [1], result
  float* gradient;            // [D, H, W, J], result
  int nodes[3];               // W, H, D
  int count;                  // J
  int pair_blocks, blocks;
};

// Replaces values[N] by their sums over all threads of the block, always in the same order.
template <class T, int N>
__device__ void sum_over_block(T (&values)[N]) {
  __shared__ T parts[N][kVariationThreads];
  const unsigned me = threadIdx.x;
  for (int i = 0; i < N; ++i) parts[i][me] = values[i];
  __syncthreads();
  for (unsigned step = 1; step < blockDim.x; step *= 2) {
    if (me % (2 * step) == 0 && me + step < blockDim.x)
      for (int i = 0; i < N; ++i) parts[i][me] += parts[i][me + step];
    __syncthreads();
  }
  for (int i = 0; i < N; ++i) values[i] = parts[i][0];
}

__device__ bool is_used(const Variation& a, int node) { return !a.used || a.used[node]; }

// The place of a node along each axis, and how many nodes its neighbours along each axis are away.
struct NodePlace {
  int at[3], step[3];
};

__device__ NodePlace place_of(const Variation& a, int node) {
  const int width = a.nodes[0], layer = a.nodes[0] * a.nodes[1];
  return {{node % width, node / width % a.nodes[1], node / layer}, {1, width, layer}};
}

extern "C" __global__ void __launch_bounds__(kVariationThreads) count_pairs(const Variation a) {
  const int nodes = a.nodes[0] * a.nodes[1] * a.nodes[2];
  int pairs[3] = {0, 0, 0};
  for (int n = int(blockIdx.x * blockDim.x + threadIdx.x); n < nodes; n += int(gridDim.x * blockDim.x)) {
    if (!is_used(a, n)) continue;
    const NodePlace place = place_of(a, n);
    for (int axis = 0; axis < 3; ++axis) pairs[axis] += place.at[axis] + 1 < a.nodes[axis] && is_used(a, n + place.step[axis]);
  }
  sum_over_block(pairs);
  if (threadIdx.x == 0)
    for (int axis = 0; axis < 3; ++axis) a.pairs[3 * blockIdx.x + axis] = pairs[axis];
}

// All threads of a block call this; one of them divides, since division in double precision is slow on most GPUs.
__device__ void find_scales(const Variation& a, float* scales) {
  int pairs[3] = {0, 0, 0};
  if (a.used) {
    for (int block = int(threadIdx.x); block < a.pair_blocks; block += int(blockDim.x))
      for (int axis = 0; axis < 3; ++axis) pairs[axis] += a.pairs[3 * block + axis];
    sum_over_block(pairs);
  } else {
    const int nodes = a.nodes[0] * a.nodes[1] * a.nodes[2];
    for (int axis = 0; axis < 3; ++axis) pairs[axis] = nodes - nodes / a.nodes[axis];
  }
  __shared__ float found[3];
  if (threadIdx.x == 0)
    for (int axis = 0; axis < 3; ++axis) found[axis] = change_scale(a.size[axis], pairs[axis]);
  __syncthreads();
  for (int axis = 0; axis < 3; ++axis) scales[axis] = found[axis];
}

extern "C" __global__ void __launch_bounds__(kVariationThreads) measure_changes(const Variation a) {
  float scales[3], sums[3] = {0.f, 0.f, 0.f};
  find_scales(a, scales);
  const long long numbers = (long long)a.nodes[0] * a.nodes[1] * a.nodes[2] * a.count;
  const long long stride = (long long)gridDim.x * blockDim.x;
  for (long long k = (long long)blockIdx.x * blockDim.x + threadIdx.x; k < numbers; k += stride) {
    const int n = int(k / a.count);
    float gradient = 0.f;
    if (is_used(a, n)) {
      const NodePlace place = place_of(a, n);
      const float here = a.weights[k];
      for (int axis = 0; axis < 3; ++axis)
        for (int side = -1; side <= 1; side += 2) {
          const int at = place.at[axis] + side, step = side * place.step[axis];
          if (at < 0 || at >= a.nodes[axis] || !is_used(a, n + step)) continue;
          const float change = add_change(here, a.weights[k + (long long)step * a.count], scales[axis], gradient);
          if (side > 0) sums[axis] += change;
        }
    }
    a.gradient[k] = gradient;
  }
  double share[1] = {0};
  for (int axis = 0; axis < 3; ++axis) share[0] += double(scales[axis]) * double(sums[axis]);
  sum_over_block(share);
  if (threadIdx.x == 0) a.shares[blockIdx.x] = share[0];
}

extern "C" __global__ void __launch_bounds__(kVariationThreads) sum_changes(const Variation a) {
  double total[1] = {0};
  for (int block = int(threadIdx.x); block < a.blocks; block += int(blockDim.x)) total[0] += a.shares[block];
  sum_over_block(total);
  if (threadIdx.x == 0) *a.total = float(total[0]);
}

}  // namespace SNARF_ISA
}  // namespace snarf
