// A step of Adam with a moving average of the parameters (snarfcli/training/optimizer.py).
#pragma once

#include <math.h>

#include "training_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// One row, or some parameters of an array that has no rows to skip.
SNARF_HD void adam_rows(const AdamTask& task, const ParameterArray& array, int64_t first, int64_t count) {
  float* __restrict const value = array.values + first;
  float* __restrict const mean = array.first + first;
  float* __restrict const square = array.second + first;
  const float* __restrict const gradient = array.gradient + first;
  const float rate = array.rate * task.rate_correction;
  for (int64_t k = 0; k < count; ++k) {
    const float g = gradient[k];
    mean[k] += (1.f - task.first_decay) * (g - mean[k]);
    square[k] += (1.f - task.second_decay) * (g * g - square[k]);
    value[k] -= rate * mean[k] / (sqrtf(square[k]) * task.root_correction + task.epsilon);
  }
}

// Rows first to last of an array; see snarf_adam_step.
void adam(const AdamTask& task, const ParameterArray& array, int64_t first, int64_t last) {
  const int64_t columns = array.columns, begin = first * columns, end = last * columns;
  if (array.skips_untouched) {
    for (int64_t at = begin; at < end; at += columns) {
      bool touched = false;
      for (int64_t c = 0; c < columns; ++c) touched |= array.gradient[at + c] != 0.f;
      if (touched) adam_rows(task, array, at, columns);
    }
  } else {
    adam_rows(task, array, begin, end - begin);
  }
  float* __restrict const average = array.average;
  const float* __restrict const value = array.values;
  for (int64_t k = begin; k < end; ++k) average[k] += (1.f - task.average_decay) * (value[k] - average[k]);
}

// The sum of the magnitudes of gradients; not finite if one of them is not.
double magnitude(const float* gradient, int64_t count) {
  double total = 0;
  for (int64_t first = 0; first < count; first += 1024) {
    const int64_t end = first + 1024 < count ? first + 1024 : count;
    float sums[16] = {};
    int64_t k = first;
    for (; k + 16 <= end; k += 16)
      for (int i = 0; i < 16; ++i) sums[i] += fabsf(gradient[k + i]);
    for (; k < end; ++k) sums[0] += fabsf(gradient[k]);
    for (const float sum : sums) total += double(sum);
  }
  return total;
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
