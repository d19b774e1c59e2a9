// Products of small matrices by a warp's tensor cores (sm_80 and later), in the instructions of PTX: NVRTC has no <mma.h>.
//
// A matrix is spread over the 32 lanes of a warp (PTX ISA, "Matrix Fragments for mma.m16n8k8", .tf32, and "mma.m16n8k16",
// .bf16). With g = lane / 4 and t = lane % 4 a lane holds
//   of the left matrix,  16 x inner  four words: rows g and g + 8 of the first half of the inner indices, then of the second;
//   of the right matrix, inner x 8   two words: column g of the first half, then of the second;
//   of the sums,         16 x 8      rows g, g, g + 8, g + 8 in columns 2 t, 2 t + 1, 2 t, 2 t + 1.
// A word is one TF32 number, inner index t of a half of four, or two bfloat16 numbers, inner indices 2 t and 2 t + 1 of a half
// of eight. These instructions are those of all chips since Ampere; Hopper has faster ones (wgmma), which take the weights from
// shared memory. What a CPU's compiler cannot have is in tests/native/emulation/tensor_shim.h.
#pragma once

#include "snarf/platform.h"

namespace snarf {
namespace SNARF_ISA {

#if defined(__CUDACC__)
// The shared memory of a block, as much as the launch has asked for.
__device__ void* dynamic_memory() {
  extern __shared__ uint4 memory[];
  return memory;
}

// 2^x for x <= 0, with a relative error of at most 2^-22.
__device__ float power_of_two(float x) {
  float power;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(x));
  return power;
}
#endif

#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
// To the nearest TF32 number: 10 bits behind the binary point.
__device__ unsigned rounded_to_tf32(float value) {
  unsigned word;
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(word) : "f"(value));
  return word;
}

// To the nearest bfloat16 numbers, `low` in the lower half of the word.
__device__ unsigned rounded_to_bfloat16(float low, float high) {
  unsigned word;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(word) : "f"(high), "f"(low));
  return word;
}

struct Tf32;  // products.cuh
struct Bfloat16;

// One instruction.
template <class Kind>
__device__ void add_product(float* sums, const uint4& left, unsigned first, unsigned second);
template <>
__device__ void add_product<Tf32>(float* sums, const uint4& left, unsigned first, unsigned second) {
  asm volatile("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
               : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
               : "r"(left.x), "r"(left.y), "r"(left.z), "r"(left.w), "r"(first), "r"(second));
}

template <>
__device__ void add_product<Bfloat16>(float* sums, const uint4& left, unsigned first, unsigned second) {
  asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
               : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
               : "r"(left.x), "r"(left.y), "r"(left.z), "r"(left.w), "r"(first), "r"(second));
}

// sums[m][n] += left[m] right[n] for kTall left and four right matrices; the words of two right ones are in one uint4. One
// call, so that an emulation exchanges the words of a warp once.
template <class Kind, int kTall>
__device__ void add_products(float (*sums)[4][4], const uint4* left, const uint4* right) {
  SNARF_UNROLL
  for (int m = 0; m < kTall; ++m) SNARF_UNROLL
  for (int n = 0; n < 4; n += 2) {
    add_product<Kind>(sums[m][n], left[m], right[n / 2].x, right[n / 2].y);
    add_product<Kind>(sums[m][n + 1], left[m], right[n / 2].z, right[n / 2].w);
  }
}
#endif

}  // namespace SNARF_ISA
}  // namespace snarf
