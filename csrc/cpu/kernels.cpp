// The inner loops of the CPU library, compiled once per instruction set with SNARF_ISA naming it.
//
// DESIGN. Cell by cell, not query by query. A block of cells side by side is turned into polynomials with one lane per cell
// (cell.h); then each cell fetches the queries of the bins that its posed box touches, tests them with one lane per query, and
// solves for the survivors with one lane per query and the cell's coefficients as broadcast scalars: no gathers from the grid.
// A cell that may hold several roots of one query is cut into eight parts, each of which fetches from its parent's candidates.
#include "kernels.h"

#include "bins.h"
#include "cell_lanes.h"
#include "lanes.h"
#include "pair_search.h"
#include "snarf/broyden.h"
#include "snarf/cell.h"
#include "snarf/implicit.h"
#include "snarf/newton.h"
#include "snarf/search.h"

namespace snarf {
namespace SNARF_ISA {
namespace {

// One cell or part of a cell, ready to be searched.
template <class S>
struct Part {
  S c[3 * kMonomials];
  S box[3], inverse[9], reach[3], curvature;
  S shift[3], scale;  // its centre and side within the cell, cell coordinates
  int level;
};

template <class S>
struct Search {
  const CompleteTask<S>& task;
  Scratch<S>& scratch;
  RootSink<S>& sink;
  S centre[3];  // canonical centre of the cell
  int32_t cell;
};

// The grid as the type of the shared mathematics, in the namespace of this instruction set.
template <class S>
Grid<S> grid_of(const Geometry<S>& geometry) {
  Grid<S> grid;
  for (int i = 0; i < 3; ++i) {
    grid.lower[i] = geometry.lower[i];
    grid.size[i] = geometry.size[i];
    grid.nodes[i] = geometry.nodes[i];
  }
  return grid;
}

// Numbers that repeat with the period of x, y, z over three packs of lanes, as `points` [N, 3] do.
template <class S>
void spread(const S* xyz, Lanes<S>* out) {
  constexpr int width = Lanes<S>::width;
  S values[3 * width];
  for (int k = 0; k < 3 * width; ++k) values[k] = xyz[k % 3];
  for (int i = 0; i < 3; ++i) out[i] = load<S>(values + i * width);
}

template <class S>
void extent(const S* points, int64_t count, S* lower, S* upper) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  V low[3], high[3];
  spread(lower, low);
  spread(upper, high);
  int64_t n = 0;
  for (; n + width <= count; n += width)
    for (int i = 0; i < 3; ++i) {
      const V value = load<S>(points + 3 * n + i * width);
      low[i] = select(value < low[i], value, low[i]);
      high[i] = select(value > high[i], value, high[i]);
    }
  const auto widen = [&](int axis, S least, S most) {
    if (least < lower[axis]) lower[axis] = least;
    if (most > upper[axis]) upper[axis] = most;
  };
  for (int k = 0; k < 3 * width; ++k) widen(k % 3, low[k / width][k % width], high[k / width][k % width]);
  for (; n < count; ++n)
    for (int i = 0; i < 3; ++i) widen(i, points[3 * n + i], points[3 * n + i]);
}

template <class S>
void bins(const SortedQueries<S>& queries, const S* points, int64_t count, int32_t* bin) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  const S per_metre[3] = {queries.per_metre, queries.per_metre, queries.per_metre};
  // Products of bins and strides stay below 2^24, where a float still holds every integer.
  const S last[3] = {S(queries.bins[0] - 1), S(queries.bins[1] - 1), S(queries.bins[2] - 1)};
  const S stride[3] = {S(1), S(queries.bins[0]), S(queries.bins[0]) * S(queries.bins[1])};
  const V outside = V(S(-1e9)), zero = V(S(0));
  V lower[3], upper[3], scale[3], most[3], by[3];
  spread(queries.lower, lower);
  spread(queries.upper, upper);
  spread(per_metre, scale);
  spread(last, most);
  spread(stride, by);
  for (int64_t n = 0; n < count; n += width) {
    const int here = count - n < width ? int(count - n) : width;
    S part[3 * width];
    if (here < width) {
      for (int k = 0; k < 3 * width; ++k) part[k] = k < 3 * here ? points[3 * n + k] : queries.lower[0];
    }
    const S* const from = here < width ? part : points + 3 * n;
    V share[3];
    for (int i = 0; i < 3; ++i) {
      const V value = load<S>(from + i * width);
      const V at = truncate(smaller(larger((value - lower[i]) * scale[i], zero), most[i]));
      share[i] = select((value >= lower[i]) & (value <= upper[i]), at * by[i], outside);
    }
    for (int i = 0; i < 3; ++i) store(part + i * width, share[i]);
    for (int k = 0; k < here; ++k) {
      const S sum = part[3 * k] + part[3 * k + 1] + part[3 * k + 2];
      bin[n + k] = sum < 0 ? -1 : int32_t(sum);
    }
  }
}

template <class S>
void boxes(const S* transforms, const Geometry<S>& geometry, const Block& block, BlockBoxes<S>& out) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  for (int first = 0; first < kBlock; first += width) {
    const uint32_t active = block.active >> first & ((1u << width) - 1);
    for (int i = 0; i < 3; ++i)
      for (int k = first; k < first + width; ++k) {
        out.lower[i][k] = S(1);
        out.upper[i][k] = S(-1);
      }
    if (!active) continue;
    Cell<V> cells;
    V box[3];
    load_cells(transforms, geometry, block.x + first, block.y, block.z, cells);
    bound_box<V, S>(cells, box);
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < width; ++k) {
        const S centre = cells.c[kMonomials * i][k], extent = box[i][k];
        const bool usable = extent < S(1e15) && centre - centre == 0;  // non-finite or absurd transforms give no root
        if (!(active >> k & 1) || !usable) continue;
        out.lower[i][first + k] = centre - extent;
        out.upper[i][first + k] = centre + extent;
      }
  }
}

