// Bone transforms blended once per grid node (Fast-SNARF Eq. 13), and the gradient.
#pragma once

#include <algorithm>
#include <cstdint>
#include <new>
#include <vector>

#include "dispatch.h"
#include "roots.h"
#include "snarf/api.h"
#include "team.h"

namespace snarf {

// Whether each node is a corner of an active cell; empty if all are.
inline std::vector<uint8_t> used_nodes(const snarf_blending& blending) {
  std::vector<uint8_t> used;
  if (!blending.active) return used;
  const int64_t width = blending.nodes[0], height = blending.nodes[1], depth = blending.nodes[2];
  used.assign(size_t(width * height * depth), 0);
  const uint8_t* active = blending.active;
  for (int64_t z = 0; z + 1 < depth; ++z)
    for (int64_t y = 0; y + 1 < height; ++y)
      for (int64_t x = 0; x + 1 < width; ++x) {
        if (!*active++) continue;
        for (int64_t row : {(z * height + y) * width, (z * height + y + 1) * width, ((z + 1) * height + y) * width,
                            ((z + 1) * height + y + 1) * width})
          used[row + x] = used[row + x + 1] = 1;
      }
  return used;
}

constexpr int64_t kNodeChunks = 64;  // fixed, so that sums over the nodes do not depend on the number of threads

template <class S>
class Blending {
 public:
  explicit Blending(const snarf_blending& blending) : used_(used_nodes(blending)) {
    task_.weights = static_cast<const S*>(blending.weights);
    task_.used = used_.empty() ? nullptr : used_.data();
    task_.poses = blending.poses;
    task_.bones = blending.count;
    task_.nodes = int64_t(blending.nodes[0]) * blending.nodes[1] * blending.nodes[2];
    task_.columns = (blending.count + kRow - 1) / kRow * kRow;
    bones_ = static_cast<const S*>(blending.bones);
    threads_ = int(std::max<int64_t>(1, std::min<int64_t>(blending.threads, task_.nodes * task_.poses / kWorkPerThread)));
  }

  void forward(S* transforms) {
    std::vector<S> rows(size_t(task_.poses * task_.bones * kRow), S(0));
    for (int64_t n = 0; n < task_.poses * task_.bones; ++n)
      std::copy(bones_ + 12 * n, bones_ + 12 * n + 12, &rows[size_t(n * kRow)]);
    task_.rows = rows.data();
    each_chunk([&](const BlendTask<S>& task, int64_t) { kernels<S>().blend(task, transforms); });
  }

  void weights(const S* gradient, S* v_weights) {
    std::vector<S> columns(size_t(task_.poses * 12 * task_.columns), S(0));
    for (int64_t pose = 0; pose < task_.poses; ++pose)
      for (int64_t j = 0; j < task_.bones; ++j)
        for (int64_t r = 0; r < 12; ++r)
          columns[size_t((pose * 12 + r) * task_.columns + j)] = bones_[(pose * task_.bones + j) * 12 + r];
    task_.rows = columns.data();
    each_chunk([&](const BlendTask<S>& task, int64_t) {
      std::vector<S> row(size_t(task.columns));
      kernels<S>().blend_weights(task, gradient, row.data(), v_weights);
    });
  }

  void bones(const S* gradient, S* v_bones) {
    const int64_t rows = task_.poses * task_.bones;
    if (!rows) return;
    std::vector<S> sums(size_t(kNodeChunks * rows * kRow), S(0));
    each_chunk([&](const BlendTask<S>& task, int64_t chunk) {
      kernels<S>().blend_bones(task, gradient, &sums[size_t(chunk * rows * kRow)]);
    });
    for (int64_t n = 0; n < rows; ++n)
      for (int64_t r = 0; r < 12; ++r) {
        S total = 0;
        for (int64_t chunk = 0; chunk < kNodeChunks; ++chunk) total += sums[size_t((chunk * rows + n) * kRow + r)];
        v_bones[12 * n + r] = total;
      }
  }

 private:
  template <class F>
  void each_chunk(const F& work) {
    Queue queue(kNodeChunks, 1);
    const bool well = run_phases(threads_, {[&](int) {
                                   for (int64_t chunk, end; queue.take(chunk, end);) {
                                     BlendTask<S> task = task_;
                                     task.first = task.nodes * chunk / kNodeChunks;
                                     task.last = task.nodes * (chunk + 1) / kNodeChunks;
                                     if (task.first < task.last) work(task, chunk);
                                   }
                                 }});
    if (!well) throw std::bad_alloc();
  }

  const std::vector<uint8_t> used_;
  BlendTask<S> task_;
  const S* bones_;
  int threads_;
};

}  // namespace snarf
