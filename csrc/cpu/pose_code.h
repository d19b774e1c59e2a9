// Pose codes of points that see the parts of a pose by different shares (snarfcli/networks/pose_code.py).
#pragma once

#include <string.h>

#include "blocks.h"
#include "training_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Points first to last.
void pose_codes(const CodeTask& task, int64_t first, int64_t last) {
  for (int64_t n = first; n < last; ++n)
    for_blocks(task.size, [&](int at, auto block) {
      constexpr int K = decltype(block)::value;
      const float* const seen = task.seen + n * task.parts;
      const float* code = task.codes + task.pose[n] * task.parts * task.size + at;
      float sum[K] = {};
      for (int p = 0; p < task.parts; ++p, code += task.size)
        for (int k = 0; k < K; ++k) sum[k] += seen[p] * code[k];
      memcpy(task.out + n * task.size + at, sum, sizeof sum);
    });
}

// Adds the gradients by the codes from points first to last to v_codes [B, P, K].
void pose_codes_backward(const CodeTask& task, int64_t first, int64_t last, float* v_codes) {
  for (int64_t n = first; n < last; ++n)
    for_blocks(task.size, [&](int at, auto block) {
      constexpr int K = decltype(block)::value;
      const float* const seen = task.seen + n * task.parts;
      float* v_code = v_codes + task.pose[n] * task.parts * task.size + at;
      float given[K];
      memcpy(given, task.v_out + n * task.size + at, sizeof given);
      for (int p = 0; p < task.parts; ++p, v_code += task.size) {
        if (seen[p] == 0.f) continue;  // most bones are far away
        float sum[K];
        memcpy(sum, v_code, sizeof sum);
        for (int k = 0; k < K; ++k) sum[k] += seen[p] * given[k];
        memcpy(v_code, sum, sizeof sum);
      }
    });
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
