// The gradient of the roots by implicit differentiation (implicit.h, SNARF Eq. 14).
//
// DESIGN. One thread per root. The gradient by the query is summed by the thread of the query's first root over its roots,
// which stand side by side: no atomics, the same every time. The gradient by the node transforms is added to the eight nodes of
// the root's cell by atomics, 48 bytes each, on Hopper and later 16 bytes at a time; the order of these additions, and with it
// the last bits of v_transforms, differs from run to run. Rows of padding (query B N) give nothing.
#include "snarf/grid.h"
#include "snarf/implicit.h"

namespace snarf {
namespace SNARF_ISA {

typedef SNARF_NUMBER Number;

template <class S>
struct Backward {
  const S* gradient;          // [M, 3], of the loss by the roots
  const S* canonical;         // [M, 3]
  const long long* query;     // [M], ascending
  const S* jacobian_inverse;  // [M, 9]
  const S* lower;             // [3], canonical position of the first node, metres
  const S* upper;             // [3], and of the last
  S* v_points;                // [B, N, 3], zero, or null
  S* v_transforms;            // [B, V, 12], zero, 16-byte aligned, or null
  long long roots;            // M
  long long count;            // N
  long long queries;          // B N
  int nodes[3];               // W, H, D
};

// node[0 .. 11] += weight * values[0 .. 11]
template <class S>
__device__ void add_to_node(S* node, S weight, const S* values) {
  for (int r = 0; r < 12; ++r) atomicAdd(node + r, weight * values[r]);
}
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
__device__ void add_to_node(float* node, float weight, const float* values) {
  for (int r = 0; r < 12; r += 4) {
    const float4 four = {weight * values[r], weight * values[r + 1], weight * values[r + 2], weight * values[r + 3]};
    atomicAdd((float4*)(node + r), four);
  }
}
#endif

extern "C" __global__ void __launch_bounds__(128) implicit_backward(const Backward<Number> a) {
  typedef Number S;
  const long long m = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (m >= a.roots) return;
  const long long query = a.query[m];
  if (query < 0 || query >= a.queries) return;
  S v[3];
  if (a.v_points && (m == 0 || a.query[m - 1] != query)) {
    S sum[3] = {0, 0, 0};
    for (long long k = m; k < a.roots && a.query[k] == query; ++k) {
      pull_back(a.jacobian_inverse + 9 * k, a.gradient + 3 * k, v);
      for (int i = 0; i < 3; ++i) sum[i] += v[i];
    }
    for (int i = 0; i < 3; ++i) a.v_points[3 * query + i] = sum[i];
  }
  if (!a.v_transforms) return;
  Grid<S> grid;
  for (int i = 0; i < 3; ++i) {
    grid.lower[i] = a.lower[i];
    grid.size[i] = (a.upper[i] - a.lower[i]) / S(a.nodes[i] - 1);
    grid.nodes[i] = a.nodes[i];
  }
  const S* x = a.canonical + 3 * m;
  S local[3], weights[8], values[12];
  const long long first = locate(grid, x, local);
  corner_weights(local, weights);
  pull_back(a.jacobian_inverse + 9 * m, a.gradient + 3 * m, v);
  transform_gradient(v, x, values);
  const long long nodes = (long long)grid.nodes[0] * grid.nodes[1] * grid.nodes[2];
  S* v_transforms = a.v_transforms + 12 * nodes * (query / a.count);
  for (int k = 0; k < 8; ++k) add_to_node(v_transforms + 12 * corner_node(grid, first, k), weights[k], values);
}

}  // namespace SNARF_ISA
}  // namespace snarf
