// The roots of all threads: collected, sorted by query, without duplicates, and copied to the caller.
#pragma once

#include <algorithm>
#include <cstring>
#include <memory>
#include <vector>

#include "kernels.h"
#include "snarf/api.h"
#include "team.h"

// The object behind a handle of the C interface.
struct snarf_roots {
  virtual ~snarf_roots() = default;
  virtual int64_t count() const = 0;
  virtual bool take(void* canonical, int64_t* query, void* inverse) = 0;
};

namespace snarf {

constexpr int64_t kWorkPerThread = 2048;  // queries, roots or nodes; minimum per thread

// The roots that one thread found, in blocks that never move.
template <class S>
class RootList {
 public:
  RootList() : sink_{nullptr, nullptr, this, more} {}
  RootList(const RootList&) = delete;
  RootSink<S>& sink() { return sink_; }

  template <class F>
  void each(const F& visit) {
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

constexpr int kAhead = 12;  // roots in the order of the queries lie anywhere in memory; fetching early hides most of the wait

inline void prefetch(const void* at) {
#if defined(__GNUC__)
  __builtin_prefetch(at);
#else
  (void)at;
#endif
}

// The roots of a group of consecutive queries, sorted.
template <class S>
struct Group {
  int64_t first_query = 0;  // flat
  std::vector<std::unique_ptr<RootList<S>>> lists;
  std::unique_ptr<const Root<S>*[]> sorted;
  int64_t count = 0;
};

template <class S>
struct RootsOf final : snarf_roots {
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
      const bool well = run_phases(from.count > 4 * kWorkPerThread ? threads : 1, {[&](int) {
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

// Several starts may report one root with inverses that differ in the last bits: only identical reports compare equal.
template <class S>
bool comes_before(const Root<S>* a, const Root<S>* b) {
  if (a->order != b->order) return a->order < b->order;
  for (int i = 0; i < 3; ++i)
    if (a->canonical[i] != b->canonical[i]) return a->canonical[i] < b->canonical[i];
  return std::lexicographical_compare(a->inverse, a->inverse + 9, b->inverse, b->inverse + 9);
}

template <class S>
S determinant(const S* m) {
  return m[0] * (m[4] * m[8] - m[5] * m[7]) + m[1] * (m[5] * m[6] - m[3] * m[8]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
}

// Two reports of one root, by neighbouring cells or several starts. The two roots beside a fold may be as close, but differ in
// orientation.
template <class S>
bool same_root(const Root<S>& a, const Root<S>& b, S distance) {
  S square = 0;
  for (int i = 0; i < 3; ++i) square += (a.canonical[i] - b.canonical[i]) * (a.canonical[i] - b.canonical[i]);
  return square < distance * distance && (determinant(a.inverse) > 0) == (determinant(b.inverse) > 0);
}

// Sorts the roots at to end of one query and moves those that differ to `kept`; returns the end of them.
template <class S>
int64_t keep_different(const Root<S>** roots, int64_t at, int64_t end, int64_t kept, S distance) {
  std::sort(roots + at, roots + end, comes_before<S>);
  const int64_t first = kept;
  for (; at < end; ++at) {
    bool is_new = true;
    for (int64_t k = first; k < kept; ++k) is_new &= !same_root(*roots[k], *roots[at], distance);
    if (is_new) roots[kept++] = roots[at];
  }
  return kept;
}

// The roots in a list that has all those of the queries first to last: sorted by query, without duplicates.
template <class S>
std::vector<const Root<S>*> sorted_roots(RootList<S>& list, int64_t first, int64_t last, S distance) {
  std::vector<int32_t> begin(size_t(last - first + 1), 0);
  list.each([&](const Root<S>& root) { ++begin[root.query - first + 1]; });
  for (int64_t q = 0; q < last - first; ++q) begin[q + 1] += begin[q];
  std::vector<const Root<S>*> roots(size_t(begin.back()));
  list.each([&](const Root<S>& root) { roots[begin[root.query - first]++] = &root; });  // begin[q] becomes the end of q
  int64_t kept = 0, at = 0;
  for (int64_t q = 0; q < last - first; ++q) {
    kept = keep_different(roots.data(), at, int64_t(begin[q]), kept, distance);
    at = begin[q];
  }
  roots.resize(size_t(kept));
  return roots;
}

// Phases that sort the lists' roots by query and drop duplicates.
template <class S>
class Collect {
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
        kept = keep_different(roots, at, end, kept, distance_);
        at = end;
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
};

}  // namespace snarf
