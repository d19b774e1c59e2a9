// A pose that is searched many times with few queries: the cells are bounded and sorted into bins once, in one buffer.
//
// DESIGN. The search of a group (complete_search.h) sorts the queries into bins and goes through the cells, which is best for
// as many queries as there are cells. Here it is the other way round: the cells are sorted into bins, and each query goes
// through those of its bin (pair_search.h). A cell is entered into every bin that its posed box touches; one that would touch
// too many is entered into a coarser level of bins. A bin holds the part of each box that lies in it, in bytes, side by side:
// what most cells of a bin need to be excluded is read in one go.
//
// The buffer is plain data without pointers, so that its owner may copy it:
//   PreparedHeader, numbers of the cells [C], places of the poses' parts [B], then for each pose: PreparedPose<S>,
//   CellRecord<S> [C], first groups of the bins [bins + 1], BinGroup [groups]
#pragma once

#include <algorithm>
#include <bitset>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <vector>

#include "bins.h"
#include "complete_search.h"
#include "dispatch.h"
#include "roots.h"
#include "snarf/api.h"
#include "team.h"

// The object behind a handle of the C interface.
struct snarf_prepared {
  virtual ~snarf_prepared() = default;
  virtual int64_t bytes() const = 0;
  // Writes the buffer, and the lower and upper corner of each pose's box, [B, 2, 3].
  virtual void write(char* buffer, void* boxes) = 0;
};

namespace snarf {

constexpr int64_t kPreparedMark = 0x31706e7366726e73;  // tells a buffer of this layout from other data
constexpr int kMostBins = 128;                         // that a cell may touch; more on the coarsest level only
constexpr double kFineBin = 1.0;                       // side of a bin of level 0, in the median of the boxes' longest sides
constexpr int64_t kQueriesAtOnce = 512;                // that a thread takes

struct PreparedHeader {
  int64_t mark, bytes, poses, cells;
  int32_t nodes[3], bytes_per_number;
};

// Arrays begin at multiples of a cache line.
inline int64_t aligned(int64_t bytes) { return (bytes + 63) / 64 * 64; }

inline PreparedHeader header_of(const char* buffer) {
  PreparedHeader header;
  std::memcpy(&header, buffer, sizeof header);
  return header;
}

// Goes through the arrays of a buffer.
class Cursor {
 public:
  explicit Cursor(char* at) : at_(at) {}
  template <class T>
  T* next(int64_t count) {
    T* const here = reinterpret_cast<T*>(at_);
    at_ += aligned(count * int64_t(sizeof(T)));
    return here;
  }
  template <class T>
  void write(const T* values, int64_t count) {
    T* const to = next<T>(count);
    if (count) std::memcpy(static_cast<void*>(to), values, size_t(count) * sizeof(T));
  }

 private:
  char* at_;
};

// One pose's cells, bounded and sorted into bins, before they are copied into the buffer.
template <class S>
struct SortedCells {
  PreparedPose<S> pose{};
  int64_t count = 0;                       // C
  std::unique_ptr<CellRecord<S>[]> cells;  // [C]
  std::unique_ptr<S[]> boxes;              // half extents, [C, 3], metres
  std::vector<int32_t> first;              // group of each bin, [bins + 1]
  std::vector<std::vector<int64_t>> next;  // by chunk of cells: the place of its next cell in each bin, [bins]

