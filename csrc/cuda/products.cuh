// A layer's sums in the registers of a warp, and the values and weights that they are made of, in three precisions.
//
// DESIGN. A warp computes kColumns outputs of a layer for the kRows points of its block. A lane's sums become the next layer's
// inputs in shared memory; values and weights lie there and in device memory in the order in which lanes read them, 16 bytes at
// a time and without bank conflicts. Numbers of inputs are multiples of kPadding, filled with zeros.
//
// Values of kRows points:
//   float     [input][row]
//   TF32      [inputs / 8][kRows / 16][lane][4 words], the left matrices of tensor_cores.cuh. Inner index t stands for input
//             2 t, and t + 4 for 2 t + 1, so that a lane's sums are its own words of the next layer's left matrix.
//   bfloat16  [inputs / 16][kRows / 16][lane][4 words], where that is so with the inner indices as they are.
// Weights of all inputs of a layer, 32 numbers an input, so that those of some inputs begin at 32 times the first:
//   float     [outputs / 32][input][32 outputs]
//   TF32      [outputs / 32][inputs / 8][2][lane][4 words], two right matrices, and two more
//   bfloat16  [outputs / 32][inputs / 16][2][lane][4 words]
#pragma once

#include "tensor_cores.cuh"

namespace snarf {
namespace SNARF_ISA {

constexpr int kColumns = 32;  // outputs of a warp
constexpr int kPadding = 16;

struct Activation {
  int kind;                           // 1: ReLU, 2: softplus
  float binary_decay, per_sharpness;  // -sharpness / log(2), 1 / sharpness
};

// NaN stays NaN.
__device__ __forceinline__ float relu(float x) { return x <= 0.f ? 0.f : x; }

// log(1 + e^(sharpness x)) / sharpness, to 2.4e-7 / sharpness.
__device__ __forceinline__ float softplus(float x, const Activation& activation) {
  const float e = power_of_two(absolute(x) * activation.binary_decay);
  float series = -0.00878329761f;  // log(1 + e) / e on [0, 1], fitted for the smallest of largest errors
  series = series * e + 0.0449444465f;
  series = series * e - 0.108857907f;
  series = series * e + 0.178255051f;
  series = series * e - 0.245235845f;
  series = series * e + 0.332801729f;
  series = series * e - 0.499976993f;
  series = series * e + 0.999999821f;
  return relu(x) + series * e * activation.per_sharpness;
}

template <int count>
__device__ __forceinline__ void activate_all(float* sums, const Activation& activation) {
  if (activation.kind == 1) {
    SNARF_UNROLL
    for (int i = 0; i < count; ++i) sums[i] = relu(sums[i]);
  } else {
    SNARF_UNROLL
    for (int i = 0; i < count; ++i) sums[i] = softplus(sums[i], activation);
  }
}

// The sums of 32-bit products. A lane has points 32 i + 4 (lane / 4) + 0 .. 3, and eight outputs from 8 (lane % 4).
template <int rows>
class Scalars {
 public:
  typedef float Value;
  static constexpr int kRows = rows;

  __device__ static void put(float* values, int input, int row, float value) { values[input * kRows + row] = value; }
  __device__ static float get(const float* values, int input, int row) { return values[input * kRows + row]; }
  __device__ static void put_weight(float* weights, int inputs, int input, int output, float value) {
    weights[((long long)(output / kColumns) * inputs + input) * kColumns + output % kColumns] = value;
  }

  __device__ __forceinline__ void start(const float* bias) {
    SNARF_UNROLL
    for (int c = 0; c < 8; ++c) {
      const float first = bias[8 * (lane() % 4) + c];
      SNARF_UNROLL
      for (int r = 0; r < kRows / 8; ++r) sums_[r][c] = first;
    }
  }

