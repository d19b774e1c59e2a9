// The CPU library: run-time choice of the instruction set, memory, threads, and the order of work of a search.
//
// DESIGN. A complete search of a group of poses runs through these phases, each on all threads:
//   boxes    posed boxes of all active cells, and the region that holds the queries
//   mark     bins of a uniform posed-space grid that a box touches; queries in other bins have no root and go no further
//   count    queries in each marked bin, chunk by chunk
//   place    counting sort of the queries into the bins
//   search   blocks of cells, handed out one by one; every thread keeps its own list of roots
//   collect  roots sorted by query, and within a query by cell; duplicates on the common face of two cells dropped
// Which thread found a root leaves no trace in the result, and a query's roots do not depend on the other queries of the batch.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>

#include "kernels.h"
#include "snarf/api.h"
#include "snarf/search.h"
#include "team.h"

namespace snarf {
namespace {

constexpr int64_t kGroupQueries = int64_t(1) << 20;  // queries searched together: bounds the memory of the sort
constexpr int64_t kGroupBlocks = int64_t(1) << 17;   // blocks of cells of all poses searched together: 50 MB of boxes
constexpr double kBinPerBox = 0.6;                  // side of a bin, in mean sides of the posed boxes
constexpr int64_t kQueriesPerThread = 2048;          // less is not worth starting a thread for

enum InstructionSet { kBaseline, kAvx2, kAvx512 };

InstructionSet best_instruction_set() {
  InstructionSet best = kBaseline;
#if defined(SNARF_X86_KERNELS)
#if defined(__GNUC__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2"))
    best = kAvx2;
  if (best == kAvx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl"))
    best = kAvx512;
#endif
#endif
  const char* wish = std::getenv("SNARF_INSTRUCTION_SET");
  if (wish && !std::strcmp(wish, "baseline")) best = kBaseline;
  if (wish && !std::strcmp(wish, "avx2")) best = std::min(best, kAvx2);
  return best;
}

InstructionSet instruction_set() {
  static const InstructionSet chosen = best_instruction_set();
  return chosen;
}

template <class S> const Kernels<S>& kernels() {
#if defined(SNARF_X86_KERNELS)
  static const Kernels<S> chosen = instruction_set() == kAvx512  ? avx512::kernels<S>()
                                   : instruction_set() == kAvx2 ? avx2::kernels<S>()
                                                                : baseline::kernels<S>();
#else
  static const Kernels<S> chosen = baseline::kernels<S>();
#endif
  return chosen;
}

// The roots that one thread found, in blocks that never move.
template <class S> class RootList {
 public:
  RootList() : sink_{nullptr, nullptr, this, more} {}
  RootList(const RootList&) = delete;
  RootSink<S>& sink() { return sink_; }

  template <class F> void each(const F& visit) {
    for (size_t n = 0; n < blocks_.size(); ++n) {
      Root<S>* const begin = blocks_[n].get();
      Root<S>* const end = n + 1 < blocks_.size() ? begin + sizes_[n] : sink_.next;
      for (Root<S>* root = begin; root != end; ++root) visit(*root);
    }
  }

 private:
  static void more(RootSink<S>* sink) {
    RootList& list = *static_cast<RootList*>(sink->owner);
    const size_t size = list.sizes_.empty() ? 512 : std::min<size_t>(2 * list.sizes_.back(), 32768);
    list.blocks_.emplace_back(new Root<S>[size]);
    list.sizes_.push_back(size);
    sink->next = list.blocks_.back().get();
    sink->end = sink->next + size;
  }

  std::vector<std::unique_ptr<Root<S>[]>> blocks_;
  std::vector<size_t> sizes_;
  RootSink<S> sink_;
};

template <class S> class ScratchLists {
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

}  // namespace
}  // namespace snarf

using namespace snarf;

struct snarf_roots {
  virtual ~snarf_roots() = default;
  virtual int64_t count() const = 0;
  virtual bool take(void* canonical, int64_t* query, void* inverse) = 0;
};

namespace snarf {
namespace {

constexpr int kAhead = 12;  // roots in the order of the queries lie anywhere in memory; fetching early hides most of the wait

inline void prefetch(const void* at) {
#if defined(__GNUC__)
  __builtin_prefetch(at);
#else
  (void)at;
#endif
}

// The roots of a group of consecutive queries, sorted.
template <class S> struct Group {
  int64_t first_query = 0;  // flat
  std::vector<std::unique_ptr<RootList<S>>> lists;
  std::unique_ptr<const Root<S>*[]> sorted;
  int64_t count = 0;
};

template <class S> struct RootsOf final : snarf_roots {
  std::vector<std::unique_ptr<Group<S>>> groups;
  int threads = 1;

  int64_t count() const override {
    int64_t total = 0;
    for (const auto& group : groups) total += group->count;
    return total;
  }

  bool take(void* canonical, int64_t* query, void* inverse) override {
    int64_t done = 0;
    for (auto& group : groups) {
      S* const x = static_cast<S*>(canonical) + 3 * done;
      S* const inv = static_cast<S*>(inverse) + 9 * done;
      int64_t* const q = query + done;
      const Group<S>& from = *group;
      Queue queue(from.count, 4096);
      const bool well = run_phases(from.count > 4 * kQueriesPerThread ? threads : 1, {[&](int) {
        for (int64_t first, last; queue.take(first, last);)
          for (int64_t m = first; m < last; ++m) {
            prefetch(from.sorted[std::min(m + kAhead, last - 1)]);
            const Root<S>& root = *from.sorted[m];
            q[m] = from.first_query + root.query;
            std::memcpy(x + 3 * m, root.canonical, sizeof root.canonical);
            std::memcpy(inv + 9 * m, root.inverse, sizeof root.inverse);
          }
      }});
      if (!well) return false;
      done += from.count;
      group.reset();
    }
    groups.clear();
    return true;
  }
};

template <class S> Geometry<S> geometry_of(const snarf_field& field) {
  Geometry<S> geometry;
  for (int i = 0; i < 3; ++i) {
    geometry.lower[i] = S(field.lower[i]);
    geometry.size[i] = S(field.size[i]);
    geometry.nodes[i] = field.nodes[i];
  }
  return geometry;
}

int64_t node_count(const snarf_field& field) { return int64_t(field.nodes[0]) * field.nodes[1] * field.nodes[2]; }

template <class S> bool comes_before(const Root<S>* a, const Root<S>* b) {
  if (a->order != b->order) return a->order < b->order;
  return std::lexicographical_compare(a->canonical, a->canonical + 3, b->canonical, b->canonical + 3);
}

template <class S> S determinant(const S* m) {
  return m[0] * (m[4] * m[8] - m[5] * m[7]) + m[1] * (m[5] * m[6] - m[3] * m[8]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
}

// Two reports of one root, by neighbouring cells or several starts. The two roots beside a fold may be as close, but differ in
// orientation.
template <class S> bool same_root(const Root<S>& a, const Root<S>& b, S distance) {
  S square = 0;
  for (int i = 0; i < 3; ++i) square += (a.canonical[i] - b.canonical[i]) * (a.canonical[i] - b.canonical[i]);
  return square < distance * distance && (determinant(a.inverse) > 0) == (determinant(b.inverse) > 0);
}

// Phases that sort the lists' roots by query and drop duplicates.
template <class S> class Collect {
 public:
  Collect(Group<S>& group, int64_t queries, int threads, S distance)
      : group_(group), queries_(queries), distance_(distance), counting_(threads, 1), placing_(threads, 1), threads_(threads) {}

  void add_to(std::vector<std::function<void(int)>>& phases) {
    phases.push_back([this](int thread) {
      if (thread == 0) begin_.reset(new std::atomic<int32_t>[queries_ + 1]());
    });
    phases.push_back([this](int) {
      for (int64_t list, end; counting_.take(list, end);)
        group_.lists[list]->each([&](const Root<S>& root) { begin_[root.query].fetch_add(1, std::memory_order_relaxed); });
    });
    phases.push_back([this](int thread) {
      if (thread) return;
      int64_t total = 0;
      for (int64_t q = 0; q <= queries_; ++q) {
        const int32_t here = begin_[q].load(std::memory_order_relaxed);
        begin_[q].store(int32_t(total), std::memory_order_relaxed);
        total += here;
      }
      group_.sorted.reset(new const Root<S>*[total]);
      total_ = total;
      kept_.assign(threads_, 0);
    });
    phases.push_back([this](int) {  // begin_[q] becomes the end of q, which is where q + 1 begins
      for (int64_t list, end; placing_.take(list, end);)
        group_.lists[list]->each(
            [&](const Root<S>& root) { group_.sorted[begin_[root.query].fetch_add(1, std::memory_order_relaxed)] = &root; });
    });
    phases.push_back([this](int thread) {
      const int64_t first = queries_ * thread / threads_, last = queries_ * (thread + 1) / threads_;
      const int64_t start = first ? begin_[first - 1].load() : 0;
      int64_t kept = start;
      for (int64_t q = first, at = start; q < last; ++q) {
        const int64_t end = begin_[q].load(std::memory_order_relaxed);
        const Root<S>** const roots = group_.sorted.get();
        if (end - at == 1) {
          roots[kept++] = roots[at++];
          continue;
        }
        std::sort(roots + at, roots + end, comes_before<S>);
        const int64_t mine = kept;
        for (; at < end; ++at) {
          bool is_new = true;
          for (int64_t k = mine; k < kept; ++k) is_new &= !same_root(*roots[k], *roots[at], distance_);
          if (is_new) roots[kept++] = roots[at];
        }
      }
      kept_[thread] = kept - start;
    });
    phases.push_back([this](int thread) {
      if (thread) return;
      int64_t total = 0;
      for (int t = 0; t < threads_; ++t) {
        const int64_t first = queries_ * t / threads_, start = first ? begin_[first - 1].load() : 0;
        if (total != start) std::memmove(group_.sorted.get() + total, group_.sorted.get() + start, kept_[t] * sizeof(Root<S>*));
        total += kept_[t];
      }
      group_.count = total;
      begin_.reset();
    });
  }

 private:
  Group<S>& group_;
  const int64_t queries_;
  const S distance_;
  std::unique_ptr<std::atomic<int32_t>[]> begin_;
  std::vector<int64_t> kept_;
  Queue counting_, placing_;
  const int threads_;
  int64_t total_ = 0;
};

std::vector<Block> active_blocks(const snarf_field& field, const uint8_t* active) {
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

template <class S> S smallest_side(const Geometry<S>& geometry) {
  return std::min(geometry.size[0], std::min(geometry.size[1], geometry.size[2]));
}

// A box and what its phases gather, one for each pose and thread.
template <class S> struct Extent {
  S lower[3], upper[3];
  double sides = 0;
  int64_t boxes = 0;
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

// The complete search of a group: `poses` poses from `first_pose` on, and of each the queries from `first_query` on.
template <class S> class CompleteSearch {
 public:
  CompleteSearch(const snarf_field& field, const snarf_queries& queries, const snarf_complete& settings, const std::vector<Block>& blocks,
                 int64_t first_pose, int64_t poses, int64_t first_query, int64_t count, int threads)
      : kernels_(kernels<S>()), blocks_(blocks), poses_(poses), count_(count), threads_(threads),
        chunks_(int((threads + poses - 1) / poses)), geometry_(geometry_of<S>(field)), nodes_(node_count(field)),
        points_(static_cast<const S*>(queries.points) + 3 * (first_pose * queries.count + first_query)), stride_(3 * queries.count),
        transforms_(static_cast<const S*>(field.transforms) + 12 * nodes_ * first_pose), settings_(settings),
        box_queue_(poses * int64_t(blocks.size()), 16), extent_queue_(poses * chunks_, 1), mark_queue_(poses * int64_t(blocks.size()), 16),
        count_queue_(poses * chunks_, 1), scan_queue_(poses, 1), place_queue_(poses * chunks_, 1),
        search_queue_(poses * int64_t(blocks.size()), 4) {}

  // Adds its phases; the roots go to `group`.
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
        kernels_.boxes(transforms_ + 12 * nodes_ * pose, geometry_, &blocks_[n % blocks_.size()], 1, &boxes_[n]);
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
      kernels_.extent(points_ + stride_ * (part / chunks_) + 3 * first, chunk_begin(part, 1) - first, extent.lower, extent.upper);
      query_extents_[part] = extent;
    }
  }

  // The queries of a pose are cut into `chunks_` chunks; this one's first query, or that of the next.
  int64_t chunk_begin(int64_t part, int next = 0) const { return count_ * (part % chunks_ + next) / chunks_; }

  void lay_out_bins() {
    for (int64_t pose = 0; pose < poses_; ++pose) {
      Extent<S> cells, here;
      for (int t = 0; t < threads_; ++t) cells.include(box_extents_[t * poses_ + pose]);
      for (int c = 0; c < chunks_; ++c) here.include(query_extents_[pose * chunks_ + c]);
      SortedQueries<S>& sorted = sorted_[pose];
      double volume = 1;
      bool empty = cells.boxes == 0;
      for (int i = 0; i < 3; ++i) {
        sorted.lower[i] = std::max(cells.lower[i], here.lower[i]);
        sorted.upper[i] = std::min(cells.upper[i], here.upper[i]);
        empty |= !(sorted.lower[i] <= sorted.upper[i]);
      }
      double side = 1;
      if (!empty) {
        side = kBinPerBox * cells.sides / double(cells.boxes);
        double longest = 0;
        for (int i = 0; i < 3; ++i) longest = std::max(longest, double(sorted.upper[i] - sorted.lower[i]));
        // Not many more bins than queries, since each costs as much as a query.
        side = std::max(side, longest * 1e-3);
        for (;; side *= 1.25) {
          volume = 1;
          for (int i = 0; i < 3; ++i) volume *= std::floor(double(sorted.upper[i] - sorted.lower[i]) / std::max(side, 1e-30)) + 1;
          if (volume <= double(2 * count_ + 4096)) break;
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

  template <class F> void each_bin_row(const SortedQueries<S>& sorted, const BlockBoxes<S>& boxes, int k, const F& visit) const {
    int32_t low[3], high[3];
    for (int i = 0; i < 3; ++i) {
      const S lower = boxes.lower[i][k], upper = boxes.upper[i][k];
      if (!(lower <= upper && upper >= sorted.lower[i] && lower <= sorted.upper[i])) return;
      low[i] = bin(sorted, i, lower);
      high[i] = bin(sorted, i, upper);
    }
    for (int32_t z = low[2]; z <= high[2]; ++z)
      for (int32_t y = low[1]; y <= high[1]; ++y) {
        const int64_t row = (int64_t(z) * sorted.bins[1] + y) * sorted.bins[0];
        visit(row + low[0], row + high[0] + 1);
      }
  }

  static int32_t bin(const SortedQueries<S>& sorted, int axis, S position) {
    const S at = (position - sorted.lower[axis]) * sorted.per_metre;
    return at > 0 ? (at < S(sorted.bins[axis]) ? int32_t(at) : sorted.bins[axis] - 1) : 0;
  }

  void mark() {
    for (int64_t first, last; mark_queue_.take(first, last);)
      for (int64_t n = first; n < last; ++n) {
        const int64_t pose = n / int64_t(blocks_.size());
        if (bin_offset_[pose + 1] == bin_offset_[pose]) continue;
        std::atomic<uint8_t>* const marked = marked_.get() + bin_offset_[pose];
        for (int k = 0; k < kBlock; ++k)
          each_bin_row(sorted_[pose], boxes_[n], k, [&](int64_t begin, int64_t end) {
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
        if (marked[at].load(std::memory_order_relaxed)) ++histogram[at];
        else key[n] = -1;
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
        std::fill(at + total, at + total + kBlock, S(0));  // read, never used
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
  const int64_t nodes_;
  const S* const points_;
  const int64_t stride_;
  const S* const transforms_;
  const snarf_complete& settings_;
  Queue box_queue_, extent_queue_, mark_queue_, count_queue_, scan_queue_, place_queue_, search_queue_;
  std::unique_ptr<BlockBoxes<S>[]> boxes_;
  std::vector<Extent<S>> box_extents_, query_extents_;
  std::vector<SortedQueries<S>> sorted_;
  std::vector<int64_t> bin_offset_;
  std::unique_ptr<std::atomic<uint8_t>[]> marked_;
  std::unique_ptr<int32_t[]> histogram_, begin_, key_, query_;
  std::unique_ptr<S[]> at_[3];
};

int threads_for(const snarf_queries& queries, int64_t count) {
  return int(std::max<int64_t>(1, std::min<int64_t>(queries.threads, count / kQueriesPerThread)));
}

template <class S>
void complete_search(const snarf_field& field, const snarf_queries& queries, const snarf_complete& settings, RootsOf<S>& out) {
  const std::vector<Block> blocks = active_blocks(field, settings.active);
  if (blocks.empty() || !queries.poses || !queries.count) return;
  const S distance = S(kSameRoot) * smallest_side(geometry_of<S>(field));
  const int64_t at_once = std::min(queries.count, kGroupQueries);
  const int64_t poses_at_once =
      std::max<int64_t>(1, std::min(kGroupQueries / at_once, kGroupBlocks / int64_t(blocks.size())));
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
      task.starts = static_cast<const S*>(settings.starts) + 12 * settings.count * pose;
      Queue queue(count, 256);
      Collect<S> collect(*group, count, threads, common.same_root);
      std::vector<std::function<void(int)>> phases;
      phases.push_back([&](int thread) {
        group->lists[thread].reset(new RootList<S>());
        for (int64_t first, last; queue.take(first, last);)
          kernels<S>().broyden(task, first, last, 0, group->lists[thread]->sink());
      });
      collect.add_to(phases);
      if (!run_phases(threads, phases)) throw std::bad_alloc();
      out.groups.push_back(std::move(group));
    }
}

template <class S>
void implicit_backward(const snarf_field& field, const snarf_queries& queries, int64_t roots, const S* gradient, const S* canonical,
                       const int64_t* query, const S* inverse, S* v_points, S* v_transforms) {
  const int64_t nodes = node_count(field), layers = field.nodes[2];
  if (v_points) std::fill(v_points, v_points + 3 * queries.poses * queries.count, S(0));
  if (v_transforms) std::fill(v_transforms, v_transforms + 12 * queries.poses * nodes, S(0));
  if (!roots) return;
  const int threads = threads_for(queries, roots);
  // Poses write to nodes of their own; those of a pose are cut into layers, whose owners pass over the same roots in the same order.
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

// Which nodes are a corner of an active cell; empty if all are.
std::vector<uint8_t> used_nodes(const snarf_blending& blending) {
  std::vector<uint8_t> used;
  if (!blending.active) return used;
  const int64_t width = blending.nodes[0], height = blending.nodes[1], depth = blending.nodes[2];
  used.assign(size_t(width * height * depth), 0);
  const uint8_t* active = blending.active;
  for (int64_t z = 0; z + 1 < depth; ++z)
    for (int64_t y = 0; y + 1 < height; ++y)
      for (int64_t x = 0; x + 1 < width; ++x) {
        if (!*active++) continue;
        for (int64_t row : {(z * height + y) * width, (z * height + y + 1) * width, ((z + 1) * height + y) * width, ((z + 1) * height + y + 1) * width})
          used[row + x] = used[row + x + 1] = 1;
      }
  return used;
}

constexpr int64_t kNodeChunks = 64;  // fixed, so that sums over the nodes do not depend on the number of threads

template <class S> class Blending {
 public:
  explicit Blending(const snarf_blending& blending) : used_(used_nodes(blending)) {
    task_.weights = static_cast<const S*>(blending.weights);
    task_.used = used_.empty() ? nullptr : used_.data();
    task_.poses = blending.poses;
    task_.bones = blending.count;
    task_.nodes = int64_t(blending.nodes[0]) * blending.nodes[1] * blending.nodes[2];
    task_.columns = (blending.count + kRow - 1) / kRow * kRow;
    bones_ = static_cast<const S*>(blending.bones);
    threads_ = int(std::max<int64_t>(1, std::min<int64_t>(blending.threads, task_.nodes * task_.poses / kQueriesPerThread)));
  }

  void forward(S* transforms) {
    std::vector<S> rows(size_t(task_.poses * task_.bones * kRow), S(0));
    for (int64_t n = 0; n < task_.poses * task_.bones; ++n) std::copy(bones_ + 12 * n, bones_ + 12 * n + 12, &rows[size_t(n * kRow)]);
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
  template <class F> void each_chunk(const F& work) {
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

// Runs a search in the number type of the field and hands its roots out; no exception leaves the library.
template <class Run> int search_with(const snarf_field* field, const snarf_queries* queries, snarf_roots** roots, int64_t* found, const Run& run) {
  if (!valid(field, queries) || !roots || !found) return SNARF_BAD_ARGUMENT;
  try {
    const auto go = [&](auto number) {
      using S = decltype(number);
      std::unique_ptr<RootsOf<S>> out(new RootsOf<S>());
      out->threads = queries->threads;
      run(number, *out);
      *found = out->count();
      *roots = out.release();
    };
    if (field->bytes_per_number == 4) go(float()); else go(double());
  } catch (...) {
    return SNARF_OUT_OF_MEMORY;
  }
  return SNARF_OK;
}

}  // namespace
}  // namespace snarf

int snarf_abi_version(void) { return SNARF_ABI_VERSION; }

const char* snarf_instruction_set(void) {
  return instruction_set() == kAvx512 ? "avx512" : instruction_set() == kAvx2 ? "avx2" : "baseline";
}

int snarf_blend(const snarf_blending* blending, void* transforms) {
  if (!valid(blending)) return SNARF_BAD_ARGUMENT;
  try {
    const auto go = [&](auto number) {
      using S = decltype(number);
      Blending<S>(*blending).forward(static_cast<S*>(transforms));
    };
    if (blending->bytes_per_number == 4) go(float()); else go(double());
  } catch (...) {
    return SNARF_OUT_OF_MEMORY;
  }
  return SNARF_OK;
}

int snarf_blend_backward(const snarf_blending* blending, const void* gradient, void* v_weights, void* v_bones) {
  if (!valid(blending)) return SNARF_BAD_ARGUMENT;
  try {
    const auto go = [&](auto number) {
      using S = decltype(number);
      Blending<S> task(*blending);
      if (v_weights) task.weights(static_cast<const S*>(gradient), static_cast<S*>(v_weights));
      if (v_bones) task.bones(static_cast<const S*>(gradient), static_cast<S*>(v_bones));
    };
    if (blending->bytes_per_number == 4) go(float()); else go(double());
  } catch (...) {
    return SNARF_OUT_OF_MEMORY;
  }
  return SNARF_OK;
}

int snarf_complete_search(const snarf_field* field, const snarf_queries* queries, const snarf_complete* settings, snarf_roots** roots,
                          int64_t* found) {
  if (!settings) return SNARF_BAD_ARGUMENT;
  return search_with(field, queries, roots, found,
                     [&](auto, auto& out) { complete_search(*field, *queries, *settings, out); });
}

int snarf_broyden_search(const snarf_field* field, const snarf_queries* queries, const snarf_broyden* settings, snarf_roots** roots,
                         int64_t* found) {
  if (!settings || settings->count < 0) return SNARF_BAD_ARGUMENT;
  return search_with(field, queries, roots, found, [&](auto, auto& out) { broyden_search(*field, *queries, *settings, out); });
}

int snarf_take_roots(snarf_roots* roots, void* canonical, int64_t* query, void* jacobian_inverse) {
  const std::unique_ptr<snarf_roots> owner(roots);
  if (!roots || !canonical || !query || !jacobian_inverse) return SNARF_OK;
  try {
    return owner->take(canonical, query, jacobian_inverse) ? SNARF_OK : SNARF_OUT_OF_MEMORY;
  } catch (...) {
    return SNARF_OUT_OF_MEMORY;
  }
}

int snarf_implicit_backward(const snarf_field* field, const snarf_queries* queries, int64_t roots, const void* gradient,
                            const void* canonical, const int64_t* query, const void* jacobian_inverse, void* v_points,
                            void* v_transforms) {
  if (!valid(field, queries) || roots < 0) return SNARF_BAD_ARGUMENT;
  try {
    const auto go = [&](auto number) {
      using S = decltype(number);
      implicit_backward(*field, *queries, roots, static_cast<const S*>(gradient), static_cast<const S*>(canonical), query,
                        static_cast<const S*>(jacobian_inverse), static_cast<S*>(v_points), static_cast<S*>(v_transforms));
    };
    if (field->bytes_per_number == 4) go(float()); else go(double());
  } catch (...) {
    return SNARF_OUT_OF_MEMORY;
  }
  return SNARF_OK;
}
