// Implicit differentiation at a root of T(x*) [x*; 1] = x' (SNARF Eq. 14).
//
// With g the gradient of the loss by x*, the gradient by the query x' is v = J^-T g, and that by the blended transform of
// corner k of the root's cell is -phi_k v (outer) [x*; 1], phi_k its trilinear weight. No weights are looked up.
#pragma once

#include "grid.h"

namespace snarf {
namespace SNARF_ISA {

// v = J^-T g. inverse: J^-1 row-major [9]; g, v: [3].
template <class S>
SNARF_HD void pull_back(const S* inverse, const S* g, S* v) {
  for (int i = 0; i < 3; ++i) v[i] = inverse[i] * g[0] + inverse[3 + i] * g[1] + inverse[6 + i] * g[2];
}

// -v (outer) [x; 1], row-major [12].
template <class S>
SNARF_HD void transform_gradient(const S* v, const S* x, S* out) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) out[4 * i + j] = -v[i] * x[j];
    out[4 * i + 3] = -v[i];
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
