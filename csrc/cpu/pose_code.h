// Pose codes of points that see the parts of a pose by different shares (snarfcli/networks/pose_code.py).
#pragma once

#include "training_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Points first to last.
void pose_codes(const CodeTask& task, int64_t first, int64_t last) {
  const int64_t parts = task.parts, size = task.size;
  for (int64_t n = first; n < last; ++n) {
    float* __restrict__ const out = task.out + n * size;
    const float* const seen = task.seen + n * parts;
    const float* code = task.codes + task.pose[n] * parts * size;
    for (int64_t k = 0; k < size; ++k) out[k] = 0.f;
    for (int64_t p = 0; p < parts; ++p, code += size)
      for (int64_t k = 0; k < size; ++k) out[k] += seen[p] * code[k];
  }
}

// Adds the gradients by the codes from points first to last to v_codes [B, P, K].
void pose_codes_backward(const CodeTask& task, int64_t first, int64_t last, float* v_codes) {
  const int64_t parts = task.parts, size = task.size;
  for (int64_t n = first; n < last; ++n) {
    const float* __restrict__ const given = task.v_out + n * size;
    const float* const seen = task.seen + n * parts;
    float* __restrict__ v_code = v_codes + task.pose[n] * parts * size;
    for (int64_t p = 0; p < parts; ++p, v_code += size) {
      if (seen[p] == 0.f) continue;  // most bones are far away
      for (int64_t k = 0; k < size; ++k) v_code[k] += seen[p] * given[k];
    }
  }
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
