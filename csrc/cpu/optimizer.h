// A step of Adam with a moving average of the parameters (snarf/adam.h), for the rows of an array.
#pragma once

#include <math.h>

#include "snarf/adam.h"
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
  for (int64_t k = 0; k < count; ++k) adam_number(task, rate, gradient[k], value[k], mean[k], square[k]);
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
  for (int64_t k = begin; k < end; ++k) average_number(task, value[k], average[k]);
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
