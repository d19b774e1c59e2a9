// The C interface of the CPU library: checks arguments, dispatches on the number type, and lets no exception out.
#include <algorithm>
#include <limits>
#include <memory>
#include <new>

#include "blending.h"
#include "complete_search.h"
#include "dispatch.h"
#include "network.h"
#include "prepared.h"
#include "training.h"
#include "roots.h"
#include "snarf/api.h"

using namespace snarf;

namespace {

template <class S>
void broyden_search(const snarf_field& field, const snarf_queries& queries, const snarf_broyden& settings, RootsOf<S>& out) {
  if (!queries.poses || !queries.count || !settings.count) return;
  BroydenTask<S> common;
  common.geometry = geometry_of<S>(field);
  common.count = settings.count;
  common.tolerance = S(settings.tolerance);
  common.divergence = S(settings.divergence);
  common.same_root = S(kSameBroydenRoot) * smallest_side(common.geometry);
  common.max_steps = settings.max_steps;
  common.starts_are_points = settings.starts_are_points != 0;
  common.exact_jacobian = settings.exact_jacobian != 0;
  common.orientation_preserving = settings.orientation_preserving != 0;
  const int64_t at_once = std::min(queries.count, kGroupQueries);
  for (int64_t pose = 0; pose < queries.poses; ++pose)
    for (int64_t query = 0; query < queries.count; query += at_once) {
      const int64_t count = std::min(at_once, queries.count - query);
      const int threads = threads_for(queries, count * settings.count);
      std::unique_ptr<Group<S>> group(new Group<S>());
      group->first_query = pose * queries.count + query;
      group->lists.resize(threads);
      BroydenTask<S> task = common;
      task.transforms = static_cast<const S*>(field.transforms) + 12 * node_count(field) * pose;
      task.points = static_cast<const S*>(queries.points) + 3 * (pose * queries.count + query);
      const int64_t before = common.starts_are_points ? 3 * (pose * queries.count + query) : 12 * pose;
      task.starts = static_cast<const S*>(settings.starts) + settings.count * before;
      Queue queue(count, 256);
      Collect<S> collect(*group, count, threads, common.same_root);
      std::vector<std::function<void(int)>> phases;
      phases.push_back([&](int thread) {
        group->lists[thread].reset(new RootList<S>());
        for (int64_t first, last; queue.take(first, last);)
          kernels<S>().broyden(task, first, last, group->lists[thread]->sink());
      });
      collect.add_to(phases);
      if (!run_phases(threads, phases)) throw std::bad_alloc();
      out.groups.push_back(std::move(group));
    }
}

template <class S>
void implicit_backward(const snarf_field& field, const snarf_queries& queries, int64_t roots, const S* gradient,
                       const S* canonical, const int64_t* query, const S* inverse, S* v_points, S* v_transforms) {
  const int64_t nodes = node_count(field), layers = field.nodes[2];
  if (!roots || !queries.poses || !queries.count) return;
  const int threads = threads_for(queries, roots);
  // Each pose writes to separate nodes. Those of a pose are cut into layers, whose threads read the same roots in the same
  // order.
  const int64_t slabs = std::min<int64_t>(layers, (threads + queries.poses - 1) / queries.poses);
  Queue transforms_queue(v_transforms ? queries.poses * slabs : 0, 1), points_queue(v_points ? queries.poses : 0, 1);
  const auto task_of = [&](int64_t pose) {
    BackwardTask<S> task;
    task.geometry = geometry_of<S>(field);
    const int64_t* const begin = std::lower_bound(query, query + roots, pose * queries.count);
    const int64_t* const end = std::lower_bound(begin, query + roots, (pose + 1) * queries.count);
    const int64_t first = begin - query;
    task.gradient = gradient + 3 * first;
    task.canonical = canonical + 3 * first;
    task.inverse = inverse + 9 * first;
    task.query = begin;
    task.roots = end - begin;
    task.first_query = pose * queries.count;
    task.v_points = nullptr;
    task.v_transforms = nullptr;
    return task;
  };
  const bool well = run_phases(threads, {[&](int) {
                                 for (int64_t n, end; transforms_queue.take(n, end);) {
                                   BackwardTask<S> task = task_of(n / slabs);
                                   task.v_transforms = v_transforms + 12 * nodes * (n / slabs);
                                   task.layers[0] = layers * (n % slabs) / slabs;
                                   task.layers[1] = layers * (n % slabs + 1) / slabs;
                                   kernels<S>().backward(task);
                                 }
                                 for (int64_t pose, end; points_queue.take(pose, end);) {
                                   BackwardTask<S> task = task_of(pose);
                                   task.v_points = v_points + 3 * queries.count * pose;
                                   kernels<S>().backward(task);
                                 }
                               }});
  if (!well) throw std::bad_alloc();
}

bool valid(const snarf_blending* blending) {
  if (!blending || (blending->bytes_per_number != 4 && blending->bytes_per_number != 8)) return false;
  for (int nodes : blending->nodes)
    if (nodes < 1) return false;
  return blending->poses >= 0 && blending->count >= 1 && blending->threads >= 1;
}

bool valid(const snarf_field* field, const snarf_queries* queries) {
  if (!field || !queries || (field->bytes_per_number != 4 && field->bytes_per_number != 8)) return false;
  int64_t cells = 1;
  for (int i = 0; i < 3; ++i) {
    if (field->nodes[i] < 2 || !(field->size[i] > 0)) return false;
    cells *= field->nodes[i];
  }
  return cells < std::numeric_limits<int32_t>::max() && queries->poses >= 0 && queries->count >= 0 && queries->threads >= 1;
}

// Calls run(number) with a float or a double; no exception leaves the library.
template <class Run>
int in_number_type(int bytes, const Run& run) {
  try {
    if (bytes == 4)
      run(float());
    else
      run(double());
  } catch (...) { return SNARF_OUT_OF_MEMORY; }
  return SNARF_OK;
}

// Runs a search and returns a handle of its roots.
template <class Run>
int search_with(const snarf_field* field, const snarf_queries* queries, snarf_roots** roots, int64_t* found, const Run& run) {
  if (!valid(field, queries) || !roots || !found) return SNARF_BAD_ARGUMENT;
  return in_number_type(field->bytes_per_number, [&](auto number) {
    std::unique_ptr<RootsOf<decltype(number)>> out(new RootsOf<decltype(number)>());
    out->threads = queries->threads;
    run(*out);
    *found = out->count();
    *roots = out.release();
  });
}

}  // namespace

