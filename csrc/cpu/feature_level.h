// Checks feature grids (snarf_feature_level) and turns them into what the kernels read.
#pragma once

#include <cstdint>

#include "network_task.h"
#include "snarf/api.h"

namespace snarf {

inline bool valid(const snarf_feature_level* levels, int count, int features, int64_t rows) {
  if (count < 0 || rows < 0 || rows > INT32_MAX || (count && (!levels || features < 1 || features > kMostFeatures)))
    return false;
  for (int l = 0; l < count; ++l) {
    if (!levels[l].rows) return false;
    for (int axis = 0; axis < 3; ++axis)
      if (levels[l].nodes[axis] < 2 || !(levels[l].size[axis] > 0)) return false;
  }
  return true;
}

inline FeatureLevel feature_level(const snarf_feature_level& given, int64_t rows) {
  FeatureLevel level;
  for (int axis = 0; axis < 3; ++axis) {
    level.lower[axis] = given.lower[axis];
    level.per_metre[axis] = 1.f / given.size[axis];
    level.nodes[axis] = given.nodes[axis];
  }
  level.rows = given.rows;
  level.row_count = uint32_t(rows);
  return level;
}

}  // namespace snarf
