// Uniform bins over a pose's queries, and the rows of bins that boxes touch.
#pragma once

#include "search.cuh"

namespace snarf {
namespace SNARF_ISA {

constexpr float kFarthest = 1e30f;  // metres

// Uniform bins over a box in posed space.
template <class S>
struct Bins {
  S lower[3], upper[3];  // metres
  S per_metre;
  int number[3];  // 0 if nothing lies in the box
};

// ------------------------------------------------------------------------------------------------ the region
// An unsigned integer that grows with the float; 0 is below all of them. Atomic maxima of floats are made of it.
SNARF_HD unsigned ordered(float value) {
  unsigned bits = __float_as_uint(value);
  return bits >> 31 ? ~bits : bits | 0x80000000u;
}
SNARF_HD float from_ordered(unsigned bits) { return __uint_as_float(bits >> 31 ? bits & 0x7fffffffu : ~bits); }

// The next float upwards or the same.
SNARF_HD float rounded_up(float value) { return value; }
SNARF_HD float rounded_up(double value) {
  if (value > kFarthest) return kFarthest;
  if (value < -kFarthest) return -kFarthest;
  float near = float(value);
  return near < value ? near + absolute(near) * 1.2e-7f + 1e-37f : near;
}

// Widens bounds (upper, -lower) by an interval along one axis.
template <class S>
__device__ void widen(unsigned* bounds, int axis, S lower, S upper) {
  atomicMax(bounds + axis, ordered(rounded_up(upper)));
  atomicMax(bounds + 3 + axis, ordered(rounded_up(-lower)));
}

// ------------------------------------------------------------------------------------------------ bins
template <class S>
__device__ int number_of_bins(S extent, S per_metre) {
  return int(extent * per_metre) + 1;
}

// Lays out as many bins as allowed over the region where both cells and queries are, with equal sides.
template <class S>
__device__ void lay_out(const unsigned* region, int most, Bins<S>& bins) {
  S extent[3], longest = 0;
  bool filled = true;
  for (int i = 0; i < 3; ++i) {
    // An entry that nothing was written to decodes to NaN.
    bins.upper[i] = smaller(from_ordered(region[i]), from_ordered(region[6 + i]));
    bins.lower[i] = -smaller(from_ordered(region[3 + i]), from_ordered(region[9 + i]));
    filled = filled && region[i] && region[6 + i] && bins.lower[i] <= bins.upper[i];
    extent[i] = bins.upper[i] - bins.lower[i];
    longest = larger(longest, extent[i]);
  }
  bins.per_metre = 0;
  if (filled && longest > S(1e-30)) {
    int fits = 0, too_many = most + 1;  // bins along the longest side
    while (too_many - fits > 1) {
      int middle = fits + (too_many - fits) / 2;
      S per_metre = S(middle) / longest;
      long long number = 1;
      for (int i = 0; i < 3; ++i) number *= number_of_bins(extent[i], per_metre);
      (number <= most ? fits : too_many) = middle;
    }
    bins.per_metre = S(fits) / longest;
  }
  for (int i = 0; i < 3; ++i) bins.number[i] = filled ? number_of_bins(extent[i], bins.per_metre) : 0;
}

// Grows with the position, so that a query inside a box never lies outside the box's bins.
template <class S>
__device__ int bin_along(const Bins<S>& bins, int axis, S position) {
  S at = (position - bins.lower[axis]) * bins.per_metre;
  return at > 0 ? (at < S(bins.number[axis]) ? int(at) : bins.number[axis] - 1) : 0;
}

// The bin of a query, or -1 if the query is not in the region.
template <class S>
__device__ int bin_of(const Bins<S>& bins, const S* p) {
  if (!bins.number[0]) return -1;
  int at[3];
  for (int i = 0; i < 3; ++i) {
    if (!(p[i] >= bins.lower[i] && p[i] <= bins.upper[i])) return -1;
    at[i] = bin_along(bins, i, p[i]);
  }
  return (at[2] * bins.number[1] + at[1]) * bins.number[0] + at[0];
}

// ------------------------------------------------------------------------------------------------ shares of a block
// Running sums over the block: sums[t] becomes that of the values of the threads 0 .. t. Returns the total.
__device__ __forceinline__ long long sum_over_block(long long value, long long* sums) {
  const int t = threadIdx.x, threads = blockDim.x;
  __syncthreads();  // all threads have read the last sums
  sums[t] = value;
  for (int step = 1; step < threads; step *= 2) {
    __syncthreads();
    const long long before = t >= step ? sums[t - step] : 0;
    __syncthreads();
    sums[t] += before;
  }
  __syncthreads();
  return sums[threads - 1];
}

// Whose share the n-th item is: the first thread whose running sum exceeds n. `n` becomes its number within that share.
__device__ __forceinline__ int owner_of(const long long* sums, long long& n) {
  int first = 0, last = blockDim.x - 1;
  while (first < last) {
    const int middle = (first + last) / 2;
    if (sums[middle] > n)
      last = middle;
    else
      first = middle + 1;
  }
  if (first) n -= sums[first - 1];
  return first;
}

// The rows of bins, runs along x, that the boxes of a block's threads touch: one box a thread, at most kMost. In shared memory.
template <int kMost>
struct Rows {
  int low_x[kMost], high_x[kMost], low_y[kMost], low_z[kMost], size_y[kMost];
  long long sums[kMost];  // running sums of the numbers of rows
};

// Queries in a row of bins, sorted[begin .. end - 1], and the thread whose box touches it.
struct Row {
  int owner, begin, end;
};

// Enters this thread's box, if it has one; all threads of the block call it. Returns the number of rows of all boxes.
template <class S, int kMost>
__device__ __forceinline__ long long enter_box(const Bins<S>& bins, bool has_box, const S* centre, const S* box,
                                               Rows<kMost>& rows) {
  const int t = threadIdx.x;
  long long number = 0;
  if (has_box) {
    int low[3], high[3];
    bool touched = true;
    for (int i = 0; i < 3; ++i) {
      touched = touched && centre[i] + box[i] >= bins.lower[i] && centre[i] - box[i] <= bins.upper[i];
      low[i] = bin_along(bins, i, centre[i] - box[i]);
      high[i] = bin_along(bins, i, centre[i] + box[i]);
    }
    rows.low_x[t] = low[0];
    rows.high_x[t] = high[0];
    rows.low_y[t] = low[1];
    rows.low_z[t] = low[2];
    rows.size_y[t] = high[1] - low[1] + 1;
    if (touched) number = (long long)rows.size_y[t] * (high[2] - low[2] + 1);
  }
  return sum_over_block(number, rows.sums);
}

// The n-th row of all boxes. bin_end: as in Search, from the pose's first bin on.
template <class S, int kMost>
__device__ __forceinline__ Row row_of(const Bins<S>& bins, const Rows<kMost>& rows, long long n, const int* bin_end,
                                      long long first_bin) {
  Row row;
  row.owner = owner_of(rows.sums, n);
  const int y = rows.low_y[row.owner] + int(n % rows.size_y[row.owner]);
  const int z = rows.low_z[row.owner] + int(n / rows.size_y[row.owner]);
  const long long start = first_bin + ((long long)z * bins.number[1] + y) * bins.number[0];
  const long long begin = start + rows.low_x[row.owner];
  row.begin = begin ? bin_end[begin - 1] : 0;
  row.end = bin_end[start + rows.high_x[row.owner]];
  return row;
}

}  // namespace SNARF_ISA
}  // namespace snarf
