// Enough of CUDA's language to compile the kernels of csrc/cuda as C++ and run them on the CPU, one block after the other, in
// the order of their numbers or in any other.
//
// Each thread of a block is a fiber: they take turns on one thread of the operating system, from one barrier to the next, which
// is fast for blocks of any size. With -fsanitize=thread each is a thread of the operating system instead, so that what is
// shared without a barrier is reported as a race. A barrier that not all threads reach is reported instead of waited for.
//
// The kernels tell what they do by SNARF_COUNT(rounds), (halvings) and (solves); see `Work`.
#pragma once

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <random>
#include <thread>
#include <vector>

#define __global__
#define __device__
#define __shared__ static
#define __launch_bounds__(...)
#define __forceinline__ inline

struct dim3 {
  unsigned x, y, z;
};
inline thread_local dim3 threadIdx{}, blockIdx{};
inline dim3 blockDim{}, gridDim{};

// What one thread did in one block.
struct Work {
  long long rounds, halvings, solves;
};
inline std::vector<Work> thread_work;  // by threadIdx.x
#define SNARF_COUNT(what) (++thread_work[threadIdx.x].what)

#ifdef __SANITIZE_THREAD__
class Block {
 public:
  explicit Block(unsigned threads) : threads_(threads) {}

  template <class Body>
  void run(const Body& body) {
    std::vector<std::thread> others;
    for (unsigned thread = 1; thread < threads_; ++thread) others.emplace_back(body, thread);
    body(0);
    for (auto& thread : others) thread.join();
  }

  void wait() {
    std::unique_lock<std::mutex> lock(mutex_);
    const unsigned mine = round_;
    if (++arrived_ == threads_) {
      arrived_ = 0;
      ++round_;
      changed_.notify_all();
    } else if (!changed_.wait_for(lock, std::chrono::seconds(60), [&] { return round_ != mine; })) {
      fprintf(stderr, "a thread of block (%u, %u) waits for others that never come\n", blockIdx.x, blockIdx.y);
      abort();
    }
  }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  const unsigned threads_;
  unsigned arrived_ = 0, round_ = 0;
};
#else
#include <setjmp.h>
#include <ucontext.h>

class Block {
 public:
  explicit Block(unsigned threads) : fibers_(threads) {}

  template <class Body>
  void run(const Body& body) {
    if (fibers_.size() == 1) return body(0);
    body_ = &body;
    call_ = [](const void* body, unsigned thread) { (*static_cast<const Body*>(body))(thread); };
    for (auto& fiber : fibers_) {
      fiber.stack.reset(new char[kStack]);
      getcontext(&fiber.context);
      fiber.context.uc_stack.ss_sp = fiber.stack.get();
      fiber.context.uc_stack.ss_size = kStack;
      running_ = this;
      makecontext(&fiber.context, start, 0);
    }
    // A round takes each thread to its next barrier or to its end; all of them must come to the same.
    for (size_t ended = 0; ended < fibers_.size();) {
      ended = 0;
      for (current_ = 0; current_ < fibers_.size(); ++current_) {
        take_turn(fibers_[current_]);
        ended += fibers_[current_].ended;
      }
      if (ended && ended < fibers_.size()) {
        fprintf(stderr, "a thread of block (%u, %u) waits for others that never come\n", blockIdx.x, blockIdx.y);
        abort();
      }
    }
  }

  void wait() {
    if (fibers_.size() == 1) return;
    const dim3 thread = threadIdx, block = blockIdx;
    if (!_setjmp(fibers_[current_].waits_at)) _longjmp(turn_over_, 1);
    threadIdx = thread;
    blockIdx = block;
  }