template <class S>
void pick(const CellLanes<S>& from, int lane, Part<S>& part) {
  for (int m = 0; m < 3 * kMonomials; ++m) part.c[m] = from.cell.c[m][lane];
  for (int i = 0; i < 9; ++i) part.inverse[i] = from.bounds.inverse[i][lane];
  for (int i = 0; i < 3; ++i) {
    part.box[i] = from.bounds.box[i][lane];
    part.reach[i] = from.bounds.reach[i][lane];
  }
  part.curvature = from.bounds.curvature[lane];
}

// The part's bounds, broadcast once for many queries.
template <class S>
struct Test {
  using V = Lanes<S>;
  V centre[3], box[3], inverse[9], reach[3];
  explicit Test(const Part<S>& part) {
    for (int i = 0; i < 3; ++i) {
      centre[i] = V(part.c[kMonomials * i]);
      box[i] = V(part.box[i]);
      reach[i] = V(part.reach[i]);
    }
    for (int i = 0; i < 9; ++i) inverse[i] = V(part.inverse[i]);
  }
  SNARF_HD LaneMask<S> operator()(V x, V y, V z) const {
    const V offset[3] = {x - centre[0], y - centre[1], z - centre[2]};
    return may_hold(box, inverse, reach, offset);
  }
};

template <class S>
void emit(Search<S>& search, const Part<S>& part, const int32_t* queries, uint32_t found, const Lanes<S>* s,
          const Lanes<S>* inverse) {
  const Geometry<S>& geometry = search.task.geometry;
  for (; found; found &= found - 1) {
    const int lane = lowest_bit(found);
    if (search.sink.next == search.sink.end) search.sink.more(&search.sink);
    Root<S>& root = *search.sink.next;
    root.query = queries[lane];
    root.order = search.cell;
    for (int i = 0; i < 3; ++i) {
      root.canonical[i] = search.centre[i] + geometry.size[i] * (part.shift[i] + part.scale * s[i][lane]);
      for (int j = 0; j < 3; ++j) root.inverse[3 * i + j] = inverse[3 * i + j][lane] * (geometry.size[i] * part.scale);
    }
    S minors[9];
    if (!search.task.orientation_preserving || adjugate(root.inverse, minors) > 0) ++search.sink.next;
  }
}

// Newton's method for `count` candidates of a part, which stand at `begin` in the scratch lists. `start` is one of kStarts.
template <class S>
void solve(Search<S>& search, const Part<S>& part, int64_t begin, int64_t count, int start) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  const Solver<S> solver{search.task.tolerance, search.task.max_steps};
  const S reach = S(0.5) + face_tolerance<S>() / part.scale;
  for (int64_t first = begin; first < begin + count; first += width) {
    const int here = begin + count - first < width ? int(begin + count - first) : width;
    V offset[3], s[3], inverse[9];
    for (int i = 0; i < 3; ++i) offset[i] = load<S>(search.scratch.at[i] + first) - part.c[kMonomials * i];
    for (int i = 0; i < 3; ++i) {
      if (start == kAffineStart) {
        const V guess =
            offset[0] * part.inverse[3 * i] + offset[1] * part.inverse[3 * i + 1] + offset[2] * part.inverse[3 * i + 2];
        s[i] = smaller(larger(guess, V(S(-0.5))), V(S(0.5)));
      } else {
        s[i] = V(start == kCentreStart ? S(0) : start >> i & 1 ? S(0.5) : S(-0.5));
      }
    }
    for (int i = 0; i < 9; ++i) inverse[i] = V(S(0));
    const LaneMask<S> found = solve_in_cell(part.c, offset, first_lanes<S>(here), solver, reach, s, inverse);
    emit(search, part, search.scratch.query + first, bits(found), s, inverse);
  }
}

