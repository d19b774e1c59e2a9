// The papers' search: Broyden's method from one start per bone, or from given starts (broyden.h).
//
// DESIGN. One thread takes one query through all its starts, one after the other, and drops what it has found already. A thread
// for each pair of query and start would need memory for queries times starts, since which of several equal roots is kept must
// not depend on which thread comes first. The threads of a warp stand side by side in the array of queries and take the same
// start at the same time; their look-ups into the grid are as coherent as the queries are. blockIdx.y is the pose.
#include "search.cuh"
#include "snarf/broyden.h"

namespace snarf {
namespace SNARF_ISA {

extern "C" __global__ void __launch_bounds__(128) search_from_starts(const Search<Number> a) {
  typedef Number S;
  const int pose = a.first_pose + blockIdx.y;
  const long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (n >= a.count) return;
  const Grid<S> grid = grid_of(a);
  const S side = longest_side(a), same = same_root_distance(a, grid);
  const Broyden<S> settings = {S(a.tolerance) * side, S(a.divergence) * side, a.max_steps, a.exact_jacobian != 0};
  const long long nodes = (long long)grid.nodes[0] * grid.nodes[1] * grid.nodes[2];
  const S* transforms = a.transforms + 12 * nodes * pose;
  const long long query = a.count * pose + n;
  S target[3];
  for (int i = 0; i < 3; ++i) target[i] = a.points[3 * query + i];
  if (!is_finite(target)) return;
  for (int start = 0; start < a.start_count; ++start) {
    S x[3], inverse[9];
    if (a.starts_are_points)
      for (int i = 0; i < 3; ++i) x[i] = a.starts[3 * (a.start_count * query + start) + i];
    else
      start_from(a.starts + 12 * ((long long)a.start_count * pose + start), target, x);
    if (!is_finite(x) || !broyden(transforms, grid, settings, target, x, inverse)) continue;
    bool is_new = !a.orientation_preserving || preserves_orientation(inverse);
    for (int slot = a.head[query]; slot && is_new; slot = a.root_next[slot - 1])
      is_new = squared_distance(a.root + 12 * (long long)(slot - 1), x) >= same * same;
    if (is_new) report_root(a, int(query), start, x, inverse);
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
