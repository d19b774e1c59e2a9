// The complete search, phase by phase on all threads.
//
// DESIGN. A group of poses goes through these phases. Most are shared by all threads; all threads finish a phase before the
// next.
//   measure       the posed boxes of all active cells, and the region that contains the queries
//   lay_out_bins  (one thread) the uniform grid of bins in posed space, for each pose
//   mark          the bins that a box touches; queries in other bins have no root and are dropped
//   count         the number of queries in each marked bin, chunk by chunk
//   scan          the first position of each bin among the sorted queries
//   place         the queries, sorted into the bins (a counting sort)
//   search        the roots in each block of cells; each thread takes a few blocks at a time and has its own list of roots
// The phases of `Collect` follow: they sort the roots by query, and within a query by cell, and drop duplicates on the common
// face of two cells. The result does not depend on which thread found a root, and the roots of a query do not depend on the
// other queries of the batch.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <new>
#include <vector>

#include "bins.h"
#include "dispatch.h"
#include "roots.h"
#include "snarf/api.h"
#include "snarf/search.h"
#include "team.h"

namespace snarf {

constexpr int64_t kGroupQueries = int64_t(1) << 20;  // maximum number of queries in a group; limits the memory of the sort
constexpr int64_t kGroupBlocks = int64_t(1) << 17;   // maximum of poses x blocks in a group: 50 MB of boxes in float32
constexpr int64_t kMaxChunks = 8;                    // maximum number of chunks of a pose's queries; each has its own histogram
constexpr double kBinPerBox = 0.6;                   // side of a bin, as a share of the mean side of the posed boxes

// Owns the memory of a `Scratch`, and enlarges it on demand.
template <class S>
class ScratchLists {
 public:
  ScratchLists() : scratch_{{nullptr, nullptr, nullptr}, nullptr, 0, this, reserve} {}
  Scratch<S>& scratch() { return scratch_; }

 private:
  static void reserve(Scratch<S>* scratch, int64_t count) {
    if (count <= scratch->capacity) return;
    ScratchLists& lists = *static_cast<ScratchLists*>(scratch->owner);
    const size_t size = size_t(std::max<int64_t>(2 * count, 4096)) + kBlock;
    for (int i = 0; i < 3; ++i) {
      lists.at_[i].resize(size);
      scratch->at[i] = lists.at_[i].data();
    }
    lists.query_.resize(size);
    scratch->query = lists.query_.data();
    scratch->capacity = int64_t(size) - kBlock;
  }

