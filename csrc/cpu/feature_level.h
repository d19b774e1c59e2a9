// Checks feature grids (snarf_feature_level) and turns them into what the kernels read.
#pragma once

#include <cstdint>

#include "network_task.h"
#include "snarf/api.h"

namespace snarf {

inline bool valid(const snarf_feature_level* levels, int count, int features, int64_t rows) {
  if (count < 0 || (count && (!levels || features < 1 || features > kMostFeatures))) return false;
  for (int l = 0; l < count; ++l) {
    if (!levels[l].rows) return false;
    int64_t nodes = 1;
    for (int axis = 0; axis < 3; ++axis) {
      if (levels[l].nodes[axis] < 2 || !(levels[l].size[axis] > 0)) return false;
      nodes *= levels[l].nodes[axis];
    }
    for (int64_t node = 0; node < nodes; ++node)
      if (levels[l].rows[node] >= rows) return false;
  }
  return true;
}

inline FeatureLevel feature_level(const snarf_feature_level& given) {
  FeatureLevel level;
  for (int axis = 0; axis < 3; ++axis) {
    level.lower[axis] = given.lower[axis];
    level.per_metre[axis] = 1.f / given.size[axis];
    level.nodes[axis] = given.nodes[axis];
  }
  level.rows = given.rows;
  return level;
}

}  // namespace snarf
