// All kernels of csrc/cuda on the CPU, for one type of numbers (SNARF_NUMBER).
#include "cuda_shim.h"

#include "broyden.cu"
#include "candidates.cu"
#include "complete.cu"
#include "draws.cu"
#include "gather.cu"
#include "implicit.cu"
#include "optimizer.cu"
#include "parts.cu"

namespace {

using namespace snarf::device;

template <class Arguments>
struct Entry {
  const char* name;
  void (*kernel)(Arguments);
};

std::vector<Work> last_work;  // of the last launch, by block

template <class Arguments, size_t count>
bool run_named(const Entry<Arguments> (&entries)[count], const char* name, const void* arguments, unsigned x, unsigned y,
               unsigned threads) {
  for (const auto& entry : entries)
    if (!strcmp(entry.name, name)) {
      run_grid(entry.kernel, *static_cast<const Arguments*>(arguments), x, y, threads, last_work);
      return true;
    }
  return false;
}

const Entry<const Search<Number>> search_kernels[] = {
    {"survey", survey},
    {"count_queries", count_queries},
    {"place_queries", place_queries},
    {"search_cells", search_cells},
    {"search_rest", search_rest},
    {"halve_parts", halve_parts},
    {"solve_parts", solve_parts},
    {"search_from_starts", search_from_starts},
    {"collect_roots", collect_roots},
    {"write_roots", write_roots},
};
const Entry<const Backward<Number>> backward_kernels[] = {{"implicit_backward", implicit_backward}};
const Entry<const DrawTask> draw_kernels[] = {{"draw_bits", draw_bits}};
const Entry<const AdamLaunch> optimizer_kernels[] = {
    {"check_gradients", check_gradients},
    {"update_parameters", update_parameters},
};

}  // namespace

// Returns whether there is a kernel of that name.
extern "C" bool emulate(const char* name, const void* arguments, unsigned x, unsigned y, unsigned threads) {
  return run_named(search_kernels, name, arguments, x, y, threads) ||
         run_named(backward_kernels, name, arguments, x, y, threads) ||
         run_named(draw_kernels, name, arguments, x, y, threads) ||
         run_named(optimizer_kernels, name, arguments, x, y, threads);
}
// What the blocks of the last launch did, [blocks, 2, 3]: sum over the threads and the most of one; rounds, halvings, solves.
extern "C" const long long* work_of_blocks() { return &last_work.data()->rounds; }
extern "C" size_t search_bytes() { return sizeof(Search<Number>); }
extern "C" size_t backward_bytes() { return sizeof(Backward<Number>); }
extern "C" size_t optimizer_bytes() { return sizeof(AdamLaunch); }
extern "C" size_t optimizer_task_bytes() { return sizeof(snarf::AdamTask); }