  std::vector<S> at_[3];
  std::vector<int32_t> query_;
  Scratch<S> scratch_;
};

template <class S>
Geometry<S> geometry_of(const snarf_field& field) {
  Geometry<S> geometry;
  for (int i = 0; i < 3; ++i) {
    geometry.lower[i] = S(field.lower[i]);
    geometry.size[i] = S(field.size[i]);
    geometry.nodes[i] = field.nodes[i];
  }
  return geometry;
}

inline int64_t node_count(const snarf_field& field) { return int64_t(field.nodes[0]) * field.nodes[1] * field.nodes[2]; }

// The blocks with at least one cell to search. `active`: [(D-1)(H-1)(W-1)], or null for all cells.
inline std::vector<Block> active_blocks(const snarf_field& field, const uint8_t* active) {
  const int cells[3] = {field.nodes[0] - 1, field.nodes[1] - 1, field.nodes[2] - 1};
  std::vector<Block> blocks;
  for (int z = 0; z < cells[2]; ++z)
    for (int y = 0; y < cells[1]; ++y)
      for (int x = 0; x < cells[0]; x += kBlock) {
        uint32_t mask = 0;
        for (int k = 0; k < kBlock && x + k < cells[0]; ++k)
          if (!active || active[(int64_t(z) * cells[1] + y) * cells[0] + x + k]) mask |= 1u << k;
        if (mask) blocks.push_back({x, y, z, mask});
      }
  return blocks;
}

template <class S>
S smallest_side(const Geometry<S>& geometry) {
  return std::min(geometry.size[0], std::min(geometry.size[1], geometry.size[2]));
}

// The smallest box, in posed space, around several posed boxes or several points, metres.
template <class S>
struct Extent {
  S lower[3], upper[3];
  double sides = 0;   // sum, over the boxes, of the mean of a box's three sides
  int64_t boxes = 0;  // number of boxes; 0 for points
  Extent() {
    std::fill(lower, lower + 3, std::numeric_limits<S>::infinity());
    std::fill(upper, upper + 3, -std::numeric_limits<S>::infinity());
  }
  void include(const Extent& other) {
    for (int i = 0; i < 3; ++i) {
      lower[i] = std::min(lower[i], other.lower[i]);
      upper[i] = std::max(upper[i], other.upper[i]);
    }
    sides += other.sides;
    boxes += other.boxes;
  }
};

// The complete search of a group: `poses` poses from `first_pose` on, and `count` queries of each from `first_query` on.
//
// Each of a pose's `chunks_` chunks of queries is a part: part = pose * chunks_ + chunk.
template <class S>
class CompleteSearch {
 public:
  CompleteSearch(const snarf_field& field, const snarf_queries& queries, const snarf_complete& settings,
                 const std::vector<Block>& blocks, int64_t first_pose, int64_t poses, int64_t first_query, int64_t count,
                 int threads)
      : kernels_(kernels<S>()),
        blocks_(blocks),
        poses_(poses),
        count_(count),
        threads_(threads),
        chunks_(int(std::min<int64_t>((threads + poses - 1) / poses, kMaxChunks))),
        geometry_(geometry_of<S>(field)),
        nodes_(node_count(field)),
        points_(static_cast<const S*>(queries.points) + 3 * (first_pose * queries.count + first_query)),
        stride_(3 * queries.count),
        transforms_(static_cast<const S*>(field.transforms) + 12 * nodes_ * first_pose),
        settings_(settings),
        box_queue_(poses * int64_t(blocks.size()), 16),
        extent_queue_(poses * chunks_, 1),
        mark_queue_(poses * int64_t(blocks.size()), 16),
        count_queue_(poses * chunks_, 1),
        scan_queue_(poses, 1),
        place_queue_(poses * chunks_, 1),
        search_queue_(poses * int64_t(blocks.size()), 4) {}

  // Appends the phases of the search to `phases`. They write the roots to `group`. Both objects must outlive them.
  void add_to(std::vector<std::function<void(int)>>& phases, Group<S>& group) {
    phases.push_back([this, &group](int thread) {
      if (thread) return;
      boxes_.reset(new BlockBoxes<S>[poses_ * blocks_.size()]);
      box_extents_.assign(size_t(threads_ * poses_), Extent<S>());
      query_extents_.assign(size_t(chunks_ * poses_), Extent<S>());
      sorted_.assign(size_t(poses_), SortedQueries<S>());
      bin_offset_.assign(size_t(poses_ + 1), 0);
      group.lists.resize(threads_);
    });
    phases.push_back([this](int thread) { measure(thread); });
    phases.push_back([this](int thread) {
      if (!thread) lay_out_bins();
    });
    phases.push_back([this](int) { mark(); });
    phases.push_back([this](int) { count(); });
    phases.push_back([this](int) { scan(); });
    phases.push_back([this](int) { place(); });
    phases.push_back([this, &group](int thread) {
      group.lists[thread].reset(new RootList<S>());
      search(group.lists[thread]->sink());
    });
    phases.push_back([this](int thread) {
      if (!thread) release();
    });
  }

