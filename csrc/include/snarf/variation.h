// The change of skinning weights from node to node (total_variation in snarfcli/deformer/variation.py), number by number.
#pragma once

#include "platform.h"

namespace snarf {
namespace SNARF_ISA {

// The factor of changes along an axis that turns their sum over all pairs into a mean per metre. `size`: of a cell, metres.
SNARF_HD float change_scale(double size, long long pairs) { return float(1 / (size * double(pairs > 1 ? pairs : 1))); }

// Adds the slope of scale * |here - there| by `here` to `gradient`, and returns |here - there|.
SNARF_HD float add_change(float here, float there, float scale, float& gradient) {
  const float change = here - there;
  gradient += change > 0.f ? scale : change < 0.f ? -scale : 0.f;
  return fabsf(change);
}

}  // namespace SNARF_ISA
}  // namespace snarf
