// What evaluating and training a network share: one layer of a tile of points and its activations.
//
// DESIGN. A SIMD lane is a point, and arrays of values are [value, point], so that activations, the encoding and the distance
// to the bones need no shuffles. A layer is computed for kOutputs outputs and kPacks packs of points at once, whose sums stay
// in registers. Each loaded pack of values is used for kOutputs products, and each loaded weight for kPacks products, so that
// arithmetic, not memory, limits the speed. The weights are stored in the order in which they are used.
#pragma once

#include <math.h>

#include "lanes.h"
#include "network_task.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

using V = Lanes<float>;
constexpr int kPacks = kVectorBytes == 64 ? 4 : 2;  // the sums take 24 of 32 vector registers, or 12 of 16
constexpr int kColumn = kPacks * V::width;          // points whose sums are computed at once
static_assert(kTile % kColumn == 0, "tiles are made of whole columns");

// sums[o][p] += weights[k][o] * values[k][p] for all k < count. `weights` is [count, kOutputs]; a row of `values` has kTile
// points, of which the first kColumn are used.
SNARF_HD void add_products(const float* weights, const float* values, int count, V (*sums)[kPacks]) {
  for (int k = 0; k < count; ++k) {
    V value[kPacks];
    SNARF_UNROLL
    for (int p = 0; p < kPacks; ++p) value[p] = load<float>(values + k * kTile + p * V::width);
    SNARF_UNROLL
    for (int o = 0; o < kOutputs; ++o) {
      const V weight(weights[k * kOutputs + o]);
      SNARF_UNROLL
      for (int p = 0; p < kPacks; ++p) sums[o][p] = sums[o][p] + weight * value[p];
    }
  }
}

// e^x for x <= 0, with a relative error of at most 4e-6. An x below -20 counts as -20. Computed as (e^(x / 64))^64, the inner
// one by its Taylor series.
SNARF_HD V decay(V x) {
  const V y = larger(x, V(-20.f)) * V(1.f / 64);
  V e = V(1.f / 720);
  e = e * y + V(1.f / 120);
  e = e * y + V(1.f / 24);
  e = e * y + V(1.f / 6);
  e = e * y + V(0.5f);
  e = e * y + V(1.f);
  e = e * y + V(1.f);
  SNARF_UNROLL
  for (int i = 0; i < 6; ++i) e = e * e;
  return e;
}

// log(1 + e^(sharpness x)) / sharpness. NaN stays NaN.
SNARF_HD V softplus(V x, float sharpness) {
  const V positive = select(x <= 0.f, V(0.f), x);
  const V scaled = absolute(x) * sharpness;
  if (!any(scaled < 20.f)) return positive;  // what is left out is below 2.1e-9 / sharpness
  // log(1 + e) = 2 artanh(e / (2 + e)), whose argument is at most a third
  const V e = decay(V(0.f) - scaled);
  const V t = e / (e + 2.f), q = t * t;
  V series = q * V(1.f / 11) + V(1.f / 9);
  series = series * q + V(1.f / 7);
  series = series * q + V(1.f / 5);
  series = series * q + V(1.f / 3);
  series = series * q + V(1.f);
  return positive + series * t * V(2.f / sharpness);
}

// `activation` is numbered as in NetworkLayer.
SNARF_HD V activated(V x, int activation, float sharpness) {
  if (activation == 1) return select(x <= 0.f, V(0.f), x);
  return activation == 2 ? softplus(x, sharpness) : x;
}

// One layer for a tile. `hidden`, `encoded`, `extras` and `out` are [value, kTile]; out has layer.outputs rows.
void run_layer(const NetworkLayer& layer, const float* hidden, const float* encoded, const float* extras, float sharpness,
               float* out) {
  const int inputs = layer.hidden + layer.encoded + layer.extras;
  for (int o = 0; o < layer.outputs; o += kOutputs) {
    const float* const weights = layer.weights + int64_t(o) * inputs;
    for (int column = 0; column < kTile; column += kColumn) {
      V sums[kOutputs][kPacks];
      SNARF_UNROLL
      for (int i = 0; i < kOutputs; ++i) SNARF_UNROLL
      for (int p = 0; p < kPacks; ++p) sums[i][p] = V(layer.bias[o + i]);
      add_products(weights, hidden + column, layer.hidden, sums);
      add_products(weights + kOutputs * layer.hidden, encoded + column, layer.encoded, sums);
      add_products(weights + kOutputs * (layer.hidden + layer.encoded), extras + column, layer.extras, sums);
      SNARF_UNROLL
      for (int i = 0; i < kOutputs; ++i) SNARF_UNROLL
      for (int p = 0; p < kPacks; ++p)
        store(out + (o + i) * kTile + column + p * V::width, activated(sums[i][p], layer.activation, sharpness));
    }
  }
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