 private:
  void measure(int thread) {
    for (int64_t first, last; box_queue_.take(first, last);)
      for (int64_t n = first; n < last; ++n) {
        const int64_t pose = n / int64_t(blocks_.size());
        kernels_.boxes(transforms_ + 12 * nodes_ * pose, geometry_, blocks_[n % blocks_.size()], boxes_[n]);
        Extent<S>& extent = box_extents_[thread * poses_ + pose];
        for (int k = 0; k < kBlock; ++k) {
          if (!(boxes_[n].lower[0][k] <= boxes_[n].upper[0][k])) continue;
          ++extent.boxes;
          for (int i = 0; i < 3; ++i) {
            extent.lower[i] = std::min(extent.lower[i], boxes_[n].lower[i][k]);
            extent.upper[i] = std::max(extent.upper[i], boxes_[n].upper[i][k]);
            extent.sides += double(boxes_[n].upper[i][k] - boxes_[n].lower[i][k]) / 3;
          }
        }
      }
    for (int64_t part, end; extent_queue_.take(part, end);) {
      Extent<S> extent;
      const int64_t first = chunk_begin(part);
      kernels_.extent(points_ + stride_ * (part / chunks_) + 3 * first, chunk_begin(part, 1) - first, extent.lower,
                      extent.upper);
      query_extents_[part] = extent;
    }
  }

  // The first query of a part, or with next = 1 the end of the part, counted within its pose.
  int64_t chunk_begin(int64_t part, int next = 0) const { return count_ * (part % chunks_ + next) / chunks_; }

  void lay_out_bins() {
    for (int64_t pose = 0; pose < poses_; ++pose) {
      Extent<S> cells, points;
      for (int t = 0; t < threads_; ++t) cells.include(box_extents_[t * poses_ + pose]);
      for (int c = 0; c < chunks_; ++c) points.include(query_extents_[pose * chunks_ + c]);
      SortedQueries<S>& sorted = sorted_[pose];
      double volume = 1;
      bool empty = cells.boxes == 0;
      for (int i = 0; i < 3; ++i) {
        sorted.lower[i] = std::max(cells.lower[i], points.lower[i]);
        sorted.upper[i] = std::min(cells.upper[i], points.upper[i]);
        empty |= !(sorted.lower[i] <= sorted.upper[i]);
      }
      double side = 1;
      if (!empty) {
        side = kBinPerBox * cells.sides / double(cells.boxes);
        double longest = 0;
        for (int i = 0; i < 3; ++i) longest = std::max(longest, double(sorted.upper[i] - sorted.lower[i]));
        // At most 4096 more bins than queries, since a bin costs as much time as a query.
        side = std::max(side, longest * 1e-3);  // at most about 1000 bins along an axis
        for (;; side *= 1.25) {
          volume = 1;
          for (int i = 0; i < 3; ++i)
            volume *= std::floor(double(sorted.upper[i] - sorted.lower[i]) / std::max(side, 1e-30)) + 1;
          if (volume <= double(count_ + 4096)) break;
        }
      }
      sorted.per_metre = S(1 / std::max(side, 1e-30));
      int64_t bins = empty ? 0 : 1;
      for (int i = 0; i < 3; ++i) {
        sorted.bins[i] = empty ? 0 : int32_t((sorted.upper[i] - sorted.lower[i]) * sorted.per_metre) + 1;
        bins *= sorted.bins[i];
      }
      bin_offset_[pose + 1] = bin_offset_[pose] + bins;
    }
    const int64_t bins = bin_offset_[poses_];
    marked_.reset(new std::atomic<uint8_t>[bins]());
    histogram_.reset(new int32_t[bins * chunks_]());
    begin_.reset(new int32_t[bins + poses_]);
    key_.reset(new int32_t[poses_ * count_]);
    query_.reset(new int32_t[poses_ * count_]);
    for (auto& at : at_) at.reset(new S[poses_ * (count_ + kBlock)]);
  }

  void mark() {
    for (int64_t first, last; mark_queue_.take(first, last);)
      for (int64_t n = first; n < last; ++n) {
        const int64_t pose = n / int64_t(blocks_.size());
        if (bin_offset_[pose + 1] == bin_offset_[pose]) continue;
        std::atomic<uint8_t>* const marked = marked_.get() + bin_offset_[pose];
        for (int k = 0; k < kBlock; ++k)
          SNARF_ISA::each_bin_row(sorted_[pose], boxes_[n], k, [&](int64_t begin, int64_t end) {
            for (int64_t bin = begin; bin < end; ++bin) marked[bin].store(1, std::memory_order_relaxed);
          });
      }
  }

