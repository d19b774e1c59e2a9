// Checks and packs what a training step evaluates (snarf_perceptron, snarf_encoding), and runs it on all threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <new>
#include <numeric>
#include <vector>

#include "dispatch.h"
#include "feature_level.h"
#include "snarf/adam.h"
#include "snarf/api.h"
#include "snarf/variation.h"
#include "team.h"
#include "training_task.h"

namespace snarf {

constexpr int64_t kTilesPerThread = 2;         // fewer are not worth starting a thread for
constexpr int64_t kEncodedPerThread = 512;     // points
constexpr int64_t kColumnUnit = 16;            // a pack of the widest instruction set
constexpr int64_t kNumbersAtOnce = 1 << 14;    // parameters in one piece of work
constexpr int64_t kGradientNumbers = 1 << 21;  // of all chunks together, at most

inline TrainingKernels training_kernels() {
#if defined(SNARF_X86_KERNELS)
  if (instruction_set() == kAvx512) return avx512::training_kernels();
  if (instruction_set() == kAvx2) return avx2::training_kernels();
#endif
  return baseline::training_kernels();
}

inline bool valid(const snarf_perceptron* network) {
  if (!network || !network->layers || network->layer_count < 1 || network->threads < 1) return false;
  if (network->first_count < 1 || network->extra_count < 0) return false;
  for (int n = 0; n < network->layer_count; ++n) {
    const snarf_layer& layer = network->layers[n];
    if (!layer.weights || !layer.bias || layer.outputs < 1 || layer.activation < 0 || layer.activation > 2) return false;
    if (n == 0 && !layer.takes_point) return false;
  }
  return true;
}

inline bool valid(const snarf_encoding* encoding) {
  if (!encoding || encoding->count < 0 || encoding->threads < 1 || (encoding->count && !encoding->points)) return false;
  if (encoding->frequency_count < 0 || (encoding->frequency_count && !encoding->frequencies)) return false;
  return valid(encoding->levels, encoding->level_count, encoding->features, encoding->rows);
}

inline int64_t padded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

class Training {
 public:
  static int64_t saved_size(const snarf_perceptron& network, int64_t count) {
    int64_t size = 0;
    for (int n = 0; n + 1 < network.layer_count; ++n) size += padded(network.layers[n].outputs, kOutputs) * kTile;
    return size * ((count + kTile - 1) / kTile);
  }

  explicit Training(const snarf_perceptron& network) : threads_(network.threads) {
    task_.layer_count = network.layer_count;
    task_.first_count = network.first_count;
    task_.extra_count = network.extra_count;
    task_.sharpness = network.sharpness;
    task_.saved_size = task_.gradient_size = task_.widest = 0;
    int hidden = 0;
    for (int n = 0; n < network.layer_count; ++n) {
      pack(network.layers[n], hidden);
      hidden = network.layers[n].outputs;
    }
    for (size_t n = 0; n < layers_.size(); ++n) {  // now that the vectors no longer move
      layers_[n].forward.weights = weights_[n].data();
      layers_[n].forward.bias = biases_[n].data();
      layers_[n].back = backs_[n].data();
    }
    task_.layers = layers_.data();
  }

  void forward(const float* first, const float* extras, int64_t count, float* saved, float* out) {
    set_points(first, extras, count, saved);
    task_.out = out;
    Queue tiles((count + kTile - 1) / kTile, 1);
    run([&](float* scratch) {
      for (int64_t begin, end; tiles.take(begin, end);) training_kernels().forward(task_, begin, end, scratch);
    });
  }

  void backward(const float* first, const float* extras, int64_t count, const float* saved, const float* v_out,
                float* const* v_weights, float* const* v_bias, float* v_first, float* v_extras) {
    set_points(first, extras, count, const_cast<float*>(saved));
    task_.v_out = v_out;
    task_.v_first = v_first;
    task_.v_extras = v_extras;
    // Chunks do not depend on the number of threads, and so neither do the sums.
    const int64_t tiles = (count + kTile - 1) / kTile;
    const int64_t chunks =
        std::max<int64_t>(1, std::min({tiles, int64_t(16), std::max<int64_t>(4, kGradientNumbers / task_.gradient_size)}));
    std::vector<float> gradients(size_t(chunks * task_.gradient_size) + 16, 0.f);
    Queue queue(chunks, 1);
    run([&](float* scratch) {
      for (int64_t chunk, end; queue.take(chunk, end);)
        training_kernels().backward(task_, tiles * chunk / chunks, tiles * (chunk + 1) / chunks, scratch,
                                    gradients.data() + chunk * task_.gradient_size);
    });
    for (size_t n = 0; n < layers_.size(); ++n) {
      const TrainedLayer& layer = layers_[n];
      const int64_t inputs = layer.forward.hidden + layer.forward.encoded + layer.forward.extras;
      for (int64_t r = 0; r < layer.real_outputs; ++r) {
        add_up(gradients, chunks, layer.weights_at + r * layer.columns, inputs, v_weights[n] + r * inputs);
        add_up(gradients, chunks, layer.bias_at + r, 1, v_bias[n] + r);
      }
    }
  }