// Appends the lanes in `inside` of the candidates at x, y, z to the scratch lists; returns the new end.
template <class S>
SNARF_HD int64_t append(Scratch<S>& scratch, int64_t end, uint32_t inside, const S* x, const S* y, const S* z,
                        const int32_t* query) {
  for (; inside; inside &= inside - 1, ++end) {
    const int lane = lowest_bit(inside);
    scratch.at[0][end] = x[lane];
    scratch.at[1][end] = y[lane];
    scratch.at[2][end] = z[lane];
    scratch.query[end] = query[lane];
  }
  return end;
}

// Finds the roots in a part for `count` candidates, which stand at `begin` in the scratch lists; what follows them is free.
template <class S>
void search_part(Search<S>& search, const Part<S>& part, int64_t begin, int64_t count) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  if (part.curvature < S(kTame)) return solve(search, part, begin, count, kAffineStart);
  if (part.level == kLevels) {
    for (int start = 0; start < kStarts; ++start) solve(search, part, begin, count, start);
    return;
  }
  Scratch<S>& scratch = search.scratch;
  const int64_t masks = begin + count, end = begin + 2 * count;
  scratch.reserve(&scratch, begin + 3 * count);
  CellLanes<S> parts;
  for (int eighth = 0; eighth < 8; eighth += width) {
    V shift[3];
    for (int i = 0; i < 3; ++i) {
      S values[width];
      for (int k = 0; k < width; ++k) values[k] = (eighth + k) >> i & 1 ? S(0.25) : S(-0.25);
      shift[i] = load<S>(values);
    }
    Cell<V> whole;
    for (int m = 0; m < 3 * kMonomials; ++m) whole.c[m] = V(part.c[m]);
    halve_cell<V, S>(whole, shift, parts.cell);
    bound_cell<V, S>(parts.cell, parts.bounds, S(0.5) + face_tolerance<S>() * S(2) / part.scale);
    // Which eighths may hold a root of a candidate, one lane per eighth.
    uint32_t some = 0;
    for (int64_t i = 0; i < count; ++i) {
      V offset[3];
      for (int axis = 0; axis < 3; ++axis) offset[axis] = V(scratch.at[axis][begin + i]) - parts.cell.c[kMonomials * axis];
      const uint32_t may = bits(may_hold(parts.bounds.box, parts.bounds.inverse, parts.bounds.reach, offset)) & 255;
      scratch.query[masks + i] = int32_t(may);
      some |= may;
    }
    for (int lane = 0; lane < width && eighth + lane < 8; ++lane) {
      if (!(some >> lane & 1)) continue;
      Part<S> child;
      pick(parts, lane, child);
      child.level = part.level + 1;
      child.scale = part.scale * S(0.5);
      for (int i = 0; i < 3; ++i) child.shift[i] = part.shift[i] + part.scale * shift[i][lane];
      int64_t kept = end;
      for (int64_t i = 0; i < count; ++i) {
        if (!(scratch.query[masks + i] >> lane & 1)) continue;
        for (int axis = 0; axis < 3; ++axis) scratch.at[axis][kept] = scratch.at[axis][begin + i];
        scratch.query[kept++] = scratch.query[begin + i];
      }
      search_part(search, child, end, kept - end);
    }
  }
}