int snarf_abi_version(void) { return SNARF_ABI_VERSION; }

const char* snarf_instruction_set(void) {
  return instruction_set() == kAvx512 ? "avx512" : instruction_set() == kAvx2 ? "avx2" : "baseline";
}

int snarf_blend(const snarf_blending* blending, void* transforms) {
  if (!valid(blending)) return SNARF_BAD_ARGUMENT;
  return in_number_type(blending->bytes_per_number, [&](auto number) {
    using S = decltype(number);
    Blending<S>(*blending).forward(static_cast<S*>(transforms));
  });
}

int snarf_blend_backward(const snarf_blending* blending, const void* gradient, void* v_weights, void* v_bones) {
  if (!valid(blending)) return SNARF_BAD_ARGUMENT;
  return in_number_type(blending->bytes_per_number, [&](auto number) {
    using S = decltype(number);
    Blending<S> task(*blending);
    if (v_weights) task.weights(static_cast<const S*>(gradient), static_cast<S*>(v_weights));
    if (v_bones) task.bones(static_cast<const S*>(gradient), static_cast<S*>(v_bones));
  });
}

int snarf_complete_search(const snarf_field* field, const snarf_queries* queries, const snarf_complete* settings,
                          snarf_roots** roots, int64_t* found) {
  if (!settings) return SNARF_BAD_ARGUMENT;
  return search_with(field, queries, roots, found, [&](auto& out) { complete_search(*field, *queries, *settings, out); });
}

int snarf_prepare(const snarf_field* field, int64_t poses, const uint8_t* active, int32_t threads, snarf_prepared** prepared,
                  int64_t* bytes) {
  const snarf_queries queries{nullptr, poses, 0, threads};
  if (!valid(field, &queries) || !prepared || !bytes) return SNARF_BAD_ARGUMENT;
  return in_number_type(field->bytes_per_number, [&](auto number) {
    std::unique_ptr<snarf_prepared> out(new Prepared<decltype(number)>(*field, poses, active, threads));
    *bytes = out->bytes();
    *prepared = out.release();
  });
}

int snarf_take_prepared(snarf_prepared* prepared, void* buffer, void* boxes) {
  const std::unique_ptr<snarf_prepared> owner(prepared);
  if (!prepared || !buffer) return SNARF_OK;
  try {
    owner->write(static_cast<char*>(buffer), boxes);
    return SNARF_OK;
  } catch (...) { return SNARF_OUT_OF_MEMORY; }
}

int snarf_prepared_search(const void* buffer, int64_t bytes, const snarf_field* field, const snarf_queries* queries,
                          const snarf_complete* settings, snarf_roots** roots, int64_t* found) {
  if (!valid(field, queries) || !settings || !fits(buffer, bytes, *field, queries->poses)) return SNARF_BAD_ARGUMENT;
  return search_with(field, queries, roots, found,
                     [&](auto& out) { prepared_search(static_cast<const char*>(buffer), *field, *queries, *settings, out); });
}

