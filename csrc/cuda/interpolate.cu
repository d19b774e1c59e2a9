// Values at the nodes of a grid, interpolated at points (snarfcli/deformer/trilinear.py), without gradients.
//
// DESIGN. One thread for each value of a point. Neighbouring threads read neighbouring values of the same nodes and write
// neighbouring results; each finds the cell of its point anew, which costs less than keeping it in memory. No sum has more than
// one thread: the same bits every time.
#include "snarf/grid.h"

namespace snarf {
namespace SNARF_ISA {

typedef SNARF_NUMBER Number;

template <class S>
struct Interpolation {
  const S* values;  // [D, H, W, C]
  const S* points;  // [N, 3], canonical, metres
  const S* lower;   // [3], position of the first node
  const S* upper;   // [3], and of the last
  S* out;           // [N, C]
  long long count;  // N
  int channels;     // C
  int nodes[3];     // W, H, D
};

extern "C" __global__ void __launch_bounds__(256) interpolate_values(const Interpolation<Number> a) {
  typedef Number S;
  const long long item = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  const long long n = item / a.channels;
  if (n >= a.count) return;
  const int channel = int(item - n * a.channels);
  Grid<S> grid;
  for (int axis = 0; axis < 3; ++axis) {
    grid.lower[axis] = a.lower[axis];
    grid.size[axis] = (a.upper[axis] - a.lower[axis]) / S(a.nodes[axis] - 1);
    grid.nodes[axis] = a.nodes[axis];
  }
  S local[3], weights[8], sum = 0;
  const long long first = locate(grid, a.points + 3 * n, local);
  for (int axis = 0; axis < 3; ++axis)
    local[axis] = local[axis] < 0 ? S(0) : local[axis] > 1 ? S(1) : local[axis];  // NaN stays NaN
  corner_weights(local, weights);
  SNARF_UNROLL
  for (int k = 0; k < 8; ++k) sum += weights[k] * a.values[corner_node(grid, first, k) * a.channels + channel];
  a.out[item] = sum;
}

}  // namespace SNARF_ISA
}  // namespace snarf