  void count() {
    for (int64_t part, end; count_queue_.take(part, end);) {
      const int64_t pose = part / chunks_;
      const SortedQueries<S>& sorted = sorted_[pose];
      const int64_t bins = bin_offset_[pose + 1] - bin_offset_[pose];
      int32_t* const histogram = histogram_.get() + bin_offset_[pose] * chunks_ + bins * (part % chunks_);
      const std::atomic<uint8_t>* const marked = marked_.get() + bin_offset_[pose];
      int32_t* const key = key_.get() + pose * count_;
      const int64_t first = chunk_begin(part), last = chunk_begin(part, 1);
      if (!bins) {
        std::fill(key + first, key + last, -1);
        continue;
      }
      kernels_.bins(sorted, points_ + stride_ * pose + 3 * first, last - first, key + first);
      for (int64_t n = first; n < last; ++n) {
        const int32_t at = key[n];
        if (at < 0) continue;
        if (marked[at].load(std::memory_order_relaxed))
          ++histogram[at];
        else
          key[n] = -1;
      }
    }
  }

  void scan() {
    for (int64_t pose, end; scan_queue_.take(pose, end);) {
      const int64_t bins = bin_offset_[pose + 1] - bin_offset_[pose];
      int32_t* const histogram = histogram_.get() + bin_offset_[pose] * chunks_;
      int32_t* const begin = begin_.get() + bin_offset_[pose] + pose;
      int32_t total = 0;
      for (int64_t b = 0; b < bins; ++b) {
        begin[b] = total;
        for (int c = 0; c < chunks_; ++c) {
          const int32_t here = histogram[c * bins + b];
          histogram[c * bins + b] = total;
          total += here;
        }
      }
      begin[bins] = total;
      SortedQueries<S>& sorted = sorted_[pose];
      sorted.begin = begin;
      sorted.query = query_.get() + pose * count_;
      for (int i = 0; i < 3; ++i) {
        S* const at = at_[i].get() + pose * (count_ + kBlock);
        std::fill(at + total, at + total + kBlock, S(0));  // the kernels read beyond the end, but do not use these values
        sorted.at[i] = at;
      }
    }
  }

  void place() {
    for (int64_t part, end; place_queue_.take(part, end);) {
      const int64_t pose = part / chunks_;
      const int64_t bins = bin_offset_[pose + 1] - bin_offset_[pose];
      int32_t* const next = histogram_.get() + bin_offset_[pose] * chunks_ + bins * (part % chunks_);
      const S* const points = points_ + stride_ * pose;
      const int32_t* const key = key_.get() + pose * count_;
      int32_t* const query = query_.get() + pose * count_;
      S* const x = at_[0].get() + pose * (count_ + kBlock);
      S* const y = at_[1].get() + pose * (count_ + kBlock);
      S* const z = at_[2].get() + pose * (count_ + kBlock);
      for (int64_t n = chunk_begin(part); n < chunk_begin(part, 1); ++n) {
        if (key[n] < 0) continue;
        const int32_t at = next[key[n]]++;
        x[at] = points[3 * n];
        y[at] = points[3 * n + 1];
        z[at] = points[3 * n + 2];
        query[at] = int32_t(pose * count_ + n);
      }
    }
  }

  void search(RootSink<S>& sink) {
    ScratchLists<S> scratch;
    CompleteTask<S> task;
    task.geometry = geometry_;
    task.tolerance = S(settings_.tolerance);
    task.max_steps = settings_.max_steps;
    task.orientation_preserving = settings_.orientation_preserving != 0;
    for (int64_t first, last; search_queue_.take(first, last);)
      for (int64_t n = first; n < last; ++n) {
        const int64_t pose = n / int64_t(blocks_.size());
        if (bin_offset_[pose + 1] == bin_offset_[pose]) continue;
        task.transforms = transforms_ + 12 * nodes_ * pose;
        task.queries = sorted_[pose];
        kernels_.search(task, blocks_[n % blocks_.size()], boxes_[n], scratch.scratch(), sink);
      }
  }

