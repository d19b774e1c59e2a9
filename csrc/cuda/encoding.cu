// Points as coordinates, waves and features of grids (snarfcli/networks/encoding.py), forward and backward, float32.
//
// DESIGN. The levels stand in the kernels' argument, by value, so that a CUDA graph keeps them.
//   encode_points    One thread for each part of a point: its coordinates, its waves of one frequency, its features of one
//                    level. Neighbouring threads write neighbouring numbers. No sum has more than one thread: the same bits
//                    every time.
//   encode_backward  One thread for each point. The first row of blocks sums the gradient by the point, over waves and levels
//                    in a fixed order. Each further row adds the gradients by the features of one level to the table by
//                    atomics, on Hopper and later up to 16 bytes at a time; the order of these additions, and with it the last
//                    bits of v_table, differs from run to run. A point whose gradient is zero adds nothing: those that fill up
//                    a capacity all lie in one place, and would wait for each other.
// Rows of the table are read and added to 4 or 2 numbers at a time where their length allows it.
#include "snarf/places.h"
#include "snarf/slope.h"
#include "snarf/waves.h"

namespace snarf {
namespace SNARF_ISA {

constexpr int kEncodingLevels = 32;  // the argument has to stay below 4 KB

struct Encoding {
  const float* points;       // [N, 3], metres
  const float* frequencies;  // [K], radians per metre
  const float* table;        // [R, F], aligned to 16 bytes
  float* out;                // [N, size]: x, sin(k x) for each k, cos(k x) for each k, features of each level
  const float* v_out;        // [N, size], on the way back, where `out` is given
  float* v_points;           // [N, 3], or null
  float* v_table;            // [R, F], zero, aligned to 16 bytes, or null
  long long count;           // N
  FeatureLevel levels[kEncodingLevels];
  int frequency_count, level_count, features;
};

__device__ int encoded_size(const Encoding& a) { return 3 + 6 * a.frequency_count + a.level_count * a.features; }
__device__ int features_at(const Encoding& a, int level) { return 3 + 6 * a.frequency_count + level * a.features; }

template <int W>
struct Width {
  static constexpr int value = W;
};

// Calls use(width) with the largest number of features that always lie side by side, aligned to their size.
template <class Use>
__device__ void with_width(int features, const Use& use) {
  if (features % 4 == 0)
    use(Width<4>());
  else if (features % 2 == 0)
    use(Width<2>());
  else
    use(Width<1>());
}

// Features of a row that are read at once.
template <int W>
struct alignas(4 * W) Some {
  float v[W];
};

template <int W>
__device__ Some<W> some_of_row(const Encoding& a, unsigned row, int first) {
  return *(const Some<W>*)(a.table + (long long)row * a.features + first);
}

// ---------------------------------------------------------------- forward
__device__ void put_waves(const Encoding& a, const float* point, int frequency, float* out) {
  float* const sines = out + 3 + 3 * frequency;
  float* const cosines = sines + 3 * a.frequency_count;
  for (int axis = 0; axis < 3; ++axis) {
    float sine, cosine;
    sine_cosine(point[axis] * a.frequencies[frequency], sine, cosine);
    sines[axis] = sine;
    cosines[axis] = cosine;
  }
}

template <int W>
__device__ void put_features(const Encoding& a, const Place& place, float* out) {
  float weights[8];
  corner_weights(place, weights);
  for (int f = 0; f < a.features; f += W) {
    float sum[W] = {};
    SNARF_UNROLL
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      const Some<W> some = some_of_row<W>(a, place.row[k], f);
      for (int i = 0; i < W; ++i) sum[i] += weights[k] * some.v[i];
    }
    for (int i = 0; i < W; ++i) out[f + i] = sum[i];
  }
}

extern "C" __global__ void __launch_bounds__(256) encode_points(const Encoding a) {
  const long long item = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  const int parts = 1 + a.frequency_count + a.level_count;
  const long long n = item / parts;
  if (n >= a.count) return;
  const int part = int(item - n * parts), level = part - 1 - a.frequency_count;
  const float* const point = a.points + 3 * n;
  float* const out = a.out + n * encoded_size(a);
  if (part == 0) {
    for (int axis = 0; axis < 3; ++axis) out[axis] = point[axis];
  } else if (level < 0) {
    put_waves(a, point, part - 1, out);
  } else {
    float* const features = out + features_at(a, level);
    Place place;
    find_place(a.levels[level], point, place);
    if (place.is_inside)
      with_width(a.features, [&](auto width) { put_features<decltype(width)::value>(a, place, features); });
    else
      for (int f = 0; f < a.features; ++f) features[f] = 0.f;
  }
}

// ---------------------------------------------------------------- backward
template <int W>
__device__ void add_along(const Encoding& a, const Place& place, const float* given, float* along) {
  for (int f = 0; f < a.features; f += W) {
    SNARF_UNROLL
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      const Some<W> some = some_of_row<W>(a, place.row[k], f);
      for (int i = 0; i < W; ++i) along[k] += given[f + i] * some.v[i];
    }
  }
}