  __device__ __forceinline__ void add(const float* weights, const float* values, int inputs) {
    const float4* const from = (const float4*)weights + 2 * (lane() % 4);
    const float4* const points = (const float4*)values + lane() / 4;
    float4 next[2 * kAhead];
    load(from, next);
    for (int k = 0; k < inputs; k += kAhead) {
      float4 now[2 * kAhead];
      SNARF_UNROLL
      for (int i = 0; i < 2 * kAhead; ++i) now[i] = next[i];
      if (k + kAhead < inputs) load(from + (k + kAhead) * (kColumns / 4), next);
      SNARF_UNROLL
      for (int a = 0; a < kAhead; ++a) {
        const float4 low = now[2 * a], high = now[2 * a + 1];
        const float weight[8] = {low.x, low.y, low.z, low.w, high.x, high.y, high.z, high.w};
        SNARF_UNROLL
        for (int i = 0; i < kRows / 32; ++i) {
          const float4 four = points[(k + a) * (kRows / 4) + 8 * i];
          const float value[4] = {four.x, four.y, four.z, four.w};
          SNARF_UNROLL
          for (int j = 0; j < 4; ++j) SNARF_UNROLL
          for (int c = 0; c < 8; ++c) sums_[4 * i + j][c] += value[j] * weight[c];
        }
      }
    }
  }

  __device__ __forceinline__ void activate(const Activation& activation) { activate_all<kRows>(sums_[0], activation); }

  // Writes the sums as the inputs of the next layer.
  __device__ __forceinline__ void store(float* values, int warp) const {
    float4* const to = (float4*)(values + (kColumns * warp + 8 * (lane() % 4)) * kRows) + lane() / 4;
    SNARF_UNROLL
    for (int c = 0; c < 8; ++c) SNARF_UNROLL
    for (int i = 0; i < kRows / 32; ++i)
      to[c * (kRows / 4) + 8 * i] = float4{sums_[4 * i][c], sums_[4 * i + 1][c], sums_[4 * i + 2][c], sums_[4 * i + 3][c]};
  }

  // Writes the products of the sums with weights [32], added up over a lane's outputs, to parts [4, kRows].
  __device__ __forceinline__ void reduce(const float* weights, float* parts) const {
    float* const to = parts + (lane() % 4) * kRows + 4 * (lane() / 4);
    SNARF_UNROLL
    for (int r = 0; r < kRows / 8; ++r) {
      float sum = 0.f;
      SNARF_UNROLL
      for (int c = 0; c < 8; ++c) sum += sums_[r][c] * weights[8 * (lane() % 4) + c];
      to[32 * (r / 4) + r % 4] = sum;
    }
  }

 private:
  static constexpr int kAhead = 2;  // inputs whose weights are on their way while those before are used

  __device__ static int lane() { return int(threadIdx.x) % 32; }
  __device__ __forceinline__ static void load(const float4* from, float4* to) {
    SNARF_UNROLL
    for (int a = 0; a < kAhead; ++a) {
      to[2 * a] = __ldg(from + a * (kColumns / 4));
      to[2 * a + 1] = __ldg(from + a * (kColumns / 4) + 1);
    }
  }

  float sums_[kRows / 8][8];
};

#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 800
// Where an inner index of a matrix is: in which of a row's four lanes, in which half, and in which part of the word.
struct InWord {
  int lane, half, part;
};

struct Tf32 {
  typedef unsigned Value;
  static constexpr int kInner = 8, kParts = 1;  // of an instruction; of a word
  __device__ static InWord find(int input) { return {input / 2, input % 2, 0}; }
  __device__ static unsigned rounded(float value) { return rounded_to_tf32(value); }
  __device__ static float number(unsigned value) { return __uint_as_float(value); }
  // The left matrix that sums[0] is, of kInner outputs.
  __device__ __forceinline__ static uint4 left_of(const float (*sums)[4]) {
    return uint4{rounded(sums[0][0]), rounded(sums[0][2]), rounded(sums[0][1]), rounded(sums[0][3])};
  }
};

struct Bfloat16 {
  typedef unsigned short Value;
  static constexpr int kInner = 16, kParts = 2;
  __device__ static InWord find(int input) { return {input % 8 / 2, input / 8, input % 2}; }
  __device__ static unsigned short rounded(float value) { return (unsigned short)rounded_to_bfloat16(value, 0.f); }
  __device__ static float number(unsigned short value) { return __uint_as_float((unsigned)value << 16); }
  // The left matrix that sums[0] and sums[1] are.
  __device__ __forceinline__ static uint4 left_of(const float (*sums)[4]) {
    return uint4{rounded_to_bfloat16(sums[0][0], sums[0][1]), rounded_to_bfloat16(sums[0][2], sums[0][3]),
                 rounded_to_bfloat16(sums[1][0], sums[1][1]), rounded_to_bfloat16(sums[1][2], sums[1][3])};
  }
};

// The sums of products by tensor cores, laid out as in tensor_cores.cuh.
template <int rows, class Kind>
class Tensors {
 public:
  typedef typename Kind::Value Value;
  static constexpr int kRows = rows;