  int64_t bytes() const {
    return aligned(sizeof pose) + aligned(count * int64_t(sizeof(CellRecord<S>))) + aligned(int64_t(first.size() * 4)) +
           aligned(pose.groups * int64_t(sizeof(BinGroup)));
  }
  // The first cell of a chunk; chunks are counted and entered by several threads.
  int64_t chunk_begin(int64_t chunk) const { return count * chunk / int64_t(next.size()); }
  // Writes the posed box of a cell; returns false for one without a box.
  bool box(int64_t cell, S* lower, S* upper) const {
    for (int i = 0; i < 3; ++i) {
      lower[i] = cells[cell].centre[i] - boxes[3 * cell + i];
      upper[i] = cells[cell].centre[i] + boxes[3 * cell + i];
    }
    return cells[cell].reach[0] >= 0;
  }
};

// Chooses the bins: the region of all boxes, and the levels.
template <class S>
void lay_out_bins(SortedCells<S>& out) {
  PreparedPose<S>& pose = out.pose;
  std::fill(pose.lower, pose.lower + 3, std::numeric_limits<S>::infinity());
  std::fill(pose.upper, pose.upper + 3, -std::numeric_limits<S>::infinity());
  std::vector<S> sides;
  S lower[3], upper[3];
  for (int64_t cell = 0; cell < out.count; ++cell) {
    if (!out.box(cell, lower, upper)) continue;
    S side = 0;
    for (int i = 0; i < 3; ++i) {
      pose.lower[i] = std::min(pose.lower[i], lower[i]);
      pose.upper[i] = std::max(pose.upper[i], upper[i]);
      side = std::max(side, upper[i] - lower[i]);
    }
    sides.push_back(side);
  }
  pose.levels = 0;
  pose.bins = 0;
  pose.shares_per_metre = 1;
  if (sides.empty()) return;
  std::nth_element(sides.begin(), sides.begin() + sides.size() / 2, sides.end());
  double side = kFineBin * double(sides[sides.size() / 2]), longest = 0;
  for (int i = 0; i < 3; ++i) longest = std::max(longest, double(pose.upper[i] - pose.lower[i]));
  side = std::max({side, longest * 1e-3, 1e-30});  // at most about 1000 bins along an axis: a float knows their shares
  const auto bins_along = [&](int i) { return std::floor(double(pose.upper[i] - pose.lower[i]) / side) + 1; };
  while (bins_along(0) * bins_along(1) * bins_along(2) > double(16 * sides.size() + 4096)) side *= 1.25;
  pose.shares_per_metre = S((1 << kShareBits) / side);
  for (int64_t bins = 0; bins != 1 && pose.levels < kMostLevels; ++pose.levels) {
    PreparedLevel& level = pose.level[pose.levels];
    level.bins_before = pose.bins;
    level.is_empty = true;
    bins = 1;
    for (int i = 0; i < 3; ++i) {
      level.bins[i] = ((int32_t(bins_along(i)) - 1) >> (kCoarserBits * pose.levels)) + 1;
      bins *= level.bins[i];
    }
    pose.bins += bins;
  }
}

// The bins of a level that the box of a cell touches.
struct TouchedBins {
  int32_t low[3], high[3];  // shares
  int level;

