// A step of Adam, with the moving average, for all parameters of a model (adam.h), float32.
//
// DESIGN. The arrays stand in the kernel's argument, up to kAdamArrays at a time: a CUDA graph keeps it by value, and nothing
// is uploaded. Each array is cut into parts of about kPartNumbers neighbouring numbers, always whole rows.
//   check_gradients    A limited number of blocks go through the parts. Each block writes to a flag of its own whether it met a
//                      gradient that is not finite, so that nothing has to be zero before. The first block adds the caller's
//                      wish to skip the step, and works out the corrections for the step once, in double precision.
//   update_parameters  One block a part; it ends at once if any flag is set. If rows without a gradient keep their moments, one
//                      thread a row looks for one first: rows are short, and are read again from the cache by the threads that
//                      take one number each, side by side in memory.
// All launches of the first kernel come before those of the second. The arguments are the same in every step, and the result
// does not depend on the number of blocks or threads.
#include "snarf/adam.h"

namespace snarf {
namespace SNARF_ISA {

constexpr int kAdamArrays = 50;     // the argument has to stay below 4 KB
constexpr int kAdamThreads = 256;   // maximum number of threads per block
constexpr int kPartNumbers = 1024;  // of a part, unless a single row is longer

// Parameters [rows, columns] with their gradient, moments and average; none is empty.
struct AdamArray {
  float* values;
  const float* gradient;
  float *first, *second, *average;
  long long rows;
  double rate;  // as a multiple of the learning rate
  int columns;
  int skips_untouched;  // whether rows without a gradient keep their values and moments
  int end_part;         // running sum of the parts of this launch's arrays
};

struct AdamLaunch {
  AdamArray arrays[kAdamArrays];
  const float* learning_rate;  // [1]
  const long long* step;       // [1], from 0
  const unsigned char* skip;   // [1], whether to leave the step out
  AdamTask* task;              // [1], from the first launch of check_gradients
  unsigned char* flags;        // [flag_count], from all launches of check_gradients
  unsigned char* left_out;     // [1], result: whether the step was left out
  double average_decay;        // at most
  float first_decay, second_decay, epsilon;
  int count;       // of the arrays
  int first_flag;  // of this launch
  int flag_count;  // of all launches
};

// Some rows of an array.
struct AdamPart {
  int array;
  long long first_row;
  int rows;
};

// Finds a part of a launch; `array`: one that is known not to be behind it.
__device__ AdamPart part_of(const AdamLaunch& a, int part, int array) {
  while (part >= a.arrays[array].end_part) ++array;
  const int within = part - (array ? a.arrays[array - 1].end_part : 0);
  const int rows = a.arrays[array].columns < kPartNumbers ? kPartNumbers / a.arrays[array].columns : 1;
  const long long first_row = (long long)within * rows, left = a.arrays[array].rows - first_row;
  return {array, first_row, left < rows ? int(left) : rows};
}

__device__ bool is_finite(float value) { return absolute(value) <= 3.402823466e38f; }

extern "C" __global__ void __launch_bounds__(kAdamThreads) check_gradients(const AdamLaunch a) {
  __shared__ int spoilt;
  if (threadIdx.x == 0) {
    spoilt = 0;
    if (a.first_flag + blockIdx.x == 0) {
      spoilt = *a.skip;
      const double step = double(*a.step), early = (2 + step) / (11 + step);
      const float average_decay = float(early < a.average_decay ? early : a.average_decay);
      *a.task = adam_task(a.first_decay, a.second_decay, a.epsilon, average_decay, *a.step + 1);
    }
  }
  __syncthreads();
  const int parts = a.count ? a.arrays[a.count - 1].end_part : 0;
  AdamPart part = {};
  for (int p = blockIdx.x; p < parts; p += gridDim.x) {
    part = part_of(a, p, part.array);
    const AdamArray& array = a.arrays[part.array];
    const float* const gradient = array.gradient + part.first_row * array.columns;
    const int numbers = part.rows * array.columns;
    for (int k = threadIdx.x; k < numbers; k += blockDim.x)
      if (!is_finite(gradient[k])) atomicExch(&spoilt, 1);
  }
  __syncthreads();
  if (threadIdx.x == 0) a.flags[a.first_flag + blockIdx.x] = spoilt != 0;
}

extern "C" __global__ void __launch_bounds__(kAdamThreads) update_parameters(const AdamLaunch a) {
  __shared__ int left_out;
  __shared__ unsigned char touched[kPartNumbers];
  if (threadIdx.x == 0) left_out = 0;
  __syncthreads();
  for (int flag = threadIdx.x; flag < a.flag_count; flag += blockDim.x)
    if (a.flags[flag]) atomicExch(&left_out, 1);
  __syncthreads();
  if (blockIdx.x == 0 && threadIdx.x == 0) *a.left_out = left_out != 0;
  if (left_out || !a.count) return;
  const AdamPart part = part_of(a, blockIdx.x, 0);
  const AdamArray& array = a.arrays[part.array];
  const int columns = array.columns, numbers = part.rows * columns;
  const long long begin = part.first_row * columns;
  if (array.skips_untouched) {
    for (int row = threadIdx.x; row < part.rows; row += blockDim.x) {
      const float* const gradient = array.gradient + begin + (long long)row * columns;
      bool is_touched = false;
      for (int c = 0; c < columns; ++c) is_touched |= gradient[c] != 0.f;
      touched[row] = is_touched;
    }
    __syncthreads();
  }
  const AdamTask task = *a.task;
  const float rate = float(double(*a.learning_rate) * array.rate) * task.rate_correction;
  for (int k = threadIdx.x; k < numbers; k += blockDim.x) {
    const long long at = begin + k;
    float value = array.values[at], average = array.average[at];
    if (!array.skips_untouched || touched[k / columns]) {
      float mean = array.first[at], square = array.second[at];
      adam_number(task, rate, array.gradient[at], value, mean, square);
      array.first[at] = mean;
      array.second[at] = square;
      array.values[at] = value;
    }
    average_number(task, value, average);
    array.average[at] = average;
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