int snarf_broyden_search(const snarf_field* field, const snarf_queries* queries, const snarf_broyden* settings,
                         snarf_roots** roots, int64_t* found) {
  if (!settings || settings->count < 0) return SNARF_BAD_ARGUMENT;
  return search_with(field, queries, roots, found, [&](auto& out) { broyden_search(*field, *queries, *settings, out); });
}

int snarf_take_roots(snarf_roots* roots, void* canonical, int64_t* query, void* jacobian_inverse) {
  const std::unique_ptr<snarf_roots> owner(roots);
  if (!roots || !canonical || !query || !jacobian_inverse) return SNARF_OK;
  try {
    return owner->take(canonical, query, jacobian_inverse) ? SNARF_OK : SNARF_OUT_OF_MEMORY;
  } catch (...) { return SNARF_OUT_OF_MEMORY; }
}

int snarf_implicit_backward(const snarf_field* field, const snarf_queries* queries, int64_t roots, const void* gradient,
                            const void* canonical, const int64_t* query, const void* jacobian_inverse, void* v_points,
                            void* v_transforms) {
  if (!valid(field, queries) || roots < 0) return SNARF_BAD_ARGUMENT;
  return in_number_type(field->bytes_per_number, [&](auto number) {
    using S = decltype(number);
    implicit_backward(*field, *queries, roots, static_cast<const S*>(gradient), static_cast<const S*>(canonical), query,
                      static_cast<const S*>(jacobian_inverse), static_cast<S*>(v_points), static_cast<S*>(v_transforms));
  });
}

int snarf_evaluate(const snarf_network* network, const float* points, const float* extras, int64_t count, int32_t threads,
                   float* logits) {
  if (!valid(network, points, extras, count, threads, logits)) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { Network(*network).run(points, extras, count, threads, logits); });
}

int64_t snarf_saved_size(const snarf_perceptron* network, int64_t count) {
  return valid(network) && count >= 0 ? Training::saved_size(*network, count) : -1;
}

int snarf_forward(const snarf_perceptron* network, const float* first, const float* extras, int64_t count, float* saved,
                  float* out) {
  if (!valid(network) || count < 0 || (count && (!first || !out || (network->extra_count && !extras))))
    return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { Training(*network).forward(first, extras, count, saved, out); });
}

int snarf_backward(const snarf_perceptron* network, const float* first, const float* extras, int64_t count, const float* saved,
                   const float* v_out, float* const* v_weights, float* const* v_bias, float* v_first, float* v_extras) {
  if (!valid(network) || count < 0 || !v_weights || !v_bias) return SNARF_BAD_ARGUMENT;
  if (count && (!first || !v_out || (network->extra_count && !extras))) return SNARF_BAD_ARGUMENT;
  return in_number_type(
      4, [&](auto) { Training(*network).backward(first, extras, count, saved, v_out, v_weights, v_bias, v_first, v_extras); });
}

int snarf_encode(const snarf_encoding* encoding, float* out) {
  if (!valid(encoding) || (encoding->count && !out)) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { Encoding(*encoding).forward(out); });
}

int snarf_encode_backward(const snarf_encoding* encoding, const float* out, const float* v_out, float* v_points,
                          float* v_table) {
  if (!valid(encoding) || (encoding->count && (!out || !v_out))) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { Encoding(*encoding).backward(out, v_out, v_points, v_table); });
}

int snarf_segment_distances(const float* points, int64_t count, const float* segments, int32_t segment_count, int32_t threads,
                            float* distance, float* direction) {
  if (count < 0 || segment_count < 1 || !segments || threads < 1) return SNARF_BAD_ARGUMENT;
  if (count && (!points || !distance || !direction)) return SNARF_BAD_ARGUMENT;
  const DistanceTask task = {points, segments, segment_count, distance, direction};
  return in_number_type(4, [&](auto) { distances(task, count, threads); });
}

int snarf_adam_step(const snarf_parameters* arrays, int32_t count, const snarf_adam* settings, double* magnitude) {
  if (!valid(arrays, count, settings) || !magnitude) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { *magnitude = adam_step(arrays, count, *settings); });
}

int snarf_total_variation(const snarf_variation* given, double* total, float* gradient) {
  if (!valid(given) || !total || !gradient) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { *total = total_variation(*given, gradient); });
}

int snarf_pose_codes(const snarf_codes* given, const float* codes, float* out) {
  if (!valid(given) || (given->count && (!codes || !out))) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { PoseCodes(*given).forward(codes, out); });
}

int snarf_pose_codes_backward(const snarf_codes* given, const float* v_out, float* v_codes) {
  if (!valid(given) || !v_codes || (given->count && !v_out)) return SNARF_BAD_ARGUMENT;
  return in_number_type(4, [&](auto) { PoseCodes(*given).backward(v_out, v_codes); });
}
