// The change of skinning weights from node to node (snarf/variation.h), layer by layer.
#pragma once

#include <math.h>
#include <string.h>

#include "snarf/variation.h"
#include "training_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Writes the gradient of the layers first to last, and their shares of the total.
void variation(const VariationTask& task, int64_t first, int64_t last) {
  const int64_t nodes[3] = {task.nodes[0], task.nodes[1], task.nodes[2]};
  const int64_t step[3] = {1, nodes[0], nodes[0] * nodes[1]}, count = task.count;
  for (int64_t z = first; z < last; ++z) {
    double total = 0;
    for (int64_t n = z * step[2]; n < (z + 1) * step[2]; ++n) {
      float* __restrict const gradient = task.gradient + n * count;
      memset(gradient, 0, sizeof(float) * size_t(count));
      if (task.used && !task.used[n]) continue;
      const float* __restrict const here = task.weights + n * count;
      const int64_t place[3] = {n % nodes[0], n / step[1] % nodes[1], z};
      for (int axis = 0; axis < 3; ++axis)
        for (int side = -1; side <= 1; side += 2) {
          const int64_t other = n + side * step[axis], at = place[axis] + side;
          if (at < 0 || at >= nodes[axis] || (task.used && !task.used[other])) continue;
          const float* __restrict const there = task.weights + other * count;
          const float scale = task.scale[axis];
          float sum = 0;
          for (int64_t j = 0; j < count; ++j) sum += add_change(here[j], there[j], scale, gradient[j]);
          if (side > 0) total += double(scale) * double(sum);
        }
    }
    task.totals[z] = total;
  }
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
