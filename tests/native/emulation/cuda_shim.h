// Enough of CUDA's language to compile the kernels of csrc/cuda as C++ and run them on the CPU, one block after the other.
//
// Each thread of a block is a thread of the operating system: what is shared without a barrier is a race here as well (which
// -fsanitize=thread finds), and a barrier that not all threads reach is reported instead of waited for.
#pragma once

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <chrono>
#include <condition_variable>
#include <mutex>
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

class Barrier {
 public:
  explicit Barrier(unsigned threads) : threads_(threads) {}
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
inline Barrier* block_barrier = nullptr;

inline void __syncthreads() {
  if (block_barrier) block_barrier->wait();
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

// Runs a kernel on every block of the grid. Shared memory is static, so blocks do not run side by side.
template <class Arguments>
void run_grid(void (*kernel)(Arguments), const Arguments& arguments, unsigned x, unsigned y, unsigned threads) {
  gridDim = {x, y, 1};
  blockDim = {threads, 1, 1};
  Barrier barrier(threads);
  block_barrier = threads > 1 ? &barrier : nullptr;
  const auto run = [&](unsigned thread) {
    for (unsigned row = 0; row < y; ++row)
      for (unsigned column = 0; column < x; ++column) {
        threadIdx = {thread, 0, 0};
        blockIdx = {column, row, 0};
        kernel(arguments);
        __syncthreads();  // the next block uses the same shared memory
      }
  };
  std::vector<std::thread> others;
  for (unsigned thread = 1; thread < threads; ++thread) others.emplace_back(run, thread);
  run(0);
  for (auto& thread : others) thread.join();
}