  __device__ static void put(Value* values, int input, int row, float value) { values[at(input, row)] = Kind::rounded(value); }
  __device__ static float get(const Value* values, int input, int row) { return Kind::number(values[at(input, row)]); }
  __device__ static void put_weight(Value* weights, int inputs, int input, int output, float value) {
    const InWord in = Kind::find(input % Kind::kInner);
    const int tile = input / Kind::kInner, n = output % kColumns / 8;
    const long long pair = ((long long)(output / kColumns) * (inputs / Kind::kInner) + tile) * 2 + n / 2;
    const long long word = (pair * 32 + 4 * (output % 8) + in.lane) * 4 + 2 * (n % 2) + in.half;
    weights[Kind::kParts * word + in.part] = Kind::rounded(value);
  }

  __device__ __forceinline__ void start(const float* bias) {
    SNARF_UNROLL
    for (int n = 0; n < 4; ++n) SNARF_UNROLL
    for (int r = 0; r < 2; ++r) {
      const float first = bias[column(n, r)];
      SNARF_UNROLL
      for (int m = 0; m < kTall; ++m) sums_[m][n][r] = sums_[m][n][r + 2] = first;
    }
  }

  __device__ __forceinline__ void add(const Value* weights, const Value* values, int inputs) {
    const uint4* from = (const uint4*)weights + lane();
    const uint4* points = (const uint4*)values + lane();
    uint4 next[2] = {__ldg(from), __ldg(from + 32)};
    for (int left = inputs / Kind::kInner; left > 0; --left) {
      const uint4 now[2] = {next[0], next[1]};
      from += 64;
      if (left > 1) next[0] = __ldg(from), next[1] = __ldg(from + 32);
      uint4 value[kTall];
      SNARF_UNROLL
      for (int m = 0; m < kTall; ++m) value[m] = points[32 * m];
      points += 32 * kTall;
      add_products<Kind, kTall>(sums_, value, now);
    }
  }

  __device__ __forceinline__ void activate(const Activation& activation) { activate_all<kRows>(sums_[0][0], activation); }

  __device__ __forceinline__ void store(Value* values, int warp) const {
    constexpr int tiles = kColumns / Kind::kInner;
    uint4* const to = (uint4*)values + (long long)tiles * warp * kTall * 32 + lane();
    SNARF_UNROLL
    for (int tile = 0; tile < tiles; ++tile) SNARF_UNROLL
    for (int m = 0; m < kTall; ++m) to[(tile * kTall + m) * 32] = Kind::left_of(sums_[m] + tile * (4 / tiles));
  }

  __device__ __forceinline__ void reduce(const float* weights, float* parts) const {
    SNARF_UNROLL
    for (int m = 0; m < kTall; ++m) SNARF_UNROLL
    for (int lower = 0; lower < 2; ++lower) {
      float sum = 0.f;
      SNARF_UNROLL
      for (int n = 0; n < 4; ++n) SNARF_UNROLL
      for (int r = 0; r < 2; ++r) sum += sums_[m][n][2 * lower + r] * weights[column(n, r)];
      parts[(lane() % 4) * kRows + 16 * m + 8 * lower + lane() / 4] = sum;
    }
  }

 private:
  static constexpr int kTall = kRows / 16;

  __device__ static int lane() { return int(threadIdx.x) % 32; }
  __device__ static int column(int n, int r) { return 8 * n + 2 * (lane() % 4) + r; }
  __device__ static int at(int input, int row) {
    const InWord in = Kind::find(input % Kind::kInner);
    const int matrix = input / Kind::kInner * kTall + row / 16;
    const int word = (matrix * 32 + 4 * (row % 8) + in.lane) * 4 + 2 * in.half + row % 16 / 8;
    return Kind::kParts * word + in.part;
  }

  float sums_[kTall][4][4];
};
#endif

}  // namespace SNARF_ISA
}  // namespace snarf
