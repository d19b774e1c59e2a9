// Chooses the kernels for the instruction set of this processor.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace snarf {

enum InstructionSet { kBaseline, kAvx2, kAvx512 };

inline InstructionSet best_instruction_set() {
  InstructionSet best = kBaseline;
#if defined(SNARF_X86_KERNELS)
#if defined(__GNUC__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
      __builtin_cpu_supports("bmi2"))
    best = kAvx2;
  if (best == kAvx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
    best = kAvx512;
#endif
#endif
  const char* wish = std::getenv("SNARF_INSTRUCTION_SET");
  if (wish && !std::strcmp(wish, "baseline")) best = kBaseline;
  if (wish && !std::strcmp(wish, "avx2")) best = std::min(best, kAvx2);
  return best;
}

inline InstructionSet instruction_set() {
  static const InstructionSet chosen = best_instruction_set();
  return chosen;
}

template <class S>
const Kernels<S>& kernels() {
#if defined(SNARF_X86_KERNELS)
  static const Kernels<S> chosen = instruction_set() == kAvx512 ? avx512::kernels<S>()
                                   : instruction_set() == kAvx2 ? avx2::kernels<S>()
                                                                : baseline::kernels<S>();
#else
  static const Kernels<S> chosen = baseline::kernels<S>();
#endif
  return chosen;
}

}  // namespace snarf