  int32_t first(int axis) const { return SNARF_ISA::bin_of_share(low[axis], level); }
  int32_t last(int axis) const { return SNARF_ISA::bin_of_share(high[axis], level); }
  int64_t count() const { return int64_t(last(0) - first(0) + 1) * (last(1) - first(1) + 1) * (last(2) - first(2) + 1); }
  // Calls visit(bin, its place [3] along the axes).
  template <class F>
  void each(const PreparedLevel& in, const F& visit) const {
    int32_t at[3];
    for (at[2] = first(2); at[2] <= last(2); ++at[2])
      for (at[1] = first(1); at[1] <= last(1); ++at[1])
        for (at[0] = first(0); at[0] <= last(0); ++at[0])
          visit(in.bins_before + (int64_t(at[2]) * in.bins[1] + at[1]) * in.bins[0] + at[0], at);
  }
  // The part of the box in a bin, along an axis.
  uint8_t lower_in(int32_t bin, int axis) const { return bin > first(axis) ? 0 : SNARF_ISA::place_in_bin(low[axis], level); }
  uint8_t upper_in(int32_t bin, int axis) const { return bin < last(axis) ? 255 : SNARF_ISA::place_in_bin(high[axis], level); }
};

// Calls visit(cell, touched bins) for each cell of a chunk that has a box, on the finest level that it fits.
template <class S, class F>
void each_cell(const SortedCells<S>& sorted, int64_t chunk, const F& visit) {
  S lower[3], upper[3];
  for (int64_t cell = sorted.chunk_begin(chunk); cell < sorted.chunk_begin(chunk + 1); ++cell) {
    if (!sorted.box(cell, lower, upper)) continue;
    TouchedBins touched;
    for (int i = 0; i < 3; ++i) {
      touched.low[i] = SNARF_ISA::share_along(sorted.pose, i, lower[i]);
      touched.high[i] = SNARF_ISA::share_along(sorted.pose, i, upper[i]);
    }
    touched.level = 0;
    while (touched.level + 1 < sorted.pose.levels && touched.count() > kMostBins) ++touched.level;
    visit(int32_t(cell), touched);
  }
}

// Counts the cells of a chunk in each bin, in `next`.
template <class S>
void count_cells(SortedCells<S>& out, int64_t chunk) {
  const PreparedPose<S>& pose = out.pose;
  std::vector<int64_t>& sizes = out.next[chunk];
  sizes.assign(size_t(pose.bins), 0);
  each_cell(out, chunk, [&](int32_t, const TouchedBins& touched) {
    touched.each(pose.level[touched.level], [&](int64_t bin, const int32_t*) { ++sizes[bin]; });
  });
}

// Lays out the groups of all bins, and in them the cells of the chunks one after the other: counts become places.
template <class S>
void lay_out_groups(SortedCells<S>& out) {
  PreparedPose<S>& pose = out.pose;
  out.first.assign(size_t(pose.bins + 1), 0);
  pose.groups = 0;
  for (int level = 0; level < pose.levels; ++level) {
    const int64_t groups_before = pose.groups;
    const int64_t end = level + 1 < pose.levels ? pose.level[level + 1].bins_before : pose.bins;
    for (int64_t bin = pose.level[level].bins_before; bin < end; ++bin) {
      int64_t place = pose.groups * kBlock;
      for (auto& next : out.next) {
        const int64_t size = next[bin];
        next[bin] = place;
        place += size;
      }
      pose.groups = (place + kBlock - 1) / kBlock;
      if (pose.groups > std::numeric_limits<int32_t>::max()) throw std::bad_alloc();  // 340 GB of groups
      out.first[bin + 1] = int32_t(pose.groups);
    }
    pose.level[level].is_empty = pose.groups == groups_before;
  }
}

// Enters the cells of a chunk into the groups of their bins.
template <class S>
void enter_cells(SortedCells<S>& sorted, int64_t chunk, BinGroup* groups) {
  std::vector<int64_t>& next = sorted.next[chunk];
  each_cell(sorted, chunk, [&](int32_t cell, const TouchedBins& touched) {
    touched.each(sorted.pose.level[touched.level], [&](int64_t bin, const int32_t* at) {
      const int64_t place = next[bin]++;
      BinGroup& group = groups[place / kBlock];
      const int k = int(place % kBlock);
      for (int i = 0; i < 3; ++i) {
        group.lower[i][k] = touched.lower_in(at[i], i);
        group.upper[i][k] = touched.upper_in(at[i], i);
      }
      group.cell[k] = cell;
    });
  });
}

// Closes the groups that are not full, after all cells have been entered.
template <class S>
void close_groups(const SortedCells<S>& sorted, BinGroup* groups) {
  for (int64_t bin = 0; bin < sorted.pose.bins; ++bin)
    for (int64_t unused = sorted.next.back()[bin]; unused < int64_t(sorted.first[bin + 1]) * kBlock; ++unused) {
      BinGroup& group = groups[unused / kBlock];
      for (int i = 0; i < 3; ++i) {
        group.lower[i][unused % kBlock] = 255;
        group.upper[i][unused % kBlock] = 0;
      }
      group.cell[unused % kBlock] = 0;
    }
}

// The numbers in the grid of the blocks' cells that are searched.
inline std::vector<int32_t> cell_numbers(const snarf_field& field, const std::vector<Block>& blocks) {
  std::vector<int32_t> numbers;
  for (const Block& block : blocks)
    for (int k = 0; k < kBlock; ++k)
      if (block.active >> k & 1)
        numbers.push_back(int32_t((int64_t(block.z) * (field.nodes[1] - 1) + block.y) * (field.nodes[0] - 1) + block.x + k));
  return numbers;
}

template <class S>
class Prepared final : public snarf_prepared {
 public:
  Prepared(const snarf_field& field, int64_t poses, const uint8_t* active, int threads)
      : threads_(threads),
        chunks_(std::max<int64_t>(1, std::min<int64_t>(kMaxChunks, (threads + poses - 1) / std::max<int64_t>(poses, 1)))),
        poses_(static_cast<size_t>(poses)) {
    const std::vector<Block> blocks = active_blocks(field, active);
    numbers_ = cell_numbers(field, blocks);
    std::vector<int64_t> first_cell(1, 0);  // of each block
    for (const Block& block : blocks) first_cell.push_back(first_cell.back() + int64_t(std::bitset<32>(block.active).count()));
    const int64_t count = int64_t(blocks.size()), cells = int64_t(numbers_.size());
    const Geometry<S> geometry = geometry_of<S>(field);
    for (auto& pose : poses_) {
      pose.count = cells;
      pose.cells.reset(new CellRecord<S>[cells]);
      pose.boxes.reset(new S[3 * cells]);
      pose.next.resize(size_t(chunks_));
    }
    Queue bounding(poses * count, 64), binning(poses, 1), counting(poses * chunks_, 1), grouping(poses, 1);
    run({[&](int) {
           for (int64_t first, last; bounding.take(first, last);)
             for (int64_t n = first; n < last; ++n) {
               SortedCells<S>& pose = poses_[n / count];
               const S* const transforms = static_cast<const S*>(field.transforms) + 12 * node_count(field) * (n / count);
               const int64_t at = first_cell[n % count];
               kernels<S>().bounds(transforms, geometry, blocks[n % count], pose.cells.get() + at, pose.boxes.get() + 3 * at);
             }
         },
         [&](int) {
           for (int64_t pose, end; binning.take(pose, end);) lay_out_bins(poses_[pose]);
         },
         [&](int) {
           for (int64_t n, end; counting.take(n, end);) count_cells(poses_[n / chunks_], n % chunks_);
         },
         [&](int) {
           for (int64_t pose, end; grouping.take(pose, end);) lay_out_groups(poses_[pose]);
         }});
    header_ = {kPreparedMark, 0, poses, cells, {}, field.bytes_per_number};
    std::copy(field.nodes, field.nodes + 3, header_.nodes);
    header_.bytes = aligned(sizeof header_) + aligned(4 * cells) + aligned(8 * poses);
    for (const auto& pose : poses_) {
      at_.push_back(header_.bytes);
      header_.bytes += pose.bytes();
    }
  }

