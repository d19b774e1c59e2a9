// The canonical occupancy network (snarfcli/shape/network.py) without gradients, in one kernel.
//
// DESIGN. A block takes kRows points through all layers. Its first part encodes them into shared memory, an encoding or a level
// of a feature grid per thread and point. Then each warp computes 32 outputs of each layer for all points of the block
// (products.cuh): the values of a layer stay in shared memory, its sums in registers, and every weight is read once per block,
// from L2 straight into the registers of the one warp that uses it. The last layer has one output: its products are summed
// where the last sums are. Nothing depends on the other points of a block. The last block repeats the last point.
//   pack_*      brings weights into the order of products.cuh, with weight norm folded; before every evaluation: it takes a few
//               microseconds, and so neither a training step nor a CUDA graph can leave old weights behind.
//   evaluate_*  one per precision and number of points. The pose is a few inputs of one layer: its code, or the sum of the
//               codes of its parts by the shares that a point sees of them.
#include "products.cuh"
#include "snarf/places.h"
#include "snarf/segments.h"
#include "snarf/waves.h"

namespace snarf {
namespace SNARF_ISA {

constexpr int kMostLayers = 16;  // without the last
constexpr int kMostLevels = 8;
constexpr int kPackingThreads = 128;

struct Packing {
  const float* weights[kMostLayers + 1];  // [outputs, inputs] of each layer
  const float* lengths[kMostLayers + 1];  // [outputs], of the rows of the weights: they are scaled to them; or null
  const float* biases[kMostLayers + 1];
  void* packed;                          // see products.cuh, all layers but the last one after the other
  float* packed_biases;                  // [layers, width]
  float* last;                           // [width + encoded + 1], weights of the last layer, and its bias
  int layers, point_layers, code_layer;  // as in Evaluation
  int width, encoded, codes;             // padded
  int hidden_count, encoded_count, code_count;
};

struct Evaluation {
  const float* points;       // [N, 3], metres
  const long long* pose;     // [N]
  const float* seen;         // [N, P], share of each part of the condition at each point; or null: one part, seen by all
  const float* part_codes;   // [B, P, K]
  const float* code_bias;    // [K], or null
  const float* frequencies;  // radians per metre, [frequency_count]
  const float* table;        // [R, features], aligned to 16 bytes
  const float* segments;     // bones, [S, 6], metres
  const void* weights;       // as `Packing` has them
  const float* biases;
  const float* last;
  float* out;       // [N]
  long long count;  // N
  FeatureLevel levels[kMostLevels];
  Activation activation;
  float radius, slope;        // slope * (radius - distance to the nearest segment) is added
  int layers;                 // without the last
  int point_layers;           // bit l: layer l takes the encoded point; the first does
  int code_layer;             // the layer that takes the pose code, or -1
  int width, encoded, codes;  // numbers of values, padded
  int code_count, parts, poses, frequency_count, level_count, features, segment_count;
};

// ---------------------------------------------------------------- weights
// Numbers of inputs of a layer, of all kinds together and padded.
template <class Arguments>
__device__ int padded_inputs(const Arguments& a, int layer) {
  return (layer ? a.width : 0) + (a.point_layers >> layer & 1 ? a.encoded : 0) + (layer == a.code_layer ? a.codes : 0);
}

// The factor that gives a row of weights the length that it should have. All threads of a block call this.
__device__ float scale_to_length(const float* row, int count, const float* length) {
  __shared__ float squares[kPackingThreads];
  float sum = 0.f;
  for (int i = int(threadIdx.x); i < count; i += int(blockDim.x)) sum += row[i] * row[i];
  squares[threadIdx.x] = sum;
  __syncthreads();
  sum = 0.f;
  for (int i = 0; i < int(blockDim.x); ++i) sum += squares[i];
  return *length / sqrtf(sum);
}

// One block per output (x) of each layer (y).
template <class Sums>
__device__ void pack(const Packing& a) {
  const int output = int(blockIdx.x), layer = int(blockIdx.y);
  const bool is_last = layer == a.layers, is_real = output < (is_last ? 1 : a.hidden_count);
  if (is_last && !is_real) return;
  const bool takes_point = a.point_layers >> layer & 1;
  const int hidden = layer ? a.width : 0, encoded = takes_point ? a.encoded : 0;
  const int hidden_count = layer ? a.hidden_count : 0, encoded_count = takes_point ? a.encoded_count : 0;
  const int code_count = layer == a.code_layer ? a.code_count : 0;
  const int count = hidden_count + encoded_count + code_count, inputs = padded_inputs(a, layer);
  const float* const row = is_real ? a.weights[layer] + (long long)output * count : nullptr;
  const float scale = is_real && a.lengths[layer] ? scale_to_length(row, count, a.lengths[layer] + output) : 1.f;
  const float joined = layer && takes_point ? 0.70710678f : 1.f;  // where the point joins again, both parts count half
  long long before = 0;
  for (int l = 0; l < layer; ++l) before += (long long)a.width * padded_inputs(a, l);
  typename Sums::Value* const packed = (typename Sums::Value*)a.packed + before;
  for (int input = int(threadIdx.x); input < inputs; input += int(blockDim.x)) {
    float value = 0.f;
    if (is_real) {
      const int in_code = input - hidden - encoded, in_point = input - hidden;
      if (in_code >= 0)
        value = in_code < code_count ? row[hidden_count + encoded_count + in_code] * scale : 0.f;
      else if (in_point >= 0)
        value = in_point < encoded_count ? row[hidden_count + in_point] * scale * joined : 0.f;
      else
        value = input < hidden_count ? row[input] * scale * joined : 0.f;
    }
    if (is_last)
      a.last[input] = value;
    else
      Sums::put_weight(packed, inputs, input, output, value);
  }
  if (threadIdx.x) return;
  const float bias = is_real ? a.biases[layer][output] : 0.f;
  if (is_last)
    a.last[a.width + a.encoded] = bias;
  else
    a.packed_biases[layer * a.width + output] = bias;
}

// ---------------------------------------------------------------- inputs
// The features of one level at a point.
template <class Sums>
__device__ void put_features(const Evaluation& a, int level, const float* x, int first, int row,
                             typename Sums::Value* encoded) {
  Place place;
  float weights[8];
  find_place(a.levels[level], x, place);
  if (place.is_inside) corner_weights(place, weights);
  for (int f = 0; f < a.features; f += 4) {
    float sum[4] = {0.f, 0.f, 0.f, 0.f};
    const int here = a.features - f < 4 ? a.features - f : 4;
    if (place.is_inside) {
      SNARF_UNROLL
      for (int k = 0; k < 8; ++k) {
        if (place.row[k] == kNoRow) continue;
        const float* const from = a.table + (long long)place.row[k] * a.features + f;
        if (a.features % 4 == 0) {
          const float4 four = __ldg((const float4*)from);
          sum[0] += weights[k] * four.x, sum[1] += weights[k] * four.y;
          sum[2] += weights[k] * four.z, sum[3] += weights[k] * four.w;
        } else {
          SNARF_UNROLL
          for (int i = 0; i < 4; ++i)
            if (i < here) sum[i] += weights[k] * from[i];
        }
      }
    }
    SNARF_UNROLL
    for (int i = 0; i < 4; ++i)
      if (i < here) Sums::put(encoded, first + f + i, row, sum[i]);
  }
}

// One number of the pose code of point n.
__device__ float code_of(const Evaluation& a, long long n, int k) {
  const long long pose = a.pose[n] < 0 ? 0 : a.pose[n] < a.poses ? a.pose[n] : a.poses - 1;  // rows of padding have any
  const float* const codes = a.part_codes + pose * a.parts * a.code_count + k;
  float code = a.code_bias ? a.code_bias[k] : 0.f;
  if (!a.seen) return code + codes[0];
  for (int p = 0; p < a.parts; ++p) code += a.seen[n * a.parts + p] * codes[p * a.code_count];
  return code;
}

// Writes what a layer takes besides the layer before, for points from `first` on, and the prior of the logits, [kRows].
template <class Sums>
__device__ void prepare(const Evaluation& a, long long first, typename Sums::Value* encoded, typename Sums::Value* codes,
                        float* prior) {
  const int waves = 3 * a.frequency_count, with_waves = 1 + a.frequency_count, with_levels = with_waves + a.level_count;
  const int tasks = with_levels + (a.code_layer < 0 ? 0 : a.code_count);
  for (int item = int(threadIdx.x); item < tasks * Sums::kRows; item += int(blockDim.x)) {
    const int task = item / Sums::kRows, row = item % Sums::kRows;
    const long long n = first + row < a.count ? first + row : a.count - 1;
    const float x[3] = {a.points[3 * n], a.points[3 * n + 1], a.points[3 * n + 2]};
    if (task == 0) {
      for (int axis = 0; axis < 3; ++axis) Sums::put(encoded, axis, row, x[axis]);
      for (int k = 3 + 2 * waves + a.level_count * a.features; k < a.encoded; ++k) Sums::put(encoded, k, row, 0.f);
      if (a.code_layer >= 0)
        for (int k = a.code_count; k < a.codes; ++k) Sums::put(codes, k, row, 0.f);
      prior[row] = 0.f;
      if (a.segment_count) {
        const float squared = squared_distance_to_segments<float>(x, a.segments, a.segment_count, nullptr);
        prior[row] = a.slope * (a.radius - sqrtf(larger(squared, 1e-12f)));
      }
    } else if (task < with_waves) {
      for (int axis = 0; axis < 3; ++axis) {
        float sine, cosine;
        sine_cosine(x[axis] * a.frequencies[task - 1], sine, cosine);
        Sums::put(encoded, 3 * task + axis, row, sine);
        Sums::put(encoded, waves + 3 * task + axis, row, cosine);
      }
    } else if (task < with_levels) {
      const int level = task - with_waves;
      put_features<Sums>(a, level, x, 3 + 2 * waves + level * a.features, row, encoded);
    } else {
      Sums::put(codes, task - with_levels, row, code_of(a, n, task - with_levels));
    }
  }
}

// ---------------------------------------------------------------- the network
template <class Sums>
__device__ __forceinline__ void evaluate(const Evaluation& a) {
  typedef typename Sums::Value Value;
  constexpr int rows = Sums::kRows;
  Value* const hidden = (Value*)dynamic_memory();
  Value* const encoded = hidden + a.width * rows;
  Value* const codes = encoded + a.encoded * rows;
  float* const prior = (float*)(codes + a.codes * rows);
  float* const parts = (float*)hidden;  // [warps, 4, rows], after the last layer but one
  const long long first = (long long)blockIdx.x * rows;
  const int warp = int(threadIdx.x) / 32;
  prepare<Sums>(a, first, encoded, codes, prior);
  __syncthreads();
  const Value* weights = (const Value*)a.weights;
  for (int layer = 0; layer < a.layers; ++layer) {
    const int inputs = padded_inputs(a, layer);
    const Value* mine = weights + (long long)warp * kColumns * inputs;
    Sums sums;
    sums.start(a.biases + layer * a.width + warp * kColumns);
    if (layer) {
      sums.add(mine, hidden, a.width);
      mine += kColumns * a.width;
    }
    if (a.point_layers >> layer & 1) {
      sums.add(mine, encoded, a.encoded);
      mine += kColumns * a.encoded;
    }
    if (layer == a.code_layer) sums.add(mine, codes, a.codes);
    sums.activate(a.activation);
    __syncthreads();  // no warp reads the values before
    if (layer + 1 < a.layers)
      sums.store(hidden, warp);
    else
      sums.reduce(a.last + warp * kColumns, parts + 4 * warp * rows);
    __syncthreads();
    weights += (long long)a.width * inputs;
  }
  for (int row = int(threadIdx.x); row < rows && first + row < a.count; row += int(blockDim.x)) {
    float logit = a.last[a.width + a.encoded];
    for (int p = 0; p < a.width / 8; ++p) logit += parts[p * rows + row];
    if (a.point_layers >> a.layers & 1)
      for (int k = 0; k < a.encoded; ++k) logit += Sums::get(encoded, k, row) * a.last[a.width + k];
    a.out[first + row] = logit + prior[row];
  }
}

extern "C" __global__ void __launch_bounds__(128) pack_float32(const Packing a) { pack<Scalars<64>>(a); }
extern "C" __global__ void __launch_bounds__(256) evaluate_float32_128(const Evaluation a) { evaluate<Scalars<128>>(a); }
extern "C" __global__ void __launch_bounds__(384) evaluate_float32_64(const Evaluation a) { evaluate<Scalars<64>>(a); }

#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 800
extern "C" __global__ void __launch_bounds__(128) pack_tf32(const Packing a) { pack<Tensors<64, Tf32>>(a); }
extern "C" __global__ void __launch_bounds__(256) evaluate_tf32_128(const Evaluation a) { evaluate<Tensors<128, Tf32>>(a); }
extern "C" __global__ void __launch_bounds__(384) evaluate_tf32_64(const Evaluation a) { evaluate<Tensors<64, Tf32>>(a); }

extern "C" __global__ void __launch_bounds__(128) pack_bfloat16(const Packing a) { pack<Tensors<64, Bfloat16>>(a); }
extern "C" __global__ void __launch_bounds__(256) evaluate_bfloat16_128(const Evaluation a) {
  evaluate<Tensors<128, Bfloat16>>(a);
}
extern "C" __global__ void __launch_bounds__(384) evaluate_bfloat16_64(const Evaluation a) {
  evaluate<Tensors<64, Bfloat16>>(a);
}
#endif

}  // namespace SNARF_ISA
}  // namespace snarf
