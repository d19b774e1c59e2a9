// Broyden's method on the whole grid from one start: the papers' search (SNARF Eq. 6-8, Fast-SNARF Eq. 7-9).
//
// Where we differ from the released kernel: the start Jacobian is the exact one of d, not the transpose of the blended 3x3; a
// step that leaves the grid is clamped to its border, where outside the transform would be zero; the inverse Jacobian is the
// exact one at the root, on request the iteration's approximation after its last update.
#pragma once

#include "grid.h"

namespace snarf {
namespace SNARF_ISA {

template <class S>
struct Broyden {
  S tolerance;   // largest residual of a root, metres
  S divergence;  // residual after a step at which a start is given up, metres
  int max_steps;
  bool exact_jacobian;
};

// The start x[3] that the upper rows [12] of an inverse bone transform give for a query, canonical.
template <class S>
SNARF_HD void start_from(const S* back, const S* target, S* x) {
  for (int i = 0; i < 3; ++i)
    x[i] = back[4 * i] * target[0] + back[4 * i + 1] * target[1] + back[4 * i + 2] * target[2] + back[4 * i + 3];
}

// Blended transform [12] at the canonical point x, and on request its three derivatives by the cell coordinates, [3][12].
template <class S>
SNARF_HD void blend_at(const S* transforms, const Grid<S>& grid, const S* x, S* blended, S* derivatives) {
  S local[3], weight[8];
  const S* corner[8];
  long long first = locate(grid, x, local);
  corner_weights(local, weight);
  for (int k = 0; k < 8; ++k) corner[k] = transforms + 12 * corner_node(grid, first, k);
  for (int r = 0; r < 12; ++r) {
    S sum = 0;
    for (int k = 0; k < 8; ++k) sum += weight[k] * corner[k][r];
    blended[r] = sum;
  }
  if (!derivatives) return;
  for (int axis = 0; axis < 3; ++axis) {
    int bit = 1 << axis;
    S slope[8];
    for (int k = 0; k < 8; ++k) {
      S others = 1;
      for (int b = 0; b < 3; ++b)
        if (b != axis) others *= k >> b & 1 ? local[b] : 1 - local[b];
      slope[k] = k & bit ? others : -others;
    }
    for (int r = 0; r < 12; ++r) {
      S sum = 0;
      for (int k = 0; k < 8; ++k) sum += slope[k] * corner[k][r];
      derivatives[12 * axis + r] = sum;
    }
  }
}

// d(x) - target, metres.
template <class S>
SNARF_HD void residual_of(const S* blended, const S* x, const S* target, S* residual) {
  for (int i = 0; i < 3; ++i) {
    const S* row = blended + 4 * i;
    residual[i] = row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3] - target[i];
  }
}

// Inverse of dd/dx at x, canonical by posed; returns whether the Jacobian is regular (the inverse is zero otherwise).
template <class S>
SNARF_HD bool inverse_jacobian(const Grid<S>& grid, const S* x, const S* blended, const S* derivatives, S* inverse) {
  S jacobian[9];
  for (int i = 0; i < 3; ++i)
    for (int axis = 0; axis < 3; ++axis) {
      const S* row = derivatives + 12 * axis + 4 * i;
      jacobian[3 * i + axis] =
          blended[4 * i + axis] + (row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3]) / grid.size[axis];
    }
  S determinant = adjugate(jacobian, inverse);
  S reciprocal = determinant != 0 ? S(1) / determinant : S(0);
  for (int i = 0; i < 9; ++i) inverse[i] *= reciprocal;
  return determinant != 0;
}

// Runs from the start x[3] (canonical); true if it converged in the grid. x becomes the root, inverse[9] that of dd/dx.
template <class S>
SNARF_HD bool broyden(const S* transforms, const Grid<S>& grid, const Broyden<S>& settings, const S* target, S* x, S* inverse) {
  S blended[12], derivatives[36], residual[3], upper[3];
  for (int i = 0; i < 3; ++i) {
    upper[i] = grid.lower[i] + grid.size[i] * S(grid.nodes[i] - 1);
    x[i] = smaller(larger(x[i], grid.lower[i]), upper[i]);
  }
  blend_at(transforms, grid, x, blended, derivatives);
  inverse_jacobian(grid, x, blended, derivatives, inverse);
  residual_of(blended, x, target, residual);
  const S tolerance2 = settings.tolerance * settings.tolerance, divergence2 = settings.divergence * settings.divergence;
  for (int k = 0;; ++k) {
    S distance2 = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2];
    if (distance2 < tolerance2) break;
    // As SNARF does, the residual of the start itself is not judged: the first step may lead far closer. It must be finite.
    const bool hopeful = k ? distance2 < divergence2 : distance2 - distance2 == 0;
    if (k == settings.max_steps || !hopeful) return false;
    S step[3], change[3], towards[3], row[3];
    for (int i = 0; i < 3; ++i) {
      S moved = x[i] - (inverse[3 * i] * residual[0] + inverse[3 * i + 1] * residual[1] + inverse[3 * i + 2] * residual[2]);
      moved = smaller(larger(moved, grid.lower[i]), upper[i]);
      step[i] = moved - x[i];
      x[i] = moved;
      change[i] = residual[i];
    }
    blend_at(transforms, grid, x, blended, (S*)0);
    residual_of(blended, x, target, residual);
    for (int i = 0; i < 3; ++i) change[i] = residual[i] - change[i];
    // Rank-one update of the inverse (Broyden's first method by Sherman and Morrison).
    S scale = 0;
    for (int i = 0; i < 3; ++i) {
      towards[i] = inverse[3 * i] * change[0] + inverse[3 * i + 1] * change[1] + inverse[3 * i + 2] * change[2];
      row[i] = step[0] * inverse[i] + step[1] * inverse[3 + i] + step[2] * inverse[6 + i];
      scale += step[i] * towards[i];
    }
    if (absolute(scale) > S(1e-20))
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) inverse[3 * i + j] += (step[i] - towards[i]) * row[j] / scale;
  }
  if (settings.exact_jacobian) {
    blend_at(transforms, grid, x, blended, derivatives);
    return inverse_jacobian(grid, x, blended, derivatives, inverse);
  }
  return true;
}

}  // namespace SNARF_ISA
}  // namespace snarf
