// Forward and backward of a fully connected network and of the encoding before it, compiled once per instruction set.
//
// DESIGN. A tile of points runs through all layers while it is in the second-level cache. The way forward saves the activations
// of the hidden layers; the way back reads each once. All three products (W x, W^T d, and d x^T summed over the tile's points)
// are the same loop over sums that stay in registers: six rows by a few packs, a broadcast per row, no horizontal sums. Only
// for d x^T the inputs are transposed first, so that there, too, one lane is one column.
#include "capsules.h"
#include "features.h"
#include "layer.h"
#include "snarf/waves.h"
#include "optimizer.h"
#include "pose_code.h"
#include "training_task.h"
#include "variation.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

constexpr int L = V::width;

// sums[i][p] += a[k * next + i * apart] * b[k * ldb + p] for all k.
template <int P>
SNARF_HD void accumulate(const float* a, int64_t next, int64_t apart, const float* b, int64_t ldb, int count, V (*sums)[P]) {
  for (int k = 0; k < count; ++k, a += next, b += ldb) {
    V value[P];
    SNARF_UNROLL
    for (int p = 0; p < P; ++p) value[p] = load<float>(b + p * L);
    SNARF_UNROLL
    for (int i = 0; i < kOutputs; ++i) {
      const V factor(a[i * apart]);
      SNARF_UNROLL
      for (int p = 0; p < P; ++p) sums[i][p] = sums[i][p] + factor * value[p];
    }
  }
}

template <int P>
SNARF_HD void zero(V (*sums)[P]) {
  SNARF_UNROLL
  for (int i = 0; i < kOutputs; ++i) SNARF_UNROLL
  for (int p = 0; p < P; ++p) sums[i][p] = V(0.f);
}

// The derivative of an activation, from its value.
SNARF_HD V slope(V value, int activation, float sharpness) {
  if (activation == 1) return select(value > 0.f, V(1.f), V(0.f));
  return activation == 2 ? V(1.f) - decay(V(0.f) - value * sharpness) : V(1.f);
}

// [rows, columns] to [columns, rows], of which the latter lie `stride` apart; rows and columns are multiples of 4.
void transpose(const float* from, int64_t row, int rows, float* to, int64_t stride, int columns) {
#if defined(__GNUC__)
  typedef float Four __attribute__((vector_size(16)));
  typedef int32_t Order __attribute__((vector_size(16)));
  for (int c = 0; c < columns; c += 4)
    for (int r = 0; r < rows; r += 4) {
      Four in[4];
      for (int i = 0; i < 4; ++i) memcpy(&in[i], from + (r + i) * row + c, 16);
#if defined(__clang__)
      const Four a = __builtin_shufflevector(in[0], in[1], 0, 4, 1, 5), b = __builtin_shufflevector(in[0], in[1], 2, 6, 3, 7);
      const Four d = __builtin_shufflevector(in[2], in[3], 0, 4, 1, 5), e = __builtin_shufflevector(in[2], in[3], 2, 6, 3, 7);
      const Four out[4] = {__builtin_shufflevector(a, d, 0, 1, 4, 5), __builtin_shufflevector(a, d, 2, 3, 6, 7),
                           __builtin_shufflevector(b, e, 0, 1, 4, 5), __builtin_shufflevector(b, e, 2, 3, 6, 7)};
#else
      const Order low = {0, 4, 1, 5}, high = {2, 6, 3, 7}, first = {0, 1, 4, 5}, second = {2, 3, 6, 7};
      const Four a = __builtin_shuffle(in[0], in[1], low), b = __builtin_shuffle(in[0], in[1], high);
      const Four d = __builtin_shuffle(in[2], in[3], low), e = __builtin_shuffle(in[2], in[3], high);
      const Four out[4] = {__builtin_shuffle(a, d, first), __builtin_shuffle(a, d, second), __builtin_shuffle(b, e, first),
                           __builtin_shuffle(b, e, second)};
#endif
      for (int i = 0; i < 4; ++i) memcpy(to + (c + i) * stride + r, &out[i], 16);
    }
#else
  for (int c = 0; c < columns; ++c)
    for (int r = 0; r < rows; ++r) to[c * stride + r] = from[r * row + c];
#endif
}

