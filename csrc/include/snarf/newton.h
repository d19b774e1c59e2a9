// Newton's method inside one cell (SNARF Eq. 6, with the exact Jacobian of the trilinear field).
#pragma once

#include "cell.h"

namespace snarf {
namespace SNARF_ISA {

template <class S>
struct Solver {
  S tolerance;  // largest residual of a root, metres
  int max_steps;
};

// A step this short, in cells, is the last: it leaves the Jacobian as it is to three digits (float) and, the method converging
// quadratically, the root exact. After max_steps a root is taken as it is, with the Jacobian where it was last evaluated.
template <class S>
constexpr S last_step() {
  return sizeof(S) == 4 ? S(2e-4) : S(1e-7);
}
// Beside a fold the step of a point whose residual is below the tolerance may be long; up to here it is taken.
template <class S>
constexpr S trusted_step() {
  return S(1e-2);
}
// Coordinates beyond the cell at which a start is given up, in cells. A step that ends farther outside than it was long will
// not come back either, since steps grow shorter towards a root.
template <class S>
constexpr S stray() {
  return S(0.75);
}

// Solves d(s) - d(0) = offset from the start s[3] for the lanes in `going`.
//   c: the cell's coefficients [3][20];  reach: coordinate up to which a root counts as inside
//   s: start in, root out, cell coordinates;  inverse[9]: inverse of dd/ds at the root, posed metres to cell coordinates
// Returns the lanes that found a root in the cell.
template <class V, class C, class S, class Mask>
SNARF_HD Mask solve_in_cell(const C* c, const V* offset, Mask going, const Solver<S>& solver, S reach, V* s, V* inverse) {
  Mask found = going & (s[0] != s[0]);
  const S tolerance2 = solver.tolerance * solver.tolerance;
  for (int k = 1; k <= solver.max_steps; ++k) {
    V residual[3], jacobian[9], adj[9], step[3];
    for (int i = 0; i < 3; ++i) {
      evaluate_component(c + kMonomials * i, s[0], s[1], s[2], residual[i], jacobian + 3 * i);
      residual[i] = residual[i] - offset[i];
    }
    V reciprocal = S(1) / adjugate(jacobian, adj);
    for (int i = 0; i < 3; ++i)
      step[i] = (adj[3 * i] * residual[0] + adj[3 * i + 1] * residual[1] + adj[3 * i + 2] * residual[2]) * reciprocal;
    V longest = longest_of(step[0], step[1], step[2]);
    Mask close = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2] < tolerance2;
    Mask done = going & close & (longest < last_step<S>());
    Mask moves = going;
    if (k == solver.max_steps) {
      done = going & close & (longest < S(1e30));  // a singular Jacobian has no inverse to report
      moves = done & (longest < trusted_step<S>());
    }
    V share = S(1) / larger(longest, longest * S(0) + S(1));
    for (int i = 0; i < 3; ++i) s[i] = select(moves, s[i] - step[i] * share, s[i]);
    V from_centre = longest_of(s[0], s[1], s[2]);
    for (int i = 0; i < 9; ++i) inverse[i] = select(done, adj[i] * reciprocal, inverse[i]);
    found = found | (done & (from_centre <= reach));
    going = going & !done & (from_centre - S(0.5) <= smaller(longest, longest * S(0) + stray<S>()));
    if (!any(going)) break;
  }
  return found;
}

}  // namespace SNARF_ISA
}  // namespace snarf
