// Random bits that depend on a step and a place only (snarfcli/draws.py).
//
// DESIGN. One thread a number. Each hashes the step anew, in some thirty instructions, instead of reading the hash from memory.
// The step is read from the device, so that a CUDA graph draws other numbers in every replay.
#include "snarf/platform.h"

namespace snarf {
namespace SNARF_ISA {

struct DrawTask {
  const long long* step;  // [1], of which the lower 32 bits count
  long long* bits;        // [count], results, each from 0 to below 2^32
  long long count;
  unsigned key;  // different for numbers that should be independent
};

// `_mixed` of snarfcli/draws.py.
__device__ unsigned mixed_bits(unsigned bits) {
  for (int i = 0; i < 2; ++i) {
    bits = (bits ^ bits >> 16) * 0x7feb352du;
    bits = (bits ^ bits >> 15) * 0x7feb352du;
  }
  return bits ^ bits >> 16;
}

extern "C" __global__ void __launch_bounds__(256) draw_bits(const DrawTask a) {
  const long long place = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (place >= a.count) return;
  const unsigned step = (unsigned)*a.step;
  const unsigned first = mixed_bits(step ^ a.key), second = mixed_bits(step + mixed_bits(a.key));
  a.bits[place] = mixed_bits(mixed_bits((unsigned)place ^ first) + second);
}

}  // namespace SNARF_ISA
}  // namespace snarf