  int64_t bytes() const override { return header_.bytes; }

  void write(char* buffer, void* boxes) override {
    Cursor to(buffer);
    to.write(&header_, 1);
    to.write(numbers_.data(), header_.cells);
    to.write(at_.data(), header_.poses);
    std::vector<BinGroup*> groups;
    std::vector<CellRecord<S>*> cells;
    for (int64_t n = 0; n < header_.poses; ++n) {
      const SortedCells<S>& pose = poses_[n];
      Cursor part(buffer + at_[n]);
      part.write(&pose.pose, 1);
      cells.push_back(part.next<CellRecord<S>>(pose.count));
      part.write(pose.first.data(), int64_t(pose.first.size()));
      groups.push_back(part.next<BinGroup>(pose.pose.groups));
      S* const box = static_cast<S*>(boxes) + 6 * n;
      std::copy(pose.pose.lower, pose.pose.lower + 3, box);
      std::copy(pose.pose.upper, pose.pose.upper + 3, box + 3);
    }
    Queue entering(header_.poses * chunks_, 1), closing(header_.poses, 1);
    run({[&](int) {
           for (int64_t n, end; entering.take(n, end);) {
             SortedCells<S>& pose = poses_[n / chunks_];
             const int64_t chunk = n % chunks_, first = pose.chunk_begin(chunk);
             std::copy(pose.cells.get() + first, pose.cells.get() + pose.chunk_begin(chunk + 1), cells[n / chunks_] + first);
             enter_cells(pose, chunk, groups[n / chunks_]);
           }
         },
         [&](int) {
           for (int64_t pose, end; closing.take(pose, end);) close_groups(poses_[pose], groups[pose]);
         }});
  }

 private:
  void run(const std::vector<std::function<void(int)>>& phases) const {
    if (!run_phases(threads_, phases)) throw std::bad_alloc();
  }

