// What csrc/cuda/tensor_cores.cuh is on a GPU, on a CPU: the vectors of CUDA's language, a block's dynamic shared memory, and a
// warp's tensor cores, to the letter of the PTX ISA: every lane finds the elements that its sums need in the words of the lanes
// that hold them, and of a word only the bits that the hardware reads.
#pragma once

#include "cuda_shim.h"

struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
template <class T>
const T& __ldg(const T* at) {
  return *at;
}

constexpr unsigned kSharedBytes = 227 * 1024;  // of a block on Hopper
constexpr unsigned kWarp = 32, kMostWarps = 16;

#ifdef __SANITIZE_THREAD__
struct WarpBarrier : Block {
  WarpBarrier() : Block(kWarp) {}
};
inline WarpBarrier warp_barriers[kMostWarps];
inline void wait_for_warp(unsigned warp) { warp_barriers[warp].wait(); }
#else
// Fibers have barriers of whole blocks. All warps of the network's kernels multiply as often between two of these.
inline void wait_for_warp(unsigned) { running_block->wait(); }
#endif

// What the lanes of a warp give to their tensor cores. Two, used in turn, so that one barrier is enough: a lane is at most one
// product ahead of the others.
struct Given {
  uint4 left[kWarp][8], right[kWarp][2];
};
inline Given given[kMostWarps][2];
inline unsigned products_so_far[kWarp * kMostWarps];  // of each lane, the same for all lanes of a warp

namespace snarf {
namespace SNARF_ISA {

inline void* dynamic_memory() {
  alignas(16) static char memory[kSharedBytes];
  return memory;
}

inline float power_of_two(float x) { return exp2f(x); }

// To the nearest number with 13 bits less, halves away from zero; a NaN keeps its upper bits.
inline unsigned rounded_to_tf32(float value) {
  const unsigned bits = __float_as_uint(value);
  return (value == value ? bits + 0x1000u : bits | 0x2000u) & ~0x1fffu;
}

// To the nearest number with 16 bits less, halves to even.
inline unsigned rounded_to_bfloat16(float low, float high) {
  unsigned halves[2];
  for (int i = 0; i < 2; ++i) {
    const unsigned bits = __float_as_uint(i ? high : low);
    halves[i] = (i ? high == high : low == low) ? (bits + 0x7fffu + (bits >> 16 & 1)) >> 16 : 0x7fffu;
  }
  return halves[0] | halves[1] << 16;
}

inline unsigned word(const uint4& words, int i) { return i == 0 ? words.x : i == 1 ? words.y : i == 2 ? words.z : words.w; }

// The element at an inner index in the word of the lane that holds it: m16n8k8 of TF32, m16n8k16 of bfloat16.
template <int inner>
float element(unsigned word, int index) {
  return __uint_as_float(inner == 8 ? word & ~0x1fffu : index % 2 ? word & 0xffff0000u : word << 16);
}

template <class Kind, int kTall>
void add_products(float (*sums)[4][4], const uint4* left, const uint4* right) {
  constexpr int inner = Kind::kInner;
  const unsigned warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  Given& here = given[warp][products_so_far[threadIdx.x]++ % 2];
  for (int m = 0; m < kTall; ++m) here.left[lane][m] = left[m];
  for (int i = 0; i < 2; ++i) here.right[lane][i] = right[i];
  wait_for_warp(warp);
  for (int n = 0; n < 4; ++n)
    for (int r = 0; r < 4; ++r) {
      const int row = int(lane) / 4 + 8 * (r / 2), column = 2 * int(lane % 4) + r % 2;
      for (int k = 0; k < inner; ++k) {
        const int half = k / (inner / 2), in_half = k % (inner / 2), holder = inner == 8 ? in_half : in_half / 2;
        const unsigned held = word(here.right[4 * column + holder][n / 2], 2 * (n % 2) + half);
        for (int m = 0; m < kTall; ++m) {
          const unsigned value = word(here.left[4 * (row % 8) + holder][m], 2 * half + row / 8);
          sums[m][n][r] += element<inner>(value, k) * element<inner>(held, k);
        }
      }
    }
}

}  // namespace SNARF_ISA
}  // namespace snarf