 private:
  void set_points(const float* first, const float* extras, int64_t count, float* saved) {
    task_.first = first;
    task_.extras = extras;
    task_.count = count;
    task_.saved = saved;
  }

  template <class Work>
  void run(const Work& work) {
    const int64_t tiles = (task_.count + kTile - 1) / kTile;
    const int threads = int(std::max<int64_t>(1, std::min<int64_t>(threads_, tiles / kTilesPerThread)));
    const bool well =
        run_phases(threads, {[&](int) {
                     std::vector<float> scratch(size_t(task_.scratch()) + 16);
                     work(reinterpret_cast<float*>((reinterpret_cast<uintptr_t>(scratch.data()) + 63) & ~uintptr_t(63)));
                   }});
    if (!well) throw std::bad_alloc();
  }

  void add_up(const std::vector<float>& gradients, int64_t chunks, int64_t at, int64_t count, float* out) const {
    std::copy_n(&gradients[size_t(at)], count, out);
    for (int64_t chunk = 1; chunk < chunks; ++chunk) {
      const float* const from = &gradients[size_t(chunk * task_.gradient_size + at)];
      for (int64_t k = 0; k < count; ++k) out[k] += from[k];
    }
  }

  void pack(const snarf_layer& given, int hidden) {
    TrainedLayer layer;
    NetworkLayer& packed = layer.forward;
    packed.hidden = hidden;
    packed.encoded = given.takes_point ? task_.first_count : 0;
    packed.extras = given.takes_extras ? task_.extra_count : 0;
    packed.outputs = int32_t(padded(given.outputs, kOutputs));
    packed.activation = given.activation;
    layer.real_outputs = given.outputs;
    const int64_t inputs = packed.hidden + packed.encoded + packed.extras;
    std::vector<float> weights(size_t(packed.outputs * inputs), 0.f), bias(size_t(packed.outputs), 0.f);
    std::copy(given.bias, given.bias + given.outputs, bias.begin());
    for (int64_t o = 0; o < given.outputs; ++o)
      for (int64_t k = 0; k < inputs; ++k)
        weights[size_t(o / kOutputs * kOutputs * inputs + k * kOutputs + o % kOutputs)] = given.weights[o * inputs + k];
    const int64_t sizes[3] = {packed.hidden, packed.encoded, packed.extras};
    layer.back_stride = 0;
    for (int64_t size : sizes) layer.back_stride += int32_t(padded(size, kOutputs));
    std::vector<float> back(size_t(given.outputs) * layer.back_stride, 0.f);
    for (int64_t o = 0; o < given.outputs; ++o) {
      float* to = &back[size_t(o * layer.back_stride)];
      const float* from = given.weights + o * inputs;
      for (int64_t size : sizes) {
        std::copy_n(from, size, to);
        from += size;
        to += padded(size, kOutputs);
      }
    }
    layer.columns = int32_t(padded(inputs, kColumnUnit));
    layer.saved = task_.saved_size;
    layer.weights_at = task_.gradient_size;
    layer.bias_at = layer.weights_at + int64_t(packed.outputs) * layer.columns;
    task_.gradient_size = padded(layer.bias_at + packed.outputs, kColumnUnit);
    task_.widest = std::max({task_.widest, packed.outputs, layer.columns});
    if (int(layers_.size()) + 1 < task_.layer_count) task_.saved_size += int64_t(packed.outputs) * kTile;
    layers_.push_back(layer);
    weights_.push_back(std::move(weights));
    biases_.push_back(std::move(bias));
    backs_.push_back(std::move(back));
  }