template <class S>
void search(const CompleteTask<S>& task, const Block& block, const BlockBoxes<S>& boxes, Scratch<S>& scratch,
            RootSink<S>& sink) {
  using V = Lanes<S>;
  constexpr int width = V::width;
  const SortedQueries<S>& queries = task.queries;
  for (int first = 0; first < kBlock; first += width) {
    if (!(block.active >> first & ((1u << width) - 1))) continue;
    CellLanes<S> cells;
    bool loaded = false;
    for (int lane = 0; lane < width; ++lane) {
      const int k = first + lane;
      int64_t near = 0;
      each_bin_row(queries, boxes, k, [&](int64_t row, int64_t end) { near += queries.begin[end] - queries.begin[row]; });
      if (!near) continue;
      if (!loaded) {
        load_cells(task.transforms, task.geometry, block.x + first, block.y, block.z, cells.cell);
        bound_cell<V, S>(cells.cell, cells.bounds);
        loaded = true;
      }
      scratch.reserve(&scratch, near);
      Part<S> part;
      pick(cells, lane, part);
      part.level = 0;
      part.scale = 1;
      part.shift[0] = part.shift[1] = part.shift[2] = 0;
      const Test<S> test(part);
      int64_t kept = 0;
      each_bin_row(queries, boxes, k, [&](int64_t row, int64_t end) {
        const int32_t last = queries.begin[end];
        for (int32_t i = queries.begin[row]; i < last; i += width) {
          const S *const px = queries.at[0] + i, *const py = queries.at[1] + i, *const pz = queries.at[2] + i;
          uint32_t inside = bits(test(load<S>(px), load<S>(py), load<S>(pz)));
          if (last - i < width) inside &= (1u << (last - i)) - 1;
          kept = append(scratch, kept, inside, px, py, pz, queries.query + i);
        }
      });
      if (!kept) continue;
      const int32_t x = block.x + k;
      Search<S> here{task, scratch, sink, {}, 0};
      here.cell = int32_t((int64_t(block.z) * (task.geometry.nodes[1] - 1) + block.y) * (task.geometry.nodes[0] - 1) + x);
      const int32_t index[3] = {x, block.y, block.z};
      for (int i = 0; i < 3; ++i) here.centre[i] = task.geometry.lower[i] + (S(index[i]) + S(0.5)) * task.geometry.size[i];
      search_part(here, part, 0, kept);
    }
  }
}

template <class S>
void broyden_queries(const BroydenTask<S>& task, int64_t first, int64_t last, RootSink<S>& sink) {
  const Grid<S> grid = grid_of(task.geometry);
  const Broyden<S> settings{task.tolerance, task.divergence, task.max_steps, task.exact_jacobian};
  for (int64_t n = first; n < last; ++n) {
    const S* target = task.points + 3 * n;
    if (!(target[0] - target[0] == 0 && target[1] - target[1] == 0 && target[2] - target[2] == 0)) continue;
    S known[3 * 64];  // roots of this query so far; more than 64 distinct ones would only be reported twice
    int roots = 0;
    for (int64_t start = 0; start < task.count; ++start) {
      S x[3], inverse[9], minors[9];
      if (task.starts_are_points)
        memcpy(x, task.starts + 3 * (n * task.count + start), sizeof(x));
      else
        start_from(task.starts + 12 * start, target, x);
      if (!(x[0] - x[0] == 0 && x[1] - x[1] == 0 && x[2] - x[2] == 0)) continue;
      if (!broyden(task.transforms, grid, settings, target, x, inverse)) continue;
      bool is_new = true;
      for (int k = 0; k < roots; ++k) {
        S distance2 = 0;
        for (int i = 0; i < 3; ++i) distance2 += (x[i] - known[3 * k + i]) * (x[i] - known[3 * k + i]);
        if (distance2 < task.same_root * task.same_root) is_new = false;
      }
      if (!is_new || (task.orientation_preserving && !(adjugate(inverse, minors) > 0))) continue;
      if (roots < 64) {
        for (int i = 0; i < 3; ++i) known[3 * roots + i] = x[i];
        ++roots;
      }
      if (sink.next == sink.end) sink.more(&sink);
      Root<S>& root = *sink.next++;
      root.query = int32_t(n);
      root.order = int32_t(start);
      for (int i = 0; i < 3; ++i) root.canonical[i] = x[i];
      for (int i = 0; i < 9; ++i) root.inverse[i] = inverse[i];
    }
  }
}

// Twelve numbers as packs of lanes; what lies in the lanes beyond is read from behind them unless they are the last.
template <class S>
struct Row {
  static constexpr int packs = (12 + Lanes<S>::width - 1) / Lanes<S>::width;
  Lanes<S> pack[packs];

  static Row load_from(const S* at, bool is_last) {
    S copy[kRow];
    if (is_last) {
      for (int r = 0; r < kRow; ++r) copy[r] = r < 12 ? at[r] : S(0);
      at = copy;
    }
    Row row;
    for (int k = 0; k < packs; ++k) row.pack[k] = load<S>(at + k * Lanes<S>::width);
    return row;
  }

  void store_to(S* at, bool is_last) const {
    S copy[kRow];
    S* const to = is_last ? copy : at;
    for (int k = 0; k < packs; ++k) store(to + k * Lanes<S>::width, pack[k]);
    if (is_last)
      for (int r = 0; r < 12; ++r) at[r] = copy[r];
  }
};