// Rows first to first + kTile of an array [N, size] as [size, kTile]; rows beyond the last repeat it, or are zero.
void load_tile(const float* array, int64_t size, int64_t first, int64_t count, bool repeat, float* tile) {
  for (int i = 0; i < kTile; ++i) {
    const int64_t row = first + i < count ? first + i : count - 1;
    const float* const from = array + row * size;
    const float factor = repeat || first + i < count ? 1.f : 0.f;
    for (int64_t k = 0; k < size; ++k) tile[k * kTile + i] = factor ? from[k] : 0.f;
  }
}

void store_tile(const float* tile, int64_t size, int64_t first, int64_t count, float* array) {
  for (int i = 0; i < kTile && first + i < count; ++i)
    for (int64_t k = 0; k < size; ++k) array[(first + i) * size + k] = tile[k * kTile + i];
}

void forward(const TrainingTask& task, int64_t first, int64_t last, float* scratch) {
  float* const inputs = scratch;
  float* const extras = inputs + int64_t(kTile) * task.first_count;
  float* const out = extras + int64_t(kTile) * task.extra_count;
  for (int64_t tile = first; tile < last; ++tile) {
    load_tile(task.first, task.first_count, tile * kTile, task.count, true, inputs);
    load_tile(task.extras, task.extra_count, tile * kTile, task.count, true, extras);
    float* const saved = task.saved + tile * task.saved_size;
    const float* hidden = nullptr;
    for (int n = 0; n < task.layer_count; ++n) {
      const TrainedLayer& layer = task.layers[n];
      float* const values = n + 1 < task.layer_count ? saved + layer.saved : out;
      run_layer(layer.forward, hidden, inputs, extras, task.sharpness, values);
      hidden = values;
    }
    store_tile(out, task.layers[task.layer_count - 1].real_outputs, tile * kTile, task.count, task.out);
  }
}

// Transposed inputs lie in panels of kPanel columns, [columns / kPanel, kTile, kPanel], so that a panel stays in the
// first-level cache while all rows of the gradient pass over it.
constexpr int kPanel = kPacks * L;

// Adds gradient [kOutputs, kTile] times a panel's columns, P packs of them, to `sums`, whose rows lie `stride` apart.
template <int P>
SNARF_HD void add_outer(const float* gradient, const float* panel, float* sums, int64_t stride) {
  V part[kOutputs][P];
  zero<P>(part);
  accumulate<P>(gradient, 1, kTile, panel, kPanel, kTile, part);
  SNARF_UNROLL
  for (int i = 0; i < kOutputs; ++i) SNARF_UNROLL
  for (int p = 0; p < P; ++p) {
    float* const at = sums + i * stride + p * L;
    store(at, load<float>(at) + part[i][p]);
  }
}

void add_weight_gradient(const TrainedLayer& layer, const float* gradient, const float* panels, float* gradients) {
  for (int c = 0; c < layer.columns; c += kPanel) {
    const float* const panel = panels + int64_t(c) * kTile;
    for (int r = 0; r < layer.forward.outputs; r += kOutputs) {
      float* const sums = gradients + layer.weights_at + int64_t(r) * layer.columns + c;
      const float* const rows = gradient + int64_t(r) * kTile;
      if (c + kPanel <= layer.columns)
        add_outer<kPacks>(rows, panel, sums, layer.columns);
      else
        for (int p = 0; c + p * L < layer.columns; ++p) add_outer<1>(rows, panel + p * L, sums + p * L, layer.columns);
    }
  }
  for (int r = 0; r < layer.forward.outputs; ++r) {
    V sum(0.f);
    for (int i = 0; i < kTile; i += L) sum = sum + load<float>(gradient + int64_t(r) * kTile + i);
    float total = 0;
    for (int lane = 0; lane < L; ++lane) total += sum[lane];
    gradients[layer.bias_at + r] += total;
  }
}

// Lays the inputs of a layer, rows of [count, kTile], into the panels from column `at` on.
void add_to_panels(const float* rows, int count, int at, float* panels) {
  int r = 0;
  while (r < count) {
    const int column = at + r, inside = column % kPanel;
    float* const to = panels + int64_t(column / kPanel) * kPanel * kTile + inside;
    const int room = kPanel - inside, left = count - r;
    const int whole = (left < room ? left : room) / 4 * 4;
    if (whole) {
      transpose(rows + int64_t(r) * kTile, kTile, whole, to, kPanel, kTile);
      r += whole;
    } else {
      for (int i = 0; i < kTile; ++i) to[int64_t(i) * kPanel] = rows[int64_t(r) * kTile + i];
      ++r;
    }
  }
}