  // Frees what the roots do not need, before they are collected.
  void release() {
    boxes_.reset();
    marked_.reset();
    histogram_.reset();
    begin_.reset();
    key_.reset();
    query_.reset();
    for (auto& at : at_) at.reset();
  }

  const Kernels<S>& kernels_;
  const std::vector<Block>& blocks_;
  const int64_t poses_, count_;
  const int threads_, chunks_;
  const Geometry<S> geometry_;
  const int64_t nodes_;        // V
  const S* const points_;      // the first query of the first pose
  const int64_t stride_;       // numbers from the points of one pose to those of the next
  const S* const transforms_;  // [poses, V, 12]
  const snarf_complete& settings_;
  Queue box_queue_, extent_queue_, mark_queue_, count_queue_, scan_queue_, place_queue_, search_queue_;
  std::unique_ptr<BlockBoxes<S>[]> boxes_;          // [poses, blocks]
  std::vector<Extent<S>> box_extents_;              // [threads, poses]
  std::vector<Extent<S>> query_extents_;            // [poses, chunks]
  std::vector<SortedQueries<S>> sorted_;            // [poses]
  std::vector<int64_t> bin_offset_;                 // [poses + 1], number of bins of all poses before
  std::unique_ptr<std::atomic<uint8_t>[]> marked_;  // [bins of all poses], whether a box touches the bin
  std::unique_ptr<int32_t[]> histogram_;            // by pose, [chunks, bins]; `scan` turns numbers into positions
  std::unique_ptr<int32_t[]> begin_;                // by pose, [bins + 1], position of the first query of each bin
  std::unique_ptr<int32_t[]> key_;                  // [poses, count], bin of each query; -1 for those that are dropped
  std::unique_ptr<int32_t[]> query_;                // [poses, count], index in the group of each sorted query
  std::unique_ptr<S[]> at_[3];                      // [poses, count + kBlock], coordinates of each sorted query, metres
};

// Number of threads for `count` items of work (queries, roots or nodes).
inline int threads_for(const snarf_queries& queries, int64_t count) {
  return int(std::max<int64_t>(1, std::min<int64_t>(queries.threads, count / kWorkPerThread)));
}

// Finds the roots of all queries, group by group, and appends them to `out`.
template <class S>
void complete_search(const snarf_field& field, const snarf_queries& queries, const snarf_complete& settings, RootsOf<S>& out) {
  const std::vector<Block> blocks = active_blocks(field, settings.active);
  if (blocks.empty() || !queries.poses || !queries.count) return;
  const S distance = S(kSameRoot) * smallest_side(geometry_of<S>(field));
  const int64_t at_once = std::min(queries.count, kGroupQueries);
  const int64_t poses_at_once = std::max<int64_t>(1, std::min(kGroupQueries / at_once, kGroupBlocks / int64_t(blocks.size())));
  for (int64_t pose = 0; pose < queries.poses; pose += poses_at_once)
    for (int64_t query = 0; query < queries.count; query += at_once) {
      const int64_t poses = std::min(poses_at_once, queries.poses - pose), count = std::min(at_once, queries.count - query);
      const int threads = threads_for(queries, poses * count);
      std::unique_ptr<Group<S>> group(new Group<S>());
      group->first_query = pose * queries.count + query;
      CompleteSearch<S> search(field, queries, settings, blocks, pose, poses, query, count, threads);
      Collect<S> collect(*group, poses * count, threads, distance);
      std::vector<std::function<void(int)>> phases;
      search.add_to(phases, *group);
      collect.add_to(phases);
      if (!run_phases(threads, phases)) throw std::bad_alloc();
      out.groups.push_back(std::move(group));
    }
}

}  // namespace snarf
