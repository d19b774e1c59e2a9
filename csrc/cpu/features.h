// Features at the nodes of grids, interpolated at points (snarfcli/shape/features.py).
#pragma once

#include <string.h>

#include "blocks.h"
#include "network_task.h"
#include "snarf/places.h"
#include "snarf/slope.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

constexpr int kPlaces = 32;  // found at once, so that the features of many points are on their way from memory

// Calls use(i, place) for each i < count with the place of points[3 * i]. Asks for the rows of `table` early.
template <class Use>
SNARF_HD void for_places(const FeatureLevel& level, const float* points, int64_t count, const float* table, int features,
                         const Use& use) {
  Place places[kPlaces];
  for (int64_t first = 0; first < count; first += kPlaces) {
    const int here = int(count - first < kPlaces ? count - first : kPlaces);
    for (int i = 0; i < here; ++i) {
      find_place(level, points + 3 * (first + i), places[i]);
#if defined(__GNUC__)
      if (places[i].is_inside)
        for (int k = 0; k < 8; k += 2)  // neighbours along x mostly share a line of the cache
          if (places[i].row[k] != kNoRow) __builtin_prefetch(table + int64_t(places[i].row[k]) * features);
#endif
    }
    for (int i = 0; i < here; ++i) use(first + i, places[i]);
  }
}

// out[count]: the features at a point, zeros outside of the level.
SNARF_HD void interpolate(const float* table, int count, const Place& place, float* out) {
  if (!place.is_inside) {
    for (int f = 0; f < count; ++f) out[f] = 0.f;
    return;
  }
  float weights[8];
  corner_weights(place, weights);
  for_blocks(count, [&](int first, auto features) {
    constexpr int F = decltype(features)::value;
    float sum[F] = {};
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      const float* const row = table + int64_t(place.row[k]) * count + first;
      for (int f = 0; f < F; ++f) sum[f] += weights[k] * row[f];
    }
    memcpy(out + first, sum, sizeof sum);
  });
}

// Adds the gradients by the features of the corners to v_table, from given[count], that by the features at the point.
SNARF_HD void spread(float* v_table, int count, const Place& place, const float* given) {
  if (!place.is_inside) return;
  float weights[8];
  corner_weights(place, weights);
  for_blocks(count, [&](int first, auto features) {
    constexpr int F = decltype(features)::value;
    float gradient[F];
    memcpy(gradient, given + first, sizeof gradient);
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      float* const row = v_table + int64_t(place.row[k]) * count + first;
      float sum[F];
      memcpy(sum, row, sizeof sum);
      for (int f = 0; f < F; ++f) sum[f] += weights[k] * gradient[f];
      memcpy(row, sum, sizeof sum);
    }
  });
}

// Adds the gradient by the point to total[3], from given[count].
SNARF_HD void add_slope(const float* table, int count, const FeatureLevel& level, const Place& place, const float* given,
                        float* total) {
  if (!place.is_inside) return;
  float along[8] = {};
  for_blocks(count, [&](int first, auto features) {
    constexpr int F = decltype(features)::value;
    float gradient[F];
    memcpy(gradient, given + first, sizeof gradient);
    for (int k = 0; k < 8; ++k) {
      if (place.row[k] == kNoRow) continue;
      const float* const row = table + int64_t(place.row[k]) * count + first;
      float product[F];
      for (int f = 0; f < F; ++f) product[f] = gradient[f] * row[f];
      for (int f = 0; f < F; ++f) along[k] += product[f];
    }
  });
  add_slope(level, place, along, total);
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