// out [count, kTile] (+)= W^T gradient for `count` inputs whose columns of W start at `weights`.
template <class Store>
SNARF_HD void back_product(const TrainedLayer& layer, const float* weights, int count, const float* gradient,
                           const Store& store_at) {
  for (int r = 0; r < count; r += kOutputs)
    for (int column = 0; column < kTile; column += kColumn) {
      V sums[kOutputs][kPacks];
      zero<kPacks>(sums);
      accumulate<kPacks>(weights + r, layer.back_stride, 1, gradient + column, kTile, layer.real_outputs, sums);
      for (int i = 0; i < kOutputs && r + i < count; ++i) SNARF_UNROLL
      for (int p = 0; p < kPacks; ++p) store_at(int64_t(r + i) * kTile + column + p * L, sums[i][p]);
    }
}

int padded(int count) { return (count + kOutputs - 1) / kOutputs * kOutputs; }

void backward(const TrainingTask& task, int64_t first, int64_t last, float* scratch, float* gradients) {
  const int64_t tile_size = kTile;
  float* const inputs = scratch;
  float* const extras = inputs + tile_size * task.first_count;
  float* const v_inputs = extras + tile_size * task.extra_count;
  float* const v_extras = v_inputs + tile_size * task.first_count;
  float* gradient = v_extras + tile_size * task.extra_count;
  float* next = gradient + tile_size * task.widest;
  float* const panels = next + tile_size * task.widest;
  for (int64_t tile = first; tile < last; ++tile) {
    load_tile(task.first, task.first_count, tile * kTile, task.count, true, inputs);
    load_tile(task.extras, task.extra_count, tile * kTile, task.count, true, extras);
    memset(v_inputs, 0, size_t(tile_size * (task.first_count + task.extra_count)) * sizeof(float));
    const TrainedLayer& top = task.layers[task.layer_count - 1];
    memset(gradient, 0, size_t(tile_size * top.forward.outputs) * sizeof(float));
    load_tile(task.v_out, top.real_outputs, tile * kTile, task.count, false, gradient);
    const float* const saved = task.saved + tile * task.saved_size;
    for (int n = task.layer_count - 1; n >= 0; --n) {
      const TrainedLayer& layer = task.layers[n];
      const float* const hidden = n ? saved + task.layers[n - 1].saved : nullptr;
      add_to_panels(hidden, layer.forward.hidden, 0, panels);
      add_to_panels(inputs, layer.forward.encoded, layer.forward.hidden, panels);
      add_to_panels(extras, layer.forward.extras, layer.forward.hidden + layer.forward.encoded, panels);
      const int used = layer.forward.hidden + layer.forward.encoded + layer.forward.extras;
      for (int c = used; c < layer.columns; ++c)
        for (int i = 0; i < kTile; ++i) panels[int64_t(c / kPanel * kTile + i) * kPanel + c % kPanel] = 0.f;
      add_weight_gradient(layer, gradient, panels, gradients);
      const float* weights = layer.back;
      if (n) {
        const int activation = task.layers[n - 1].forward.activation;
        const int outputs = task.layers[n - 1].forward.outputs;
        memset(next + tile_size * layer.forward.hidden, 0,
               size_t(tile_size * (outputs - layer.forward.hidden)) * sizeof(float));
        back_product(layer, weights, layer.forward.hidden, gradient, [&](int64_t place, V value) {
          store(next + place, value * slope(load<float>(hidden + place), activation, task.sharpness));
        });
      }
      weights += padded(layer.forward.hidden);
      if (layer.forward.encoded && task.v_first)
        back_product(layer, weights, layer.forward.encoded, gradient,
                     [&](int64_t place, V value) { store(v_inputs + place, load<float>(v_inputs + place) + value); });
      weights += padded(layer.forward.encoded);
      if (layer.forward.extras && task.v_extras)
        back_product(layer, weights, layer.forward.extras, gradient,
                     [&](int64_t place, V value) { store(v_extras + place, load<float>(v_extras + place) + value); });
      float* const before = gradient;
      gradient = next;
      next = before;
    }
    if (task.v_first) store_tile(v_inputs, task.first_count, tile * kTile, task.count, task.v_first);
    if (task.v_extras) store_tile(v_extras, task.extra_count, tile * kTile, task.count, task.v_extras);
  }
}

