// Kernels by name.
#pragma once

#include "cuda_shim.h"

template <class Arguments>
struct Entry {
  const char* name;
  void (*kernel)(Arguments);
};

template <class Arguments, size_t count>
bool run_named(const Entry<Arguments> (&entries)[count], const char* name, const void* arguments, unsigned x, unsigned y,
               unsigned threads) {
  for (const auto& entry : entries)
    if (!strcmp(entry.name, name)) {
      run_grid(entry.kernel, *static_cast<const Arguments*>(arguments), x, y, threads);
      return true;
    }
  return false;
}