__device__ void sum_of_point(const Encoding& a, long long n) {
  const float* const given = a.v_out + n * encoded_size(a);
  const float* const value = a.out + n * encoded_size(a);  // sines and cosines are each other's slopes
  const int waves = 3 * a.frequency_count;
  float total[3];
  for (int axis = 0; axis < 3; ++axis) {
    total[axis] = given[axis];
    for (int f = 0; f < a.frequency_count; ++f) {
      const int sine = 3 + 3 * f + axis, cosine = sine + waves;
      total[axis] += a.frequencies[f] * (given[sine] * value[cosine] - given[cosine] * value[sine]);
    }
  }
  for (int level = 0; level < a.level_count; ++level) {
    Place place;
    find_place(a.levels[level], a.points + 3 * n, place);
    if (!place.is_inside) continue;
    float along[8] = {};
    const float* const of_level = given + features_at(a, level);
    with_width(a.features, [&](auto width) { add_along<decltype(width)::value>(a, place, of_level, along); });
    add_slope(a.levels[level], place, along, total);
  }
  for (int axis = 0; axis < 3; ++axis) a.v_points[3 * n + axis] = total[axis];
}

__device__ void add_some(float* at, const Some<1>& some) { atomicAdd(at, some.v[0]); }
template <int W>
__device__ void add_some(float* at, const Some<W>& some) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  if (W == 4) {
    atomicAdd((float4*)at, *(const float4*)some.v);
    return;
  }
  if (W == 2) {
    atomicAdd((float2*)at, *(const float2*)some.v);
    return;
  }
#endif
  for (int i = 0; i < W; ++i) atomicAdd(at + i, some.v[i]);
}

template <int W>
__device__ void spread(const Encoding& a, const Place& place, const float* given) {
  float weights[8];
  corner_weights(place, weights);
  for (int f = 0; f < a.features; f += W) {
    Some<W> gradient;
    bool is_zero = true;
    for (int i = 0; i < W; ++i) {
      gradient.v[i] = given[f + i];
      is_zero &= gradient.v[i] == 0.f;
    }
    if (is_zero) continue;
    SNARF_UNROLL
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      Some<W> share;
      for (int i = 0; i < W; ++i) share.v[i] = weights[k] * gradient.v[i];
      add_some(a.v_table + (long long)place.row[k] * a.features + f, share);
    }
  }
}

extern "C" __global__ void __launch_bounds__(256) encode_backward(const Encoding a) {
  const long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (n >= a.count) return;
  const int level = int(blockIdx.y) - (a.v_points ? 1 : 0);
  if (level < 0) {
    sum_of_point(a, n);
    return;
  }
  Place place;
  find_place(a.levels[level], a.points + 3 * n, place);
  if (!place.is_inside) return;
  const float* const given = a.v_out + n * encoded_size(a) + features_at(a, level);
  with_width(a.features, [&](auto width) { spread<decltype(width)::value>(a, place, given); });
}

}  // namespace SNARF_ISA
}  // namespace snarf