// ---------------------------------------------------------------- encoding
void encode(const EncodingTask& task, int64_t first, int64_t last) {
  const int waves = 3 * task.frequency_count, features = task.features, size = task.size();
  for (int64_t n = first; n < last; n += L) {
    const int count = int(last - n < L ? last - n : L);
    for (int axis = 0; axis < 3; ++axis) {
      float x[L], sines[L], cosines[L];
      for (int i = 0; i < L; ++i) x[i] = task.points[3 * (n + (i < count ? i : count - 1)) + axis];
      for (int i = 0; i < count; ++i) task.out[(n + i) * size + axis] = x[i];
      for (int f = 0; f < task.frequency_count; ++f) {
        V sine, cosine;
        sine_cosine(load<float>(x) * V(task.frequencies[f]), sine, cosine);
        store(sines, sine);
        store(cosines, cosine);
        for (int i = 0; i < count; ++i) {
          task.out[(n + i) * size + 3 + 3 * f + axis] = sines[i];
          task.out[(n + i) * size + 3 + waves + 3 * f + axis] = cosines[i];
        }
      }
    }
  }
  for (int l = 0; l < task.level_count; ++l) {
    float* const out = task.out + first * size + 3 + 2 * waves + l * features;
    for_places(task.levels[l], task.points + 3 * first, last - first, task.table, features,
               [&](int64_t n, const Place& place) { interpolate(task.table, features, place, out + n * size); });
  }
}

void encode_points(const EncodingTask& task, int64_t first, int64_t last) {
  const int waves = 3 * task.frequency_count, features = task.features, size = task.size();
  for (int64_t n = first; n < last; ++n) {
    const float* const v = task.v_out + n * size;
    const float* const value = task.out + n * size;  // sines and cosines are each other's slopes
    float total[3];
    for (int axis = 0; axis < 3; ++axis) {
      total[axis] = v[axis];
      for (int f = 0; f < task.frequency_count; ++f) {
        const int sine = 3 + 3 * f + axis, cosine = sine + waves;
        total[axis] += task.frequencies[f] * (v[sine] * value[cosine] - v[cosine] * value[sine]);
      }
    }
    for (int axis = 0; axis < 3; ++axis) task.v_points[3 * n + axis] = total[axis];
  }
  for (int l = 0; l < task.level_count; ++l) {
    const float* const given = task.v_out + first * size + 3 + 2 * waves + l * features;
    for_places(task.levels[l], task.points + 3 * first, last - first, task.table, features, [&](int64_t n, const Place& place) {
      add_slope(task.table, features, task.levels[l], place, given + n * size, task.v_points + 3 * (first + n));
    });
  }
}

void encode_level(const EncodingTask& task, int32_t level) {
  const int features = task.features, size = task.size();
  const float* const given = task.v_out + 3 + 6 * task.frequency_count + level * features;
  for_places(task.levels[level], task.points, task.count, task.v_table, features,
             [&](int64_t n, const Place& place) { spread(task.v_table, features, place, given + n * size); });
}

// ---------------------------------------------------------------- capsules
void distances(const DistanceTask& task, int64_t first, int64_t last) {
  for (int64_t n = first; n < last; n += L) {
    const int count = int(last - n < L ? last - n : L);
    float place[3][L];
    V x[3], away[3];
    for (int axis = 0; axis < 3; ++axis) {
      for (int i = 0; i < L; ++i) place[axis][i] = task.points[3 * (n + (i < count ? i : count - 1)) + axis];
      x[axis] = load<float>(place[axis]);
      away[axis] = V(0.f);
    }
    const V distance = distance_to_segments(x, task.segments, task.segment_count, away);
    for (int axis = 0; axis < 3; ++axis) store(place[axis], away[axis] / distance);
    for (int i = 0; i < count; ++i) {
      task.distance[n + i] = distance[i];
      for (int axis = 0; axis < 3; ++axis) task.direction[3 * (n + i) + axis] = place[axis][i];
    }
  }
}

}  // namespace

TrainingKernels training_kernels() {
  return {forward, backward,  encode,     encode_points,       encode_level, distances,
          adam,    variation, pose_codes, pose_codes_backward, magnitude};
}

}  // namespace SNARF_ISA
}  // namespace snarf
