// One grid cell as a polynomial: its posed image, its curvature, and its eight parts.
//
// DESIGN. Inside a cell the blended transform T is trilinear (Fast-SNARF Sec. 4.1) and d(x) = T(x) [x; 1] (SNARF Eq. 4), so
// each component of d is a polynomial in the cell's coordinates s = (s0, s1, s2), which run from -1/2 to 1/2: the eight
// trilinear monomials and, for each axis a, s_a^2 times the four bilinear monomials of the other two; twenty in all. Halving
// the cell stays inside this space. With the coordinates centred, every monomial other than 1 is at most (1/2)^degree, which
// bounds everything by sums of absolute coefficients:
//   posed box           |d - d(0)|_i       <= sum_m |c_mi| (1/2)^deg(m)
//   preconditioned      |J0^-1 (d - d(0)) - s|_i <= sum_{m nonlinear} |J0^-1 c_m|_i (1/2)^deg(m)
//   its derivative      row sums           <= sum_{m nonlinear} |J0^-1 c_m|_i deg(m) (1/2)^(deg(m)-1)  =: curvature
// Curvature below one proves that d is injective in the cell: at most one root. Below about 3/4 it also proves that Newton's
// method from the affine guess finds it; up to 0.9 (kTame) no miss was ever measured (tests/deformer/test_native_search.py). A
// cell beyond that (next to a fold, where det J changes sign, it always is) is cut into eight, again and again.
#pragma once

#include "platform.h"

