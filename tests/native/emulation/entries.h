// Kernels by name.
#pragma once

#include "cuda_shim.h"

template <class Arguments>
struct NamedKernel {
  const char* name;
  void (*kernel)(Arguments);
};

static std::vector<Work> last_work;  // of the last launch, by block
static unsigned seed_of_order = 0;   // of the next launches, see order_of_blocks()

template <class Arguments, size_t count>
bool run_named(const NamedKernel<Arguments> (&entries)[count], const char* name, const void* arguments, unsigned x, unsigned y,
               unsigned threads) {
  for (const auto& entry : entries)
    if (!strcmp(entry.name, name)) {
      run_grid(entry.kernel, *static_cast<const Arguments*>(arguments), x, y, threads, seed_of_order, last_work);
      return true;
    }
  return false;
}

extern "C" void shuffle_blocks(unsigned seed) { seed_of_order = seed; }

// What the blocks of the last launch did, [blocks, 2, 3]: sum over the threads and the most of one; rounds, halvings, solves.
extern "C" const long long* work_of_blocks() { return &last_work.data()->rounds; }