  int threads_;
  TrainingTask task_;
  std::vector<TrainedLayer> layers_;
  std::vector<std::vector<float>> weights_, biases_, backs_;
};

class Encoding {
 public:
  explicit Encoding(const snarf_encoding& encoding) : rows_(encoding.rows) {
    task_.points = encoding.points;
    task_.count = encoding.count;
    task_.frequencies = encoding.frequencies;
    task_.frequency_count = encoding.frequency_count;
    task_.level_count = encoding.level_count;
    task_.features = encoding.level_count ? encoding.features : 0;
    task_.table = encoding.table;
    for (int l = 0; l < encoding.level_count; ++l) levels_.push_back(feature_level(encoding.levels[l], encoding.rows));
    task_.levels = levels_.data();
    threads_ = int(std::max<int64_t>(1, std::min<int64_t>(encoding.threads, encoding.count / kEncodedPerThread)));
  }

  void forward(float* out) {
    task_.out = out;
    Queue queue(task_.count, 256);
    run([&] {
      for (int64_t begin, end; queue.take(begin, end);) training_kernels().encode(task_, begin, end);
    });
  }

  void backward(const float* out, const float* v_out, float* v_points, float* v_table) {
    task_.out = const_cast<float*>(out);
    task_.v_out = v_out;
    task_.v_points = v_points;
    task_.v_table = v_table;
    if (v_table) std::fill(v_table, v_table + rows_ * task_.features, 0.f);
    // The rows of a level belong to one thread at a time, which adds up all points in their order.
    Queue levels(v_table ? task_.level_count : 0, 1), points(v_points ? task_.count : 0, 256);
    run([&] {
      for (int64_t level, end; levels.take(level, end);) training_kernels().encode_level(task_, int32_t(level));
      for (int64_t begin, end; points.take(begin, end);) training_kernels().encode_points(task_, begin, end);
    });
  }

 private:
  template <class Work>
  void run(const Work& work) {
    if (!run_phases(threads_, {[&](int) { work(); }})) throw std::bad_alloc();
  }