template <class S>
void blend(const BlendTask<S>& task, S* transforms) {
  for (int64_t pose = 0; pose < task.poses; ++pose) {
    const S* const rows = task.rows + pose * task.bones * kRow;
    S* const out = transforms + 12 * pose * task.nodes;
    for (int64_t n = task.first; n < task.last; ++n) {
      Row<S> sum;
      for (auto& pack : sum.pack) pack = Lanes<S>(S(0));
      if (!task.used || task.used[n]) {
        const S* const weights = task.weights + n * task.bones;
        for (int64_t j = 0; j < task.bones; ++j)
          for (int k = 0; k < Row<S>::packs; ++k)
            sum.pack[k] = sum.pack[k] + load<S>(rows + j * kRow + k * Lanes<S>::width) * weights[j];
      }
      // The lanes beyond the twelve are overwritten by the next node, except at the end of what this thread may write.
      sum.store_to(out + 12 * n, n + 1 == task.last);
    }
  }
}

template <class S>
void blend_weights(const BlendTask<S>& task, const S* gradient, S* row, S* v_weights) {
  constexpr int width = Lanes<S>::width;
  for (int64_t n = task.first; n < task.last; ++n) {
    S* const out = v_weights + n * task.bones;
    if (task.used && !task.used[n]) {
      for (int64_t j = 0; j < task.bones; ++j) out[j] = S(0);
      continue;
    }
    for (int64_t j = 0; j < task.columns; j += width) {
      Lanes<S> sum = Lanes<S>(S(0));
      for (int64_t pose = 0; pose < task.poses; ++pose) {
        const S* const g = gradient + 12 * (pose * task.nodes + n);
        const S* const rows = task.rows + pose * 12 * task.columns + j;
        for (int r = 0; r < 12; ++r) sum = sum + load<S>(rows + r * task.columns) * g[r];
      }
      store(row + j, sum);
    }
    memcpy(out, row, size_t(task.bones) * sizeof(S));
  }
}

template <class S>
void blend_bones(const BlendTask<S>& task, const S* gradient, S* v_rows) {
  for (int64_t pose = 0; pose < task.poses; ++pose)
    for (int64_t n = task.first; n < task.last; ++n) {
      if (task.used && !task.used[n]) continue;
      const Row<S> g = Row<S>::load_from(gradient + 12 * (pose * task.nodes + n), n + 1 == task.nodes);
      for (int64_t j = 0; j < task.bones; ++j) {
        S* const out = v_rows + (pose * task.bones + j) * kRow;
        const S weight = task.weights[n * task.bones + j];
        for (int k = 0; k < Row<S>::packs; ++k)
          store(out + k * Lanes<S>::width, load<S>(out + k * Lanes<S>::width) + g.pack[k] * weight);
      }
    }
}

template <class S>
void backward(const BackwardTask<S>& task) {
  const Grid<S> grid = grid_of(task.geometry);
  const int64_t layer = int64_t(grid.nodes[0]) * grid.nodes[1];
  for (int64_t m = 0; m < task.roots; ++m) {
    const S* x = task.canonical + 3 * m;
    S local[3], v[3];
    const int64_t first = locate(grid, x, local);
    const int64_t z = first / layer;
    if (task.v_transforms && (z + 1 < task.layers[0] || z >= task.layers[1])) continue;
    pull_back(task.inverse + 9 * m, task.gradient + 3 * m, v);
    if (task.v_points)
      for (int i = 0; i < 3; ++i) task.v_points[3 * (task.query[m] - task.first_query) + i] += v[i];
    if (!task.v_transforms) continue;
    S weights[8], gradient[12];
    corner_weights(local, weights);
    transform_gradient(v, x, gradient);
    for (int k = 0; k < 8; ++k) {
      const int64_t owner = z + (k >> 2);
      if (owner < task.layers[0] || owner >= task.layers[1]) continue;
      S* node = task.v_transforms + 12 * corner_node(grid, first, k);
      for (int r = 0; r < 12; ++r) node[r] += weights[k] * gradient[r];
    }
  }
}

}  // namespace

template <class S>
Kernels<S> kernels() {
  return {blend<S>,  blend_weights<S>, blend_bones<S>,     extent<S>,          bins<S>,    boxes<S>,
          search<S>, bounds<S>,        search_prepared<S>, broyden_queries<S>, backward<S>};
}
template Kernels<float> kernels<float>();
template Kernels<double> kernels<double>();

}  // namespace SNARF_ISA
}  // namespace snarf
