// Compiler support for the shared mathematics: host and device markers, and the few operations that a scalar and a pack of
// SIMD lanes have in common. Included by the CPU kernels (GCC, Clang, MSVC) and by the CUDA kernels (NVRTC): no standard
// headers.
//
// Everything is templated on V, the type of a number: float or double, or a pack of them (csrc/cpu/lanes.h). A comparison of V
// gives a Mask: bool for a scalar.
//
// SNARF_ISA names an inner namespace. The CPU kernels are compiled once per instruction set, and two instantiations of one
// template must not be merged by the linker: the survivor could use instructions that the machine lacks.
#pragma once

#ifndef SNARF_ISA
#define SNARF_ISA device
#endif

#if defined(__CUDACC__)
#define SNARF_HD __host__ __device__ __forceinline__
#elif defined(__GNUC__)
#define SNARF_HD inline __attribute__((always_inline))
#else
#define SNARF_HD __forceinline
#endif

// Before a loop of few rounds whose indices should be known to the compiler.
#if defined(__CUDACC__) || defined(__clang__)
#define SNARF_UNROLL _Pragma("unroll")
#elif defined(__GNUC__)
#define SNARF_UNROLL _Pragma("GCC unroll 32")
#else
#define SNARF_UNROLL
#endif

namespace snarf {
namespace SNARF_ISA {

SNARF_HD float select(bool mask, float a, float b) { return mask ? a : b; }
SNARF_HD double select(bool mask, double a, double b) { return mask ? a : b; }
SNARF_HD float absolute(float a) { return a < 0 ? -a : a; }
SNARF_HD double absolute(double a) { return a < 0 ? -a : a; }
SNARF_HD float larger(float a, float b) { return a > b ? a : b; }
SNARF_HD double larger(double a, double b) { return a > b ? a : b; }
SNARF_HD float smaller(float a, float b) { return a < b ? a : b; }
SNARF_HD double smaller(double a, double b) { return a < b ? a : b; }
SNARF_HD float truncate(float a) { return float(int(a)); }
SNARF_HD bool any(bool mask) { return mask; }

// The largest absolute value of three.
template <class V>
SNARF_HD V longest_of(V a, V b, V c) {
  return larger(absolute(a), larger(absolute(b), absolute(c)));
}

// Adjugate (row-major [9]) of the row-major 3x3 matrix m; returns the determinant. Inverse = adjugate / determinant.
template <class V>
SNARF_HD V adjugate(const V* m, V* adj) {
  adj[0] = m[4] * m[8] - m[5] * m[7];
  adj[1] = m[2] * m[7] - m[1] * m[8];
  adj[2] = m[1] * m[5] - m[2] * m[4];
  adj[3] = m[5] * m[6] - m[3] * m[8];
  adj[4] = m[0] * m[8] - m[2] * m[6];
  adj[5] = m[2] * m[3] - m[0] * m[5];
  adj[6] = m[3] * m[7] - m[4] * m[6];
  adj[7] = m[1] * m[6] - m[0] * m[7];
  adj[8] = m[0] * m[4] - m[1] * m[3];
  return m[0] * adj[0] + m[1] * adj[3] + m[2] * adj[6];
}

}  // namespace SNARF_ISA
}  // namespace snarf
