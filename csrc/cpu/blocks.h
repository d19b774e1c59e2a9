// Loops over a few numbers, of which blocks of fixed size stay in registers.
#pragma once

#include <type_traits>

#include "lanes.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// Calls block(first, size) for blocks of 16, 8, 4 and 1 numbers that make up `count`; the size is known when this is compiled.
template <class Block>
SNARF_HD void for_blocks(int count, const Block& block) {
  int first = 0;
  for (; first + 16 <= count; first += 16) block(first, std::integral_constant<int, 16>());
  for (; first + 8 <= count; first += 8) block(first, std::integral_constant<int, 8>());
  for (; first + 4 <= count; first += 4) block(first, std::integral_constant<int, 4>());
  for (; first < count; ++first) block(first, std::integral_constant<int, 1>());
}

}  // namespace
}  // namespace SNARF_ISA
}  // namespace snarf
