// The kernels of csrc/cuda but those of the network on the CPU, for one type of numbers (SNARF_NUMBER).
#include "entries.h"

#include "broyden.cu"
#include "candidates.cu"
#include "complete.cu"
#include "draws.cu"
#include "encoding.cu"
#include "gather.cu"
#include "implicit.cu"
#include "interpolate.cu"
#include "optimizer.cu"
#include "parts.cu"
#include "segments.cu"
#include "variation.cu"

namespace {

using namespace snarf::device;

const NamedKernel<const Search<Number>> search_kernels[] = {
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
const NamedKernel<const Backward<Number>> backward_kernels[] = {{"implicit_backward", implicit_backward}};
const NamedKernel<const DrawTask> draw_kernels[] = {{"draw_bits", draw_bits}};
const NamedKernel<const Encoding> encoding_kernels[] = {
    {"encode_points", encode_points},
    {"encode_backward", encode_backward},
};
const NamedKernel<const Interpolation<Number>> interpolation_kernels[] = {{"interpolate_values", interpolate_values}};
const NamedKernel<const AdamLaunch> optimizer_kernels[] = {
    {"check_gradients", check_gradients},
    {"update_parameters", update_parameters},
};
const NamedKernel<const SegmentDistance> segment_kernels[] = {{"measure_distances", measure_distances}};
const NamedKernel<const Variation> variation_kernels[] = {
    {"count_pairs", count_pairs},
    {"measure_changes", measure_changes},
    {"sum_changes", sum_changes},
};

}  // namespace

// Returns whether there is a kernel of that name.
extern "C" bool emulate(const char* name, const void* arguments, unsigned x, unsigned y, unsigned threads) {
  return run_named(search_kernels, name, arguments, x, y, threads) ||
         run_named(backward_kernels, name, arguments, x, y, threads) ||
         run_named(draw_kernels, name, arguments, x, y, threads) ||
         run_named(encoding_kernels, name, arguments, x, y, threads) ||
         run_named(interpolation_kernels, name, arguments, x, y, threads) ||
         run_named(optimizer_kernels, name, arguments, x, y, threads) ||
         run_named(segment_kernels, name, arguments, x, y, threads) ||
         run_named(variation_kernels, name, arguments, x, y, threads);
}
extern "C" size_t search_bytes() { return sizeof(Search<Number>); }
extern "C" size_t backward_bytes() { return sizeof(Backward<Number>); }
extern "C" size_t encoding_bytes() { return sizeof(Encoding); }
extern "C" size_t interpolation_bytes() { return sizeof(Interpolation<Number>); }
extern "C" size_t optimizer_bytes() { return sizeof(AdamLaunch); }
extern "C" size_t optimizer_task_bytes() { return sizeof(snarf::AdamTask); }
extern "C" size_t segment_bytes() { return sizeof(SegmentDistance); }
extern "C" size_t variation_bytes() { return sizeof(Variation); }
