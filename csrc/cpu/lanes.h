// Packs of SIMD lanes behind the operators of a scalar, for the shared mathematics.
//
// GCC and Clang compile their vector types to the instructions that the flags of the translation unit allow; other
// compilers get loops over arrays.
#pragma once

#include <stdint.h>
#include <string.h>

#include "snarf/platform.h"

#if defined(__GNUC__) && (defined(__AVX512F__) || defined(__AVX2__))
#include <immintrin.h>
#endif

namespace snarf {
namespace SNARF_ISA {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <class S>
struct IntegerOf;
template <>
struct IntegerOf<float> {
  using type = int32_t;
};
template <>
struct IntegerOf<double> {
  using type = int64_t;
};

#if defined(__GNUC__)

template <class T, int W>
struct Pack {
  typedef T type __attribute__((vector_size(W * sizeof(T))));
};

template <class S>
struct Lanes {
  static constexpr int width = kVectorBytes / int(sizeof(S));
  using Vector = typename Pack<S, width>::type;
  Vector v;
  SNARF_HD Lanes() {}
  SNARF_HD Lanes(Vector vector) : v(vector) {}
  SNARF_HD Lanes(S scalar) : v(Vector{} + scalar) {}
  SNARF_HD S operator[](int lane) const { return v[lane]; }
};

template <class S>
struct LaneMask {
  using Integer = typename IntegerOf<S>::type;
  using Vector = typename Pack<Integer, Lanes<S>::width>::type;
  Vector v;  // all bits of a lane set, or none
};

#else

template <class T, int W>
struct Array {
  T at[W];
  T& operator[](int i) { return at[i]; }
  T operator[](int i) const { return at[i]; }
};

#define SNARF_EACH(result, type, expression)            \
  template <class T, int W>                             \
  SNARF_HD Array<type, W> result {                      \
    Array<type, W> out;                                 \
    for (int i = 0; i < W; ++i) out.at[i] = expression; \
    return out;                                         \
  }
SNARF_EACH(operator+(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] + b.at[i])
SNARF_EACH(operator-(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] - b.at[i])
SNARF_EACH(operator*(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] * b.at[i])
SNARF_EACH(operator/(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] / b.at[i])
SNARF_EACH(operator&(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] & b.at[i])
SNARF_EACH(operator|(const Array<T, W>& a, const Array<T, W>& b), T, a.at[i] | b.at[i])
SNARF_EACH(operator~(const Array<T, W>& a), T, ~a.at[i])
#undef SNARF_EACH

template <class S>
struct Lanes {
  static constexpr int width = kVectorBytes / int(sizeof(S));
  using Vector = Array<S, width>;
  Vector v;
  SNARF_HD Lanes() {}
  SNARF_HD Lanes(Vector vector) : v(vector) {}
  SNARF_HD Lanes(S scalar) {
    for (int i = 0; i < width; ++i) v.at[i] = scalar;
  }
  SNARF_HD S operator[](int lane) const { return v.at[lane]; }
};

template <class S>
struct LaneMask {
  using Integer = typename IntegerOf<S>::type;
  using Vector = Array<Integer, Lanes<S>::width>;
  Vector v;
};

#endif

#define SNARF_OPERATOR(op)                                                                        \
  template <class S>                                                                              \
  SNARF_HD Lanes<S> operator op(Lanes<S> a, Lanes<S> b) {                                         \
    return {a.v op b.v};                                                                          \
  }                                                                                               \
  SNARF_HD Lanes<float> operator op(Lanes<float> a, float b) { return a op Lanes<float>(b); }     \
  SNARF_HD Lanes<float> operator op(float a, Lanes<float> b) { return Lanes<float>(a) op b; }     \
  SNARF_HD Lanes<double> operator op(Lanes<double> a, double b) { return a op Lanes<double>(b); } \
  SNARF_HD Lanes<double> operator op(double a, Lanes<double> b) { return Lanes<double>(a) op b; }
SNARF_OPERATOR(+)
SNARF_OPERATOR(-)
SNARF_OPERATOR(*)
SNARF_OPERATOR(/)
#undef SNARF_OPERATOR

#if defined(__GNUC__)
#define SNARF_COMPARE(op)                                                                        \
  template <class S>                                                                             \
  SNARF_HD LaneMask<S> operator op(Lanes<S> a, Lanes<S> b) {                                     \
    return {a.v op b.v};                                                                         \
  }                                                                                              \
  SNARF_HD LaneMask<float> operator op(Lanes<float> a, float b) { return a op Lanes<float>(b); } \
  SNARF_HD LaneMask<double> operator op(Lanes<double> a, double b) { return a op Lanes<double>(b); }
#else
#define SNARF_COMPARE(op)                                                                        \
  template <class S>                                                                             \
  SNARF_HD LaneMask<S> operator op(Lanes<S> a, Lanes<S> b) {                                     \
    LaneMask<S> out;                                                                             \
    for (int i = 0; i < Lanes<S>::width; ++i) out.v.at[i] = a.v.at[i] op b.v.at[i] ? -1 : 0;     \
    return out;                                                                                  \
  }                                                                                              \
  SNARF_HD LaneMask<float> operator op(Lanes<float> a, float b) { return a op Lanes<float>(b); } \
  SNARF_HD LaneMask<double> operator op(Lanes<double> a, double b) { return a op Lanes<double>(b); }
#endif
SNARF_COMPARE(<)
SNARF_COMPARE(<=)
SNARF_COMPARE(>)
SNARF_COMPARE(>=)
SNARF_COMPARE(!=)
#undef SNARF_COMPARE

template <class S>
SNARF_HD LaneMask<S> operator&(LaneMask<S> a, LaneMask<S> b) {
  return {a.v & b.v};
}
template <class S>
SNARF_HD LaneMask<S> operator|(LaneMask<S> a, LaneMask<S> b) {
  return {a.v | b.v};
}
template <class S>
SNARF_HD LaneMask<S> operator!(LaneMask<S> a) {
  return {~a.v};
}

template <class S>
SNARF_HD Lanes<S> select(LaneMask<S> mask, Lanes<S> a, Lanes<S> b) {
#if defined(__GNUC__)
  return {mask.v ? a.v : b.v};
#else
  Lanes<S> out;
  for (int i = 0; i < Lanes<S>::width; ++i) out.v.at[i] = mask.v.at[i] ? a.v.at[i] : b.v.at[i];
  return out;
#endif
}
template <class S>
SNARF_HD Lanes<S> larger(Lanes<S> a, Lanes<S> b) {
  return select(a > b, a, b);
}
template <class S>
SNARF_HD Lanes<S> smaller(Lanes<S> a, Lanes<S> b) {
  return select(a < b, a, b);
}
template <class S>
SNARF_HD Lanes<S> absolute(Lanes<S> a) {
  return larger(a, Lanes<S>(S(0)) - a);
}

// Rounded towards zero; for numbers that fit the integer of the same size.
template <class S>
SNARF_HD Lanes<S> truncate(Lanes<S> a) {
#if defined(__GNUC__)
  return {__builtin_convertvector(__builtin_convertvector(a.v, typename LaneMask<S>::Vector), typename Lanes<S>::Vector)};
#else
  Lanes<S> out;
  for (int i = 0; i < Lanes<S>::width; ++i) out.v.at[i] = S(typename IntegerOf<S>::type(a.v.at[i]));
  return out;
#endif
}

template <class S>
SNARF_HD Lanes<S> load(const S* at) {
  Lanes<S> out;
  memcpy(&out.v, at, sizeof out.v);
  return out;
}
template <class S>
SNARF_HD void store(S* at, Lanes<S> value) {
  memcpy(at, &value.v, sizeof value.v);
}

// The first `count` numbers, a multiple of four, of `width` rows, as one pack each with a lane per row.
template <int count, class S>
SNARF_HD void load_rows(const S* const* row, Lanes<S>* out) {
  constexpr int width = Lanes<S>::width;
  for (int r = 0; r < count; ++r) {
    S column[width];
    for (int i = 0; i < width; ++i) column[i] = row[i][r];
    out[r] = load<S>(column);
  }
}

// a moved down by one lane, and `last` in the highest.
template <class S>
SNARF_HD Lanes<S> shifted(Lanes<S> a, S last) {
  constexpr int width = Lanes<S>::width;
  S values[width + 1];
  store(values, a);
  values[width] = last;
  return load<S>(values + 1);
}

#if defined(__AVX512F__) && defined(__GNUC__)
// Four rows share a register, 128 bits each, in such an order that transposing within the 128 bits puts every row in its lane.
template <int count>
SNARF_HD void load_rows(const float* const* row, Lanes<float>* out) {
  for (int r = 0; r < count; r += 4) {
    __m512 part[4];
    for (int i = 0; i < 4; ++i) {
      part[i] = _mm512_castps128_ps512(_mm_loadu_ps(row[i] + r));
      part[i] = _mm512_insertf32x4(part[i], _mm_loadu_ps(row[4 + i] + r), 1);
      part[i] = _mm512_insertf32x4(part[i], _mm_loadu_ps(row[8 + i] + r), 2);
      part[i] = _mm512_insertf32x4(part[i], _mm_loadu_ps(row[12 + i] + r), 3);
    }
    const __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(part[0], part[1])),
                  b = _mm512_castps_pd(_mm512_unpackhi_ps(part[0], part[1]));
    const __m512d c = _mm512_castps_pd(_mm512_unpacklo_ps(part[2], part[3])),
                  d = _mm512_castps_pd(_mm512_unpackhi_ps(part[2], part[3]));
    out[r].v = (Lanes<float>::Vector)_mm512_unpacklo_pd(a, c);
    out[r + 1].v = (Lanes<float>::Vector)_mm512_unpackhi_pd(a, c);
    out[r + 2].v = (Lanes<float>::Vector)_mm512_unpacklo_pd(b, d);
    out[r + 3].v = (Lanes<float>::Vector)_mm512_unpackhi_pd(b, d);
  }
}
SNARF_HD Lanes<float> shifted(Lanes<float> a, float last) {
  const __m512i next = _mm512_castps_si512(_mm512_set1_ps(last));
  return {(Lanes<float>::Vector)_mm512_alignr_epi32(next, (__m512i)a.v, 1)};
}
#elif defined(__AVX2__) && defined(__GNUC__)
template <int count>
SNARF_HD void load_rows(const float* const* row, Lanes<float>* out) {
  for (int r = 0; r < count; r += 4) {
    __m256 part[4];
    for (int i = 0; i < 4; ++i)
      part[i] = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(row[i] + r)), _mm_loadu_ps(row[4 + i] + r), 1);
    const __m256d a = _mm256_castps_pd(_mm256_unpacklo_ps(part[0], part[1])),
                  b = _mm256_castps_pd(_mm256_unpackhi_ps(part[0], part[1]));
    const __m256d c = _mm256_castps_pd(_mm256_unpacklo_ps(part[2], part[3])),
                  d = _mm256_castps_pd(_mm256_unpackhi_ps(part[2], part[3]));
    out[r].v = (Lanes<float>::Vector)_mm256_unpacklo_pd(a, c);
    out[r + 1].v = (Lanes<float>::Vector)_mm256_unpackhi_pd(a, c);
    out[r + 2].v = (Lanes<float>::Vector)_mm256_unpacklo_pd(b, d);
    out[r + 3].v = (Lanes<float>::Vector)_mm256_unpackhi_pd(b, d);
  }
}
#endif

