// The kernels of csrc/cuda/network.cu on the CPU.
#include "entries.h"
#include "snarf/platform.h"
#include "tensor_shim.h"

#include "network.cu"

namespace {

using namespace snarf::device;

const NamedKernel<const Packing> packing_kernels[] = {
    {"pack_float32", pack_float32},
    {"pack_tf32", pack_tf32},
    {"pack_bfloat16", pack_bfloat16},
};
const NamedKernel<const Evaluation> evaluation_kernels[] = {
    {"evaluate_float32_64", evaluate_float32_64},   {"evaluate_float32_128", evaluate_float32_128},
    {"evaluate_tf32_64", evaluate_tf32_64},         {"evaluate_tf32_128", evaluate_tf32_128},
    {"evaluate_bfloat16_64", evaluate_bfloat16_64}, {"evaluate_bfloat16_128", evaluate_bfloat16_128},
};

}  // namespace

// Returns whether there is a kernel of that name.
extern "C" bool emulate(const char* name, const void* arguments, unsigned x, unsigned y, unsigned threads) {
  return run_named(packing_kernels, name, arguments, x, y, threads) ||
         run_named(evaluation_kernels, name, arguments, x, y, threads);
}
extern "C" size_t packing_bytes() { return sizeof(Packing); }
extern "C" size_t evaluation_bytes() { return sizeof(Evaluation); }
