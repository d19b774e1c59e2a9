// Sines and cosines that a CPU evaluates for a pack of lanes, and a GPU without a table or a slow path for large angles.
#pragma once

#include "platform.h"

namespace snarf {
namespace SNARF_ISA {

// Sine and cosine of angles up to a few thousand radians, with an error of at most 2e-7: Cody and Waite's reduction by quarter
// turns, then Taylor series.
template <class V>
SNARF_HD void sine_cosine(V angle, V& sine, V& cosine) {
  const V turns = angle * V(0.63661977236758134f);  // quarter turns: 2 / pi per radian
  const V quarter = truncate(turns + select(turns >= 0.f, V(0.5f), V(-0.5f)));
  V r = angle - quarter * V(1.5703125f);  // pi / 2 in three parts, so that little is lost by rounding
  r = r - quarter * V(4.83751296997e-4f);
  r = r - quarter * V(7.549789948769e-8f);
  const V q = r * r;
  V s = q * V(2.7557319e-6f) + V(-1.9841270e-4f);
  s = s * q + V(8.3333333e-3f);
  s = s * q + V(-1.6666667e-1f);
  s = s * q * r + r;
  V c = q * V(-2.7557319e-7f) + V(2.4801587e-5f);
  c = c * q + V(-1.3888889e-3f);
  c = c * q + V(4.1666667e-2f);
  c = c * q + V(-0.5f);
  c = c * q + V(1.f);
  const V half = truncate(quarter * V(0.5f)), fourth = truncate(quarter * V(0.25f));
  const V odd = absolute(quarter - half * V(2.f));  // 1 on odd quarters
  const V rest = quarter - fourth * V(4.f);         // quarter turns without full turns, -3 to 3
  const auto swap = odd > 0.5f;
  const auto sine_down = ((rest >= 1.5f) & (rest <= 3.5f)) | ((rest >= -2.5f) & (rest <= -0.5f));
  const auto cosine_down = ((rest >= 0.5f) & (rest <= 2.5f)) | ((rest >= -3.5f) & (rest <= -1.5f));
  const V a = select(swap, c, s), b = select(swap, s, c);
  sine = select(sine_down, V(0.f) - a, a);
  cosine = select(cosine_down, V(0.f) - b, b);
}

}  // namespace SNARF_ISA
}  // namespace snarf