 private:
  static constexpr size_t kStack = 1 << 18;
  struct Fiber {
    ucontext_t context;
    std::unique_ptr<char[]> stack;
    jmp_buf waits_at;
    bool has_started = false, ended = false;
  };
  // Contexts are only used to start a fiber: changing them calls the system, jumping does not.
  void take_turn(Fiber& fiber) {
    if (fiber.ended || _setjmp(turn_over_)) return;
    if (fiber.has_started) _longjmp(fiber.waits_at, 1);
    fiber.has_started = true;
    setcontext(&fiber.context);
  }
  static void start() {
    Block& block = *running_;
    block.call_(block.body_, unsigned(block.current_));
    block.fibers_[block.current_].ended = true;
    _longjmp(block.turn_over_, 1);
  }

  static inline Block* running_ = nullptr;
  std::vector<Fiber> fibers_;
  jmp_buf turn_over_;
  size_t current_ = 0;
  const void* body_ = nullptr;
  void (*call_)(const void*, unsigned) = nullptr;
};
#endif
inline Block* running_block = nullptr;

inline void __syncthreads() { running_block->wait(); }
inline int __syncthreads_or(int value) {
  static int any;
  __syncthreads();  // all threads have read the last one
  if (threadIdx.x == 0) any = 0;
  __syncthreads();
  if (value) __atomic_store_n(&any, 1, __ATOMIC_RELAXED);
  __syncthreads();
  return any;
}

inline unsigned __float_as_uint(float value) {
  unsigned bits;
  memcpy(&bits, &value, sizeof bits);
  return bits;
}
inline float __uint_as_float(unsigned bits) {
  float value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

inline int atomicAdd(int* at, int value) { return __atomic_fetch_add(at, value, __ATOMIC_RELAXED); }
inline int atomicSub(int* at, int value) { return __atomic_fetch_sub(at, value, __ATOMIC_RELAXED); }
inline int atomicExch(int* at, int value) { return __atomic_exchange_n(at, value, __ATOMIC_RELAXED); }
inline unsigned atomicMax(unsigned* at, unsigned value) {
  unsigned old = __atomic_load_n(at, __ATOMIC_RELAXED);
  while (old < value && !__atomic_compare_exchange_n(at, &old, value, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
  return old;
}
template <class S>
S atomicAdd(S* at, S value) {
  S old, sum;
  __atomic_load(at, &old, __ATOMIC_RELAXED);
  do sum = old + value;
  while (!__atomic_compare_exchange(at, &old, &sum, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
  return old;
}

// Adds the sums over the block's threads, and the most of any one thread.
inline void take_work(std::vector<Work>& work) {
  Work sum{}, most{};
  for (Work& one : thread_work) {
    sum = {sum.rounds + one.rounds, sum.halvings + one.halvings, sum.solves + one.solves};
    most = {std::max(most.rounds, one.rounds), std::max(most.halvings, one.halvings), std::max(most.solves, one.solves)};
    one = Work();
  }
  work.push_back(sum);
  work.push_back(most);
}

// Numbers of the blocks in the order in which they run; any other seed than 0 shuffles them.
inline std::vector<unsigned> order_of_blocks(unsigned blocks, unsigned seed) {
  std::vector<unsigned> order(blocks);
  for (unsigned block = 0; block < blocks; ++block) order[block] = block;
  if (seed) std::shuffle(order.begin(), order.end(), std::mt19937(seed));
  return order;
}

// Runs a kernel on every block of the grid. Shared memory is static, so blocks do not run side by side. `work` gets what
// each block did, in the order in which they ran: two entries, see take_work().
template <class Arguments>
void run_grid(void (*kernel)(Arguments), const Arguments& arguments, unsigned x, unsigned y, unsigned threads, unsigned seed,
              std::vector<Work>& work) {
  gridDim = {x, y, 1};
  blockDim = {threads, 1, 1};
  Block block(threads);
  running_block = &block;
  thread_work.assign(threads, Work());
  work.clear();
  const std::vector<unsigned> order = order_of_blocks(x * y, seed);
  block.run([&](unsigned thread) {
    for (const unsigned number : order) {
      threadIdx = {thread, 0, 0};
      blockIdx = {number % x, number / x, 0};
      kernel(arguments);
      __syncthreads();  // the next block uses the same shared memory
      if (!thread) take_work(work);
      __syncthreads();
    }
  });
}