  int64_t rows_;
  int threads_;
  EncodingTask task_;
  std::vector<FeatureLevel> levels_;
};

inline void distances(const DistanceTask& task, int64_t count, int threads) {
  threads = int(std::max<int64_t>(1, std::min<int64_t>(threads, count / kEncodedPerThread)));
  Queue queue(count, 256);
  const bool well = run_phases(threads, {[&](int) {
                                 for (int64_t begin, end; queue.take(begin, end);)
                                   training_kernels().distances(task, begin, end);
                               }});
  if (!well) throw std::bad_alloc();
}

inline bool valid(const snarf_parameters* arrays, int32_t count, const snarf_adam* settings) {
  if (count < 0 || (count && !arrays) || !settings || settings->threads < 1 || settings->step < 1) return false;
  for (int n = 0; n < count; ++n) {
    const snarf_parameters& array = arrays[n];
    if (array.rows < 0 || array.columns < 1) return false;
    if (array.rows && !(array.values && array.gradient && array.first && array.second && array.average)) return false;
  }
  return true;
}

// Returns the sum of the magnitudes of all gradients; nothing changes if it is not finite.
inline double adam_step(const snarf_parameters* given, int32_t count, const snarf_adam& settings) {
  struct Part {
    int32_t array;
    int64_t first, last;  // rows
  };
  std::vector<ParameterArray> arrays;
  std::vector<Part> parts;
  for (int32_t n = 0; n < count; ++n) {
    const snarf_parameters& array = given[n];
    arrays.push_back({array.values, array.gradient, array.first, array.second, array.average, array.rows, array.columns,
                      array.rate, array.skips_untouched});
    const int64_t grain = std::max<int64_t>(1, kNumbersAtOnce / array.columns);
    for (int64_t first = 0; first < array.rows; first += grain)
      parts.push_back({n, first, std::min(first + grain, array.rows)});
  }
  const AdamTask task = SNARF_ISA::adam_task(settings.first_decay, settings.second_decay, settings.epsilon,
                                             settings.average_decay, settings.step);
  const TrainingKernels kernels = training_kernels();
  std::vector<double> magnitudes(parts.size());
  double total = 0;
  Queue gradients(int64_t(parts.size()), 1), updates(int64_t(parts.size()), 1);
  const int threads = int(std::max<int64_t>(1, std::min<int64_t>(settings.threads, int64_t(parts.size()) / 4)));
  const auto measure = [&](int) {
    for (int64_t n, end; gradients.take(n, end);) {
      const Part& part = parts[size_t(n)];
      const ParameterArray& array = arrays[size_t(part.array)];
      magnitudes[size_t(n)] =
          kernels.magnitude(array.gradient + part.first * array.columns, (part.last - part.first) * array.columns);
    }
  };
  const auto add_up = [&](int thread) {
    if (thread == 0) total = std::accumulate(magnitudes.begin(), magnitudes.end(), 0.0);
  };
  const auto update = [&](int) {
    if (!std::isfinite(total)) return;
    for (int64_t n, end; updates.take(n, end);) {
      const Part& part = parts[size_t(n)];
      kernels.adam(task, arrays[size_t(part.array)], part.first, part.last);
    }
  };
  if (!run_phases(threads, {measure, add_up, update})) throw std::bad_alloc();
  return total;
}

inline bool valid(const snarf_variation* given) {
  if (!given || given->count < 1 || given->threads < 1 || !given->weights) return false;
  for (int axis = 0; axis < 3; ++axis)
    if (given->nodes[axis] < 1 || !(given->size[axis] > 0)) return false;
  return true;
}

// Returns the total and writes its gradient.
inline double total_variation(const snarf_variation& given, float* gradient) {
  VariationTask task;
  task.weights = given.weights;
  task.used = given.used;
  task.count = given.count;
  task.gradient = gradient;
  for (int axis = 0; axis < 3; ++axis) task.nodes[axis] = given.nodes[axis];
  const int64_t width = task.nodes[0], height = task.nodes[1], depth = task.nodes[2], layer = width * height;
  int64_t pairs[3] = {0, 0, 0};
  const auto is_used = [&](int64_t node) { return !task.used || task.used[node]; };
  for (int64_t n = 0; n < layer * depth; ++n) {
    if (!is_used(n)) continue;
    pairs[0] += n % width + 1 < width && is_used(n + 1);
    pairs[1] += n / width % height + 1 < height && is_used(n + width);
    pairs[2] += n / layer + 1 < depth && is_used(n + layer);
  }
  for (int axis = 0; axis < 3; ++axis) task.scale[axis] = SNARF_ISA::change_scale(given.size[axis], pairs[axis]);
  std::vector<double> totals(size_t(depth), 0.0);
  task.totals = totals.data();
  const int threads = int(std::max<int64_t>(1, std::min<int64_t>({given.threads, depth, layer * depth / 1024})));
  Queue layers(depth, 1);
  const bool well = run_phases(threads, {[&](int) {
                                 for (int64_t first, last; layers.take(first, last);)
                                   training_kernels().variation(task, first, last);
                               }});
  if (!well) throw std::bad_alloc();
  return std::accumulate(totals.begin(), totals.end(), 0.0);
}

inline bool valid(const snarf_codes* given) {
  if (!given || given->count < 0 || given->poses < 0 || given->parts < 1 || given->size < 1 || given->threads < 1) return false;
  if (given->count && !(given->seen && given->pose)) return false;
  for (int64_t n = 0; n < given->count; ++n)
    if (given->pose[n] < 0 || given->pose[n] >= given->poses) return false;
  return true;
}

class PoseCodes {
 public:
  explicit PoseCodes(const snarf_codes& given) : count_(given.count), numbers_(given.poses * given.parts * given.size) {
    task_.seen = given.seen;
    task_.pose = given.pose;
    task_.parts = given.parts;
    task_.size = given.size;
    threads_ = int(std::max<int64_t>(1, std::min<int64_t>(given.threads, given.count / kEncodedPerThread)));
  }

  void forward(const float* codes, float* out) {
    task_.codes = codes;
    task_.out = out;
    Queue points(count_, 256);
    run([&] {
      for (int64_t first, last; points.take(first, last);) training_kernels().pose_codes(task_, first, last);
    });
  }

  void backward(const float* v_out, float* v_codes) {
    task_.v_out = v_out;
    // Chunks do not depend on the number of threads, and so neither do the sums.
    const int64_t chunks = std::max<int64_t>(1, std::min<int64_t>(16, count_ / kEncodedPerThread));
    std::vector<float> parts(size_t(chunks * numbers_), 0.f);
    Queue queue(chunks, 1);
    run([&] {
      for (int64_t chunk, end; queue.take(chunk, end);)
        training_kernels().pose_codes_backward(task_, count_ * chunk / chunks, count_ * (chunk + 1) / chunks,
                                               parts.data() + chunk * numbers_);
    });
    std::fill(v_codes, v_codes + numbers_, 0.f);
    for (int64_t chunk = 0; chunk < chunks; ++chunk)
      for (int64_t k = 0; k < numbers_; ++k) v_codes[k] += parts[size_t(chunk * numbers_ + k)];
  }

 private:
  template <class Work>
  void run(const Work& work) {
    if (!run_phases(threads_, {[&](int) { work(); }})) throw std::bad_alloc();
  }

  int64_t count_, numbers_;
  int threads_;
  CodeTask task_;
};

}  // namespace snarf