namespace snarf {
namespace SNARF_ISA {

// Monomials: m < 8 is the product of the axes in the bits of m (1, s0, s1, s0 s1, s2, ...); 8 + 4 a + k is s_a^2 times
// 1, the first, the second, and the product of the other two axes (in ascending order).
constexpr int kMonomials = 20;

// Fraction of a cell beyond its faces within which a root still belongs to it: rounding may put a root on a face outside of
// both neighbours. Both then report it, and one is dropped.
template <class T>
constexpr T face_tolerance() {
  return sizeof(T) == 4 ? T(1e-4) : T(1e-9);
}

template <class V>
struct Cell {
  V c[3 * kMonomials];  // [component][monomial]; c[20 i] is the posed centre, metres
};

template <class V>
struct CellBounds {
  V box[3];      // half extents of the posed box around the centre, metres
  V inverse[9];  // J0^-1, posed metres to cell coordinates; zero where J0 is singular
  V reach[3];    // a root in the cell has |J0^-1 (x' - centre)|_i <= reach_i
  V curvature;   // below one: at most one root
};

SNARF_HD int monomial_degree(int m) { return m < 8 ? (m & 1) + (m >> 1 & 1) + (m >> 2 & 1) : 2 + ((m & 3) + 1) / 2; }
SNARF_HD int square_monomial(int axis, int others) { return 8 + 4 * axis + others; }

// Coefficients from the corner transforms.
//   corner[k * 12 + r]: blended 3x4 transforms (row-major) at the corners, k = x + 2 y + 4 z; overwritten
//   centre[3], size[3]: canonical centre and sides of the cell, metres
template <class V, class S>
SNARF_HD void cell_from_corners(V* corner, const V* centre, const S* size, Cell<V>& cell) {
  // Trilinear coefficients of T in centred coordinates, in place: index k becomes the monomial with the bits of k.
  for (int channel = 0; channel < 12; ++channel) SNARF_UNROLL
  for (int bit = 1; bit < 8; bit <<= 1) SNARF_UNROLL
  for (int k = 0; k < 8; ++k)
    if (!(k & bit)) {
      V& low = corner[k * 12 + channel];
      V& high = corner[(k | bit) * 12 + channel];
      V difference = high - low;
      low = (low + high) * S(0.5);
      high = difference;
    }
  for (int i = 0; i < 3; ++i) {
    V* c = cell.c + kMonomials * i;
    const V* row = corner + 4 * i;
    SNARF_UNROLL
    for (int m = 0; m < 8; ++m) {
      const V* t = row + 12 * m;
      c[m] = t[0] * centre[0] + t[1] * centre[1] + t[2] * centre[2] + t[3];
      SNARF_UNROLL
      for (int axis = 0; axis < 3; ++axis)
        if (m >> axis & 1) c[m] = c[m] + row[12 * (m & ~(1 << axis)) + axis] * size[axis];
    }
    SNARF_UNROLL
    for (int axis = 0; axis < 3; ++axis) {
      int first = axis == 0 ? 2 : 1, second = axis == 2 ? 2 : 4;
      SNARF_UNROLL
      for (int others = 0; others < 4; ++others) {
        int m = (1 << axis) | (others & 1 ? first : 0) | (others & 2 ? second : 0);
        c[square_monomial(axis, others)] = row[12 * m + axis] * size[axis];
      }
    }
  }
}

// Half extents [3] of the posed box, rigorous up to rounding, for which slack is added. `wide`: coordinate up to which a root
// counts as in the cell.
template <class V, class S>
SNARF_HD void bound_box(const Cell<V>& cell, V* box, S wide = S(0.5) + face_tolerance<S>()) {
  constexpr S epsilon = sizeof(S) == 4 ? S(1e-6) : S(1e-14);
  for (int i = 0; i < 3; ++i) {
    const V* c = cell.c + kMonomials * i;
    V sums[5];  // by degree
    SNARF_UNROLL
    for (int degree = 1; degree < 5; ++degree) sums[degree] = c[0] * S(0);
    SNARF_UNROLL
    for (int m = 1; m < kMonomials; ++m) sums[monomial_degree(m)] = sums[monomial_degree(m)] + absolute(c[m]);
    V extent = (((sums[4] * wide + sums[3]) * wide + sums[2]) * wide + sums[1]) * wide;
    box[i] = extent * (S(1) + S(16) * epsilon) + absolute(c[0]) * epsilon;
  }
}

// Inverse of the Jacobian at the centre, posed metres to cell coordinates; zero where it is singular up to rounding. Returns
// where it is not.
template <class V, class S>
SNARF_HD auto centre_inverse(const Cell<V>& cell, V* inverse) {
  constexpr S epsilon = sizeof(S) == 4 ? S(1e-6) : S(1e-14);
  V jacobian[9], adj[9];
  for (int i = 0; i < 3; ++i) {
    const V* c = cell.c + kMonomials * i;
    jacobian[3 * i] = c[1];
    jacobian[3 * i + 1] = c[2];
    jacobian[3 * i + 2] = c[4];
  }
  V determinant = adjugate(jacobian, adj);
  V zero = determinant * S(0);
  V scale = zero + epsilon;
  for (int axis = 0; axis < 3; ++axis) scale = scale * longest_of(jacobian[axis], jacobian[3 + axis], jacobian[6 + axis]);
  auto regular = absolute(determinant) > scale;
  V reciprocal = select(regular, zero + S(1), zero) / select(regular, determinant, zero + S(1));
  for (int k = 0; k < 9; ++k) inverse[k] = adj[k] * reciprocal;
  return regular;
}

// All bounds of the cell, with the same slack. A Jacobian that is singular gives no bound on roots.
template <class V, class S>
SNARF_HD void bound_cell(const Cell<V>& cell, CellBounds<V>& out, S wide = S(0.5) + face_tolerance<S>()) {
  constexpr S epsilon = sizeof(S) == 4 ? S(1e-6) : S(1e-14);
  bound_box<V, S>(cell, out.box, wide);
  const auto regular = centre_inverse<V, S>(cell, out.inverse);
  const V zero = out.box[0] * S(0);
  out.curvature = zero;
  for (int i = 0; i < 3; ++i) {
    const V* row = out.inverse + 3 * i;
    V sums[5];
    SNARF_UNROLL
    for (int degree = 2; degree < 5; ++degree) sums[degree] = zero;
    SNARF_UNROLL
    for (int m = 0; m < kMonomials; ++m) {
      if (monomial_degree(m) < 2) continue;
      const V* c = cell.c + m;
      V y = absolute(row[0] * c[0] + row[1] * c[kMonomials] + row[2] * c[2 * kMonomials]);
      sums[monomial_degree(m)] = sums[monomial_degree(m)] + y;
    }
    V reach = ((sums[4] * wide + sums[3]) * wide + sums[2]) * (wide * wide) + wide;
    V slope = sums[2] + sums[3] * S(0.75) + sums[4] * S(0.5);
    V rounding =
        absolute(row[0] * cell.c[0]) + absolute(row[1] * cell.c[kMonomials]) + absolute(row[2] * cell.c[2 * kMonomials]);
    out.reach[i] = select(regular, reach + (rounding + reach) * epsilon, zero + S(1e30));
    out.curvature = larger(out.curvature, slope);
  }
  out.curvature = select(regular, out.curvature, zero + S(1e30));
}

// Whether a query at `offset` [3] from the posed centre may have a root in the cell.
template <class V>
SNARF_HD auto may_hold(const V* box, const V* inverse, const V* reach, const V* offset) {
  auto inside = (absolute(offset[0]) <= box[0]) & (absolute(offset[1]) <= box[1]) & (absolute(offset[2]) <= box[2]);
  for (int i = 0; i < 3; ++i) {
    V y = inverse[3 * i] * offset[0] + inverse[3 * i + 1] * offset[1] + inverse[3 * i + 2] * offset[2];
    inside = inside & (absolute(y) <= reach[i]);
  }
  return inside;
}

// The part of a cell around s = shift (each +-1/4) with half its sides, in its own centred coordinates: s = shift + s' / 2.
template <class V, class S>
SNARF_HD void halve_cell(const Cell<V>& cell, const V* shift, Cell<V>& part) {
  for (int i = 0; i < 3; ++i) {
    V* c = part.c + kMonomials * i;
    for (int m = 0; m < kMonomials; ++m) c[m] = cell.c[kMonomials * i + m];
    SNARF_UNROLL
    for (int axis = 0; axis < 3; ++axis) {
      V h = shift[axis];
      int first = axis == 0 ? 1 : 0, second = axis == 2 ? 1 : 2;
      int bit = 1 << axis, first_bit = 1 << first, second_bit = 1 << second;
      // a + b s + c s^2 with s = h + s' / 2, for the four monomials of the other two axes ...
      SNARF_UNROLL
      for (int others = 0; others < 4; ++others) {
        int base = (others & 1 ? first_bit : 0) | (others & 2 ? second_bit : 0);
        V& a = c[base];
        V& b = c[base | bit];
        V& q = c[square_monomial(axis, others)];
        a = a + h * (b + h * q);
        b = (b + S(2) * h * q) * S(0.5);
        q = q * S(0.25);
      }
      // ... and a + b s for the squares of the others.
      SNARF_UNROLL
      for (int other = 0; other < 2; ++other) {
        int squared = other ? second : first, companion = other ? first : second;
        // Among the companions of squared^2, this axis and `companion` in ascending order.
        int mine = axis < companion ? 1 : 2, theirs = 3 - mine;
        SNARF_UNROLL
        for (int with = 0; with < 2; ++with) {
          V& a = c[square_monomial(squared, with ? theirs : 0)];
          V& b = c[square_monomial(squared, with ? 3 : mine)];
          a = a + h * b;
          b = b * S(0.5);
        }
      }
    }
  }
}

// One component of d - d(0) and its derivatives by the cell coordinates. c: [20] as in Cell, of scalars or lanes.
template <class V, class C>
SNARF_HD void evaluate_component(const C* c, V s, V t, V r, V& value, V* gradient) {
  V tt = t + t, rr = r + r, ss = s + s, r2 = r * r;
  // Collected by powers of s: d = A + s B + s^2 Q, with A, B quadratic and Q bilinear in t and r.
  V ap = c[12] + c[14] * r, aq = c[2] + c[6] * r + c[18] * r2;
  V a = c[4] * r + c[16] * r2 + t * (aq + t * ap);
  V at = aq + tt * ap;
  V ar = c[4] + t * (c[6] + c[14] * t) + rr * (c[16] + c[18] * t);
  V bp = c[13] + c[15] * r, bq = c[3] + c[7] * r + c[19] * r2;
  V b = c[1] + c[5] * r + c[17] * r2 + t * (bq + t * bp);
  V bt = bq + tt * bp;
  V br = c[5] + t * (c[7] + c[15] * t) + rr * (c[17] + c[19] * t);
  V qt = c[9] + c[11] * r, qr = c[10] + c[11] * t;
  V q = c[8] + c[10] * r + t * qt;
  value = a + s * (b + s * q);
  gradient[0] = b + ss * q;
  gradient[1] = at + s * (bt + s * qt);
  gradient[2] = ar + s * (br + s * qr);
}

}  // namespace SNARF_ISA
}  // namespace snarf
