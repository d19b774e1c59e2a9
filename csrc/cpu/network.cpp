// The canonical occupancy network without gradients, compiled once per instruction set.
//
// DESIGN. A tile of points goes through all layers (layer.h) before the next tile starts, so that its values stay in the cache.
#include "capsules.h"
#include "features.h"
#include "layer.h"
#include "snarf/waves.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// The points themselves, then sines of all axes and frequencies, then cosines, as OccupancyNetwork._encode has them.
void encode(const NetworkTask& task, const float* points, float* encoded) {
  const int waves = 3 * task.frequency_count;
  for (int axis = 0; axis < 3; ++axis)
    for (int i = 0; i < kTile; i += V::width) {
      const V x = load<float>(points + axis * kTile + i);
      store(encoded + axis * kTile + i, x);
      for (int f = 0; f < task.frequency_count; ++f) {
        V sine, cosine;
        sine_cosine(x * V(task.frequencies[f]), sine, cosine);
        store(encoded + (3 + 3 * f + axis) * kTile + i, sine);
        store(encoded + (3 + waves + 3 * f + axis) * kTile + i, cosine);
      }
    }
}

// Features of each level, after what `encode` wrote.
void add_features(const NetworkTask& task, const float* points, float* encoded) {
  float values[kMostFeatures], places[3 * kTile];
  for (int i = 0; i < kTile; ++i)
    for (int axis = 0; axis < 3; ++axis) places[3 * i + axis] = points[axis * kTile + i];
  float* rows = encoded + int64_t(kTile) * (3 + 6 * task.frequency_count);
  for (int l = 0; l < task.level_count; ++l, rows += int64_t(kTile) * task.features)
    for_places(task.levels[l], places, kTile, task.table, task.features, [&](int64_t i, const Place& place) {
      interpolate(task.table, task.features, place, values);
      for (int f = 0; f < task.features; ++f) rows[f * kTile + i] = values[f];
    });
}

// Adds to `values` [kTile] the logits of capsules around the bones, as OccupancyNetwork does. `points` is [3, kTile].
void add_capsules(const NetworkTask& task, const float* points, float* values) {
  for (int i = 0; i < kTile; i += V::width) {
    V x[3];
    for (int axis = 0; axis < 3; ++axis) x[axis] = load<float>(points + axis * kTile + i);
    const V distance = distance_to_segments(x, task.segments, task.segment_count, nullptr);
    store(values + i, load<float>(values + i) + (V(task.radius) - distance) * task.slope);
  }
}

// Evaluates points first to last (see NetworkKernel). The first layer has no hidden inputs, so `values` needs no initial
// content.
void run_network(const NetworkTask& task, int64_t first, int64_t last, float* scratch) {
  const int64_t tile = kTile;
  float* const encoded = scratch;
  float* const extras = encoded + tile * task.encoded();
  float* values = extras + tile * task.extra_count;
  float* next = values + tile * task.widest;
  for (int64_t begin = first; begin < last; begin += tile) {
    const int count = int(last - begin < tile ? last - begin : tile);
    float points[3 * kTile];
    for (int i = 0; i < kTile; ++i) {
      const int64_t row = begin + (i < count ? i : count - 1);  // the last tile repeats its last point
      for (int axis = 0; axis < 3; ++axis) points[axis * kTile + i] = task.points[3 * row + axis];
      for (int e = 0; e < task.extra_count; ++e) extras[e * tile + i] = task.extras[row * task.extra_count + e];
    }
    encode(task, points, encoded);
    add_features(task, points, encoded);
    for (int n = 0; n < task.layer_count; ++n) {
      run_layer(task.layers[n], values, encoded, extras, task.sharpness, next);
      float* const previous = values;
      values = next;
      next = previous;
    }
    if (task.segment_count) add_capsules(task, points, values);
    for (int i = 0; i < count; ++i) task.out[begin + i] = values[i];
  }
}

}  // namespace

NetworkKernel network_kernel() { return run_network; }

}  // namespace SNARF_ISA
}  // namespace snarf