// One bit per lane, lane 0 lowest.
template <class S>
SNARF_HD uint32_t bits(LaneMask<S> mask) {
#if defined(__GNUC__) && defined(__AVX512DQ__)
  if (sizeof(S) == 4) return (uint32_t)_mm512_movepi32_mask((__m512i)mask.v);
  return (uint32_t)_mm512_movepi64_mask((__m512i)mask.v);
#elif defined(__GNUC__) && defined(__AVX2__)
  if (sizeof(S) == 4) return (uint32_t)_mm256_movemask_ps((__m256)mask.v);
  return (uint32_t)_mm256_movemask_pd((__m256d)mask.v);
#else
  uint32_t out = 0;
  for (int i = 0; i < Lanes<S>::width; ++i) out |= (mask.v[i] ? 1u : 0u) << i;
  return out;
#endif
}
template <class S>
SNARF_HD bool any(LaneMask<S> mask) {
  return bits(mask) != 0;
}

// The mask whose first `count` lanes are set.
template <class S>
SNARF_HD LaneMask<S> first_lanes(int count) {
  LaneMask<S> out;
  for (int i = 0; i < Lanes<S>::width; ++i) out.v[i] = i < count ? -1 : 0;
  return out;
}

SNARF_HD int lowest_bit(uint32_t mask) {
#if defined(__GNUC__)
  return __builtin_ctz(mask);
#else
  int n = 0;
  while (!(mask >> n & 1)) ++n;
  return n;
#endif
}

}  // namespace SNARF_ISA
}  // namespace snarf
