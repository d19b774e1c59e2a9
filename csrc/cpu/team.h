// Threads that work through the phases of one call together.
//
// They exist for one call only: between calls they take no time from the caller's threads, and a forked process lacks none.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace snarf {

class Barrier {
 public:
  explicit Barrier(int parties) : parties_(parties), waiting_(0), round_(0) {}

  // Waits for all parties; the caller may stand in for `arrivals` of them.
  void wait(int arrivals = 1) {
    const int round = round_.load(std::memory_order_acquire);
    if (waiting_.fetch_add(arrivals, std::memory_order_acq_rel) + arrivals == parties_) {
      waiting_.store(0, std::memory_order_relaxed);
      {
        std::lock_guard<std::mutex> lock(mutex_);
        round_.store(round + 1, std::memory_order_release);
      }
      all_here_.notify_all();
      return;
    }
    // Phases are short and even: most waits end before a sleeping thread would have woken up.
    for (int spin = 0; spin < 20000; ++spin)
      if (round_.load(std::memory_order_acquire) != round) return;
    std::unique_lock<std::mutex> lock(mutex_);
    all_here_.wait(lock, [&] { return round_.load(std::memory_order_acquire) != round; });
  }

 private:
  const int parties_;
  std::atomic<int> waiting_, round_;
  std::mutex mutex_;
  std::condition_variable all_here_;
};

// Work items handed out one range at a time.
class Queue {
 public:
  Queue(int64_t count, int64_t grain) : count_(count), grain_(grain < 1 ? 1 : grain), next_(0) {}
  bool take(int64_t& first, int64_t& last) {
    first = next_.fetch_add(grain_, std::memory_order_relaxed);
    last = first + grain_ < count_ ? first + grain_ : count_;
    return first < count_;
  }

 private:
  const int64_t count_, grain_;
  std::atomic<int64_t> next_;
};

// Runs each phase on every thread; all threads finish a phase before any starts the next. A phase that throws (out of memory)
// ends the call. Returns whether no phase threw.
inline bool run_phases(int threads, const std::vector<std::function<void(int)>>& phases) {
  std::atomic<bool> failed{false};
  Barrier barrier(threads);
  const auto work = [&](int first, int last) {  // does the work of these threads
    for (const auto& phase : phases) {
      // After a failure the threads still meet at every barrier: the others would wait for one that left early.
      try {
        for (int thread = first; thread < last && !failed; ++thread) phase(thread);
      } catch (...) { failed = true; }
      barrier.wait(last - first);
    }
  };
  std::vector<std::thread> helpers;
  int started = 0;
  try {
    helpers.reserve(threads - 1);
    for (; started < threads - 1; ++started) helpers.emplace_back(work, started, started + 1);
  } catch (...) {
    // The system grants no more threads: this one does the rest.
  }
  work(started, threads);
  for (auto& helper : helpers) helper.join();
  return !failed;
}

}  // namespace snarf
