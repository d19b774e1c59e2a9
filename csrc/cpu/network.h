// Checks, packs and runs a network (snarf_network) on all threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <new>
#include <vector>

#include "dispatch.h"
#include "feature_level.h"
#include "network_task.h"
#include "snarf/api.h"
#include "team.h"

namespace snarf {

constexpr int64_t kPointsPerThread = 256;  // minimum per thread, below which starting one costs more

inline NetworkKernel network_kernel() {
#if defined(SNARF_X86_KERNELS)
  if (instruction_set() == kAvx512) return avx512::network_kernel();
  if (instruction_set() == kAvx2) return avx2::network_kernel();
#endif
  return baseline::network_kernel();
}

inline bool valid(const snarf_network* network, const float* points, const float* extras, int64_t count, int threads,
                  const float* out) {
  if (!network || !network->layers || network->layer_count < 1 || count < 0 || threads < 1) return false;
  if (count && (!points || !out || (network->extra_count && !extras))) return false;
  if (network->frequency_count < 0 || network->extra_count < 0 || network->segment_count < 0) return false;
  if ((network->frequency_count && !network->frequencies) || (network->segment_count && !network->segments)) return false;
  if (!valid(network->levels, network->level_count, network->features, network->rows)) return false;
  int hidden = 0;
  for (int n = 0; n < network->layer_count; ++n) {
    const snarf_layer& layer = network->layers[n];
    if (!layer.weights || !layer.bias || layer.outputs < 1 || layer.activation < 0 || layer.activation > 2) return false;
    if (n == 0 && !layer.takes_point) return false;
    hidden = layer.outputs;
  }
  return hidden == 1;
}

class Network {
 public:
  explicit Network(const snarf_network& network) {
    task_.layer_count = network.layer_count;
    task_.frequencies = network.frequencies;
    task_.frequency_count = network.frequency_count;
    task_.level_count = network.level_count;
    task_.features = network.level_count ? network.features : 0;
    task_.table = network.table;
    task_.segments = network.segments;
    task_.segment_count = network.segment_count;
    task_.radius = network.radius;
    task_.slope = network.slope;
    task_.sharpness = network.sharpness;
    task_.extra_count = network.extra_count;
    for (int l = 0; l < network.level_count; ++l) levels_.push_back(feature_level(network.levels[l], network.rows));
    task_.levels = levels_.data();
    task_.widest = 0;
    int hidden = 0;
    for (int n = 0; n < network.layer_count; ++n) {
      pack(network.layers[n], hidden);
      hidden = network.layers[n].outputs;
      task_.widest = std::max(task_.widest, layers_.back().outputs);
    }
    for (int n = 0; n < network.layer_count; ++n) {  // now that the vectors no longer move
      layers_[size_t(n)].weights = weights_[size_t(n)].data();
      layers_[size_t(n)].bias = biases_[size_t(n)].data();
    }
    task_.layers = layers_.data();
  }

  void run(const float* points, const float* extras, int64_t count, int threads, float* out) {
    task_.points = points;
    task_.extras = extras;
    task_.out = out;
    threads = int(std::max<int64_t>(1, std::min<int64_t>(threads, count / kPointsPerThread)));
    const NetworkKernel kernel = network_kernel();
    Queue tiles((count + kTile - 1) / kTile, 4);
    const bool well = run_phases(
        threads, {[&](int) {
          std::vector<float> scratch(size_t(task_.scratch()) + 16);
          float* const aligned = reinterpret_cast<float*>((reinterpret_cast<uintptr_t>(scratch.data()) + 63) & ~uintptr_t(63));
          for (int64_t first, last; tiles.take(first, last);)
            kernel(task_, first * kTile, std::min(last * kTile, count), aligned);
        }});
    if (!well) throw std::bad_alloc();
  }

 private:
  // From [outputs, inputs] to blocks of kOutputs outputs, in the order in which the kernel reads them.
  void pack(const snarf_layer& layer, int hidden) {
    NetworkLayer packed;
    packed.hidden = hidden;
    packed.encoded = layer.takes_point ? task_.encoded() : 0;
    packed.extras = layer.takes_extras ? task_.extra_count : 0;
    packed.outputs = (layer.outputs + kOutputs - 1) / kOutputs * kOutputs;
    packed.activation = layer.activation;
    const int64_t inputs = packed.hidden + packed.encoded + packed.extras;
    std::vector<float> weights(size_t(packed.outputs * inputs), 0.f), bias(size_t(packed.outputs), 0.f);
    std::copy(layer.bias, layer.bias + layer.outputs, bias.begin());
    for (int64_t block = 0; block < layer.outputs; block += kOutputs) {
      const int64_t rows = std::min<int64_t>(kOutputs, layer.outputs - block);
      float* to = &weights[size_t(block * inputs)];
      for (int64_t k = 0; k < inputs; ++k, to += kOutputs)
        for (int64_t o = 0; o < rows; ++o) to[o] = layer.weights[(block + o) * inputs + k];
    }
    layers_.push_back(packed);
    weights_.push_back(std::move(weights));
    biases_.push_back(std::move(bias));
  }

  NetworkTask task_;
  std::vector<FeatureLevel> levels_;
  std::vector<NetworkLayer> layers_;
  std::vector<std::vector<float>> weights_, biases_;
};

}  // namespace snarf
