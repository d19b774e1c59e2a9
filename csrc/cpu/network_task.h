// Arguments of the network's kernel (network.cpp), which is compiled once per instruction set. Plain data only.
#pragma once

#include <stdint.h>

#include "snarf/places.h"

namespace snarf {

constexpr int kTile = 128;   // points that go through all layers together: their values stay in the second-level cache
constexpr int kOutputs = 6;  // outputs of a layer that are summed at once; packed weights are padded to a multiple of it

constexpr int kMostFeatures = 64;  // per node of a grid

struct NetworkLayer {
  const float*
      weights;  // [outputs / kOutputs, inputs, kOutputs]; inputs: those of the layer before, the encoded point, the extras
  const float* bias;                // [outputs], padded
  int32_t hidden, encoded, extras;  // number of each; 0 for none
  int32_t outputs;                  // padded
  int32_t activation;               // 0: none, 1: ReLU, 2: softplus
};

struct NetworkTask {
  const NetworkLayer* layers;
  int32_t layer_count;
  int32_t widest;            // maximum number of outputs of a layer
  const float* frequencies;  // radians per metre, [K]
  int32_t frequency_count;
  const FeatureLevel* levels;
  int32_t level_count;
  int32_t features;       // F, numbers per node
  const float* table;     // [R, F]
  const float* segments;  // [S, 6]: start and end, metres
  int32_t segment_count;  // 0: nothing is added
  float radius, slope;    // slope * (radius - distance to the nearest segment) is added
  float sharpness;        // of the softplus
  const float* points;    // [N, 3], metres
  const float* extras;    // [N, E]
  int32_t extra_count;
  float* out;  // [N]

  int32_t encoded() const { return 3 + 6 * frequency_count + level_count * features; }
  int64_t scratch() const { return int64_t(kTile) * (2 * int64_t(widest) + encoded() + extra_count); }
};

// Evaluates points first to last; `scratch` has room for task.scratch() numbers and is aligned to 64 bytes.
using NetworkKernel = void (*)(const NetworkTask&, int64_t first, int64_t last, float* scratch);

namespace avx512 {
NetworkKernel network_kernel();
}
namespace avx2 {
NetworkKernel network_kernel();
}
namespace baseline {
NetworkKernel network_kernel();
}

}  // namespace snarf
