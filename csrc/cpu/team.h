// Threads that work through the phases of one call together.
//
// DESIGN. Helper threads are started when first needed and sleep between calls. New threads for every call would cost more than
// most calls of a training step take: a kernel may leave a new thread on its parent's core until the next tick of the
// scheduler. A forked process, which has none of its parent's threads, starts its own. Only one call at a time has the helpers;
// one that comes from another thread meanwhile starts threads of its own.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#if !defined(_WIN32)
#include <pthread.h>
#endif

namespace snarf {

// Looks before a thread sleeps: phases are short and even, and most waits end before a sleeping thread would have woken up.
constexpr int kSpins = 20000;

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
    for (int spin = 0; spin < kSpins; ++spin)
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

// Threads that sleep until they are given work. They live as long as the process, and so does this object, which is never
// destroyed: at the end of the process they may still sleep in it. The library must not be unloaded once there are some.
class Helpers {
 public:
  // The helpers of this process, if no other call has them; the caller must `release` them.
  static Helpers* claim() {
    static std::atomic<Helpers*> current{nullptr};
    Helpers* helpers = current.load(std::memory_order_acquire);
    if (!helpers || helpers->process_ != this_process()) {  // those of a parent process have no threads here
      std::unique_ptr<Helpers> fresh(new Helpers);
      if (current.compare_exchange_strong(helpers, fresh.get(), std::memory_order_acq_rel)) helpers = fresh.release();
    }
    return helpers->is_claimed_.exchange(true, std::memory_order_acquire) ? nullptr : helpers;
  }
  void release() { is_claimed_.store(false, std::memory_order_release); }

  // Starts work(i) for each i < count on a helper, and returns the number of helpers that there are for it.
  int start(int count, const std::function<void(int)>& work) {
    try {
      while (int(helpers_.size()) < count) {
        std::unique_ptr<Helper> helper(new Helper);
        helpers_.reserve(helpers_.size() + 1);
        std::thread(run, helper.get(), int(helpers_.size())).detach();
        helpers_.push_back(std::move(helper));
      }
    } catch (...) {
      // The system grants no more threads: the caller does the rest.
    }
    count = count < int(helpers_.size()) ? count : int(helpers_.size());
    for (int i = 0; i < count; ++i) helpers_[i]->give(&work);
    return count;
  }
  // Waits until the first `count` helpers have done their work.
  void finish(int count) {
    for (int i = 0; i < count; ++i) helpers_[i]->wait_until_idle();
  }

 private:
  struct Helper {
    std::mutex mutex;
    std::condition_variable changed;
    std::atomic<const std::function<void(int)>*> work{nullptr};  // changes under the mutex

    void give(const std::function<void(int)>* task) {
      {
        std::lock_guard<std::mutex> lock(mutex);
        work.store(task, std::memory_order_release);
      }
      changed.notify_all();
    }
    void wait_until_idle() {
      for (int spin = 0; spin < kSpins; ++spin)
        if (!work.load(std::memory_order_acquire)) return;
      std::unique_lock<std::mutex> lock(mutex);
      changed.wait(lock, [&] { return !work.load(std::memory_order_relaxed); });
    }
  };

  static void run(Helper* helper, int number) {
    for (;;) {
      std::unique_lock<std::mutex> lock(helper->mutex);
      helper->changed.wait(lock, [&] { return helper->work.load(std::memory_order_relaxed); });
      lock.unlock();
      (*helper->work.load(std::memory_order_relaxed))(number);
      helper->give(nullptr);
    }
  }
  // The number of forks that led to this process since the library was first used.
  static int64_t this_process() {
    static std::atomic<int64_t> forks{0};
#if !defined(_WIN32)
    static const int registered = pthread_atfork(nullptr, nullptr, [] { forks.fetch_add(1); });
    (void)registered;
#endif
    return forks.load();
  }

  const int64_t process_ = this_process();
  std::atomic<bool> is_claimed_{false};
  std::vector<std::unique_ptr<Helper>> helpers_;
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
  if (threads == 1) {
    work(0, 1);
    return !failed;
  }
  const std::function<void(int)> of_helper = [&](int helper) { work(helper, helper + 1); };
  if (Helpers* const helpers = Helpers::claim()) {
    const int started = helpers->start(threads - 1, of_helper);
    work(started, threads);
    helpers->finish(started);
    helpers->release();
    return !failed;
  }
  std::vector<std::thread> own;
  int started = 0;
  try {
    own.reserve(threads - 1);
    for (; started < threads - 1; ++started) own.emplace_back(of_helper, started);
  } catch (...) {
    // as in Helpers::start
  }
  work(started, threads);
  for (auto& helper : own) helper.join();
  return !failed;
}

}  // namespace snarf
