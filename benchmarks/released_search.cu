// The search of the released Fast-SNARF as CUDA kernels of our own, written from the papers: the rival of
// csrc/cuda/complete.cu.
//
// DESIGN. `search_from_bones`: one thread takes one query from one start bone through all its steps, with everything but the
// grid in registers (Fast-SNARF Sec. 4.1, "Custom CUDA Kernel"). Threads that stand side by side have the same query and the
// next bone, so that reading queries and writing results is coalesced. `filter_duplicates`: one thread a query drops the roots
// that lie within `same` of one from an earlier bone. Results are padded, [B, N, I], as the release returns them; nothing
// gathers the roots. The twelve numbers of a node are adjacent and read in 16-byte pieces, not twelve planes as for PyTorch's
// grid_sample, so that no lead over these kernels is one of memory layout. As in the release: the start Jacobian, zero
// transforms outside the grid, thresholds in metres, no test of the start itself, and the inverse Jacobian from before the last
// step. Reference: released_search.py.
#include "snarf/platform.h"

namespace snarf {
namespace SNARF_ISA {

typedef SNARF_NUMBER Number;

constexpr int kThreads = 128;

// Twelve numbers of a node, row-major [3, 4]. Aligned so that they move in 16-byte pieces.
struct alignas(16) Transform {
  Number v[12];
};

struct Released {
  const Number* points;         // [B, N, 3], posed, metres
  const Transform* transforms;  // [B, V], blended at the nodes
  const Transform* starts;      // [B, I], posed to canonical
  const Number* lower;          // [3], canonical position of the first node, metres
  const Number* upper;          // [3], and of the last
  Number* canonical;            // [B, N, I, 3], metres; written where `valid`
  Number* jacobian_inverse;     // [B, N, I, 9]; written where `valid`
  unsigned char* valid;         // [B, N, I]
  long long count;              // N
  long long pairs;              // B N I
  double converged, diverged;   // metres
  double same;                  // metres
  int nodes[3];                 // W, H, D
  int start_count;              // I
  int max_steps;
};

SNARF_HD void image_of(const Number* rows, const Number* x, Number* y) {
  for (int i = 0; i < 3; ++i) y[i] = rows[4 * i] * x[0] + rows[4 * i + 1] * x[1] + rows[4 * i + 2] * x[2] + rows[4 * i + 3];
}

// Trilinear transform [12] at the canonical point x; nodes beyond the grid count as zero.
SNARF_HD void blend(const Released& a, const Transform* transforms, const Number* lower, const Number* per_metre,
                    const Number* x, Number* rows) {
  for (int r = 0; r < 12; ++r) rows[r] = 0;
  int first[3];
  Number local[3];
  for (int axis = 0; axis < 3; ++axis) {
    const Number at = (x[axis] - lower[axis]) * per_metre[axis];
    if (!(at > Number(-1) && at < Number(a.nodes[axis]))) return;  // also NaN
    first[axis] = int(at + 1) - 1;                                 // rounds down, from -1 on
    local[axis] = at - Number(first[axis]);
  }
  SNARF_UNROLL
  for (int k = 0; k < 8; ++k) {
    const int column = first[0] + (k & 1), row = first[1] + (k >> 1 & 1), layer = first[2] + (k >> 2 & 1);
    const bool inside = column >= 0 && column < a.nodes[0] && row >= 0 && row < a.nodes[1] && layer >= 0 && layer < a.nodes[2];
    if (!inside) continue;
    const Number weight =
        (k & 1 ? local[0] : 1 - local[0]) * (k & 2 ? local[1] : 1 - local[1]) * (k & 4 ? local[2] : 1 - local[2]);
    const Transform node = transforms[((long long)layer * a.nodes[1] + row) * a.nodes[0] + column];
    for (int r = 0; r < 12; ++r) rows[r] += weight * node.v[r];
  }
}

extern "C" __global__ void __launch_bounds__(kThreads) search_from_bones(const Released a) {
  const long long pair = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (pair >= a.pairs) return;
  const long long query = pair / a.start_count, pose = query / a.count;
  const int start = int(pair - query * a.start_count);
  const long long nodes = (long long)a.nodes[0] * a.nodes[1] * a.nodes[2];
  const Transform* transforms = a.transforms + nodes * pose;
  Number lower[3], per_metre[3], target[3], x[3], rows[12], error[3], inverse[9];
  for (int i = 0; i < 3; ++i) {
    lower[i] = a.lower[i];
    per_metre[i] = Number(a.nodes[i] - 1) / (a.upper[i] - a.lower[i]);
    target[i] = a.points[3 * query + i];
  }
  const Transform back = a.starts[pose * a.start_count + start];
  image_of(back.v, target, x);
  blend(a, transforms, lower, per_metre, x, rows);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) inverse[3 * i + j] = rows[4 * j + i];
  image_of(rows, x, error);
  for (int i = 0; i < 3; ++i) error[i] -= target[i];
  const Number converged2 = Number(a.converged * a.converged), diverged2 = Number(a.diverged * a.diverged);
  bool found = false;
  for (int k = 0; k < a.max_steps; ++k) {
    Number step[3], change[3], towards[3], row[3], distance2 = 0;
    for (int i = 0; i < 3; ++i) {
      step[i] = -(inverse[3 * i] * error[0] + inverse[3 * i + 1] * error[1] + inverse[3 * i + 2] * error[2]);
      change[i] = error[i];
    }
    for (int i = 0; i < 3; ++i) x[i] += step[i];
    blend(a, transforms, lower, per_metre, x, rows);
    image_of(rows, x, error);
    for (int i = 0; i < 3; ++i) {
      error[i] -= target[i];
      distance2 += error[i] * error[i];
      change[i] = error[i] - change[i];
    }
    found = distance2 < converged2;
    if (found || !(distance2 < diverged2)) break;
    // Broyden's rank-one update of the inverse (Fast-SNARF Eq. 7, by Sherman and Morrison).
    Number scale = 0;
    for (int i = 0; i < 3; ++i) {
      towards[i] = inverse[3 * i] * change[0] + inverse[3 * i + 1] * change[1] + inverse[3 * i + 2] * change[2];
      row[i] = step[0] * inverse[i] + step[1] * inverse[3 + i] + step[2] * inverse[6 + i];
    }
    for (int i = 0; i < 3; ++i) scale += row[i] * change[i];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const Number update = (step[i] - towards[i]) * row[j] / scale;
        inverse[3 * i + j] += update - update == 0 ? update : Number(0);
      }
  }
  a.valid[pair] = found;
  if (!found) return;
  for (int i = 0; i < 3; ++i) a.canonical[3 * pair + i] = x[i];
  for (int i = 0; i < 9; ++i) a.jacobian_inverse[9 * pair + i] = inverse[i];
}

extern "C" __global__ void __launch_bounds__(kThreads) filter_duplicates(const Released a) {
  const long long query = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  const long long first = query * a.start_count;
  if (first >= a.pairs) return;
  const Number same2 = Number(a.same * a.same);
  for (int i = 1; i < a.start_count; ++i) {
    if (!a.valid[first + i]) continue;
    const Number* mine = a.canonical + 3 * (first + i);
    for (int j = 0; j < i; ++j) {
      if (!a.valid[first + j]) continue;
      const Number* other = a.canonical + 3 * (first + j);
      const Number x = mine[0] - other[0], y = mine[1] - other[1], z = mine[2] - other[2];
      if (x * x + y * y + z * z < same2) {
        a.valid[first + i] = 0;
        break;
      }
    }
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