  const int threads_;
  const int64_t chunks_;  // of each pose's cells
  std::vector<SortedCells<S>> poses_;
  std::vector<int32_t> numbers_;
  PreparedHeader header_{};
  std::vector<int64_t> at_;  // place of each pose's part in the buffer
};

// Whether a buffer was made for this field and these poses.
inline bool fits(const void* buffer, int64_t bytes, const snarf_field& field, int64_t poses) {
  if (!buffer || bytes < int64_t(sizeof(PreparedHeader))) return false;
  const PreparedHeader header = header_of(static_cast<const char*>(buffer));
  return header.mark == kPreparedMark && header.bytes == bytes && header.poses == poses &&
         header.bytes_per_number == field.bytes_per_number && std::equal(field.nodes, field.nodes + 3, header.nodes);
}

// The part of the buffer that belongs to a pose, and the numbers of the cells.
inline Cursor part_of(const char* buffer, int64_t pose, const int32_t*& numbers) {
  const PreparedHeader header = header_of(buffer);
  Cursor at(const_cast<char*>(buffer));  // only read
  at.next<PreparedHeader>(1);
  numbers = at.next<int32_t>(header.cells);
  return Cursor(const_cast<char*>(buffer) + at.next<int64_t>(header.poses)[pose]);
}

// A pose of the buffer, as the kernels take it.
template <class S>
PreparedTask<S> task_of(const char* buffer, const snarf_field& field, int64_t pose) {
  PreparedTask<S> task;
  Cursor at = part_of(buffer, pose, task.number);
  task.geometry = geometry_of<S>(field);
  task.transforms = static_cast<const S*>(field.transforms) + 12 * node_count(field) * pose;
  task.pose = at.next<PreparedPose<S>>(1);
  task.cells = at.next<CellRecord<S>>(header_of(buffer).cells);
  task.first = at.next<int32_t>(task.pose->bins + 1);
  task.groups = at.next<BinGroup>(task.pose->groups);
  return task;
}

// Each thread takes some queries at a time and finds all their roots, so that it can sort them at once.
template <class S>
void prepared_search(const char* buffer, const snarf_field& field, const snarf_queries& queries, const snarf_complete& settings,
                     RootsOf<S>& out) {
  const S distance = S(kSameRoot) * smallest_side(geometry_of<S>(field));
  const int64_t total = queries.poses * queries.count;
  for (int64_t begin = 0; begin < total; begin += kGroupQueries) {
    const int64_t count = std::min(kGroupQueries, total - begin), parts = (count + kQueriesAtOnce - 1) / kQueriesAtOnce;
    const int threads = threads_for(queries, count);
    std::unique_ptr<Group<S>> group(new Group<S>());
    group->first_query = begin;
    group->lists.resize(size_t(parts));
    std::vector<std::vector<const Root<S>*>> sorted(static_cast<size_t>(parts));
    Queue queue(parts, 1);
    const auto search = [&](int64_t part) {
      std::unique_ptr<RootList<S>>& list = group->lists[part];
      list.reset(new RootList<S>());
      const int64_t start = part * kQueriesAtOnce, end = std::min(count, start + kQueriesAtOnce);
      for (int64_t first = start, last; first < end; first = last) {
        const int64_t pose = (begin + first) / queries.count;
        last = std::min(end, (pose + 1) * queries.count - begin);
        PreparedTask<S> task = task_of<S>(buffer, field, pose);
        task.points = static_cast<const S*>(queries.points) + 3 * begin;
        task.tolerance = S(settings.tolerance);
        task.max_steps = settings.max_steps;
        task.orientation_preserving = settings.orientation_preserving != 0;
        kernels<S>().search_prepared(task, first, last, list->sink());
      }
      sorted[part] = sorted_roots(*list, start, end, distance);
    };
    const bool well = run_phases(threads, {[&](int) {
                                   for (int64_t part, next; queue.take(part, next);) search(part);
                                 }});
    if (!well) throw std::bad_alloc();
    for (const auto& part : sorted) group->count += int64_t(part.size());
    group->sorted.reset(new const Root<S>*[group->count]);
    const Root<S>** to = group->sorted.get();
    for (const auto& part : sorted) to = std::copy(part.begin(), part.end(), to);
    out.groups.push_back(std::move(group));
  }
}

}  // namespace snarf
