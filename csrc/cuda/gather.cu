// The roots of a search, put in order: by query, and within a query by cell (or start) and place, without duplicates.
//
// DESIGN. One thread a query. The search left each query a list of its roots in no particular order, most often none or one.
//   collect_roots  sorts the list by insertion, takes out what neighbouring cells or several starts reported twice, and counts.
//                  Between the two kernels stands a running sum over the queries.
//   write_roots    copies the list to where the query's roots stand in the result.
// What comes out depends on the set of roots alone, not on the order in which they were found. All links are read and written
// by the query's own thread. Without room for all roots, those beyond `slots` or `capacity` are missing and `found` tells.
#include "search.cuh"

namespace snarf {
namespace SNARF_ISA {

// By all numbers of a root: several starts may report one at the same place with inverses that differ in the last bits.
template <class S>
__device__ bool comes_before(const Search<S>& a, int one, int other) {
  if (a.root_order[one] != a.root_order[other]) return a.root_order[one] < a.root_order[other];
  const S* p = a.root + 12 * (long long)one;
  const S* q = a.root + 12 * (long long)other;
  for (int i = 0; i < 12; ++i)
    if (p[i] != q[i]) return p[i] < q[i];
  return false;
}

// The two roots beside a fold may be as close as two reports of one, but differ in orientation.
template <class S>
__device__ bool is_same(const Search<S>& a, int one, int other, S distance) {
  const S* p = a.root + 12 * (long long)one;
  const S* q = a.root + 12 * (long long)other;
  return squared_distance(p, q) < distance * distance && preserves_orientation(p + 3) == preserves_orientation(q + 3);
}

extern "C" __global__ void __launch_bounds__(128) collect_roots(const Search<Number> a) {
  const long long query = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (query >= a.queries) return;
  int kept = 0;
  int slot = a.head[query];
  if (slot) {
    int* head = a.head + query;
    *head = 0;
    while (slot) {
      const int root = slot - 1;
      slot = a.root_next[root];
      int* link = head;
      while (*link && comes_before(a, *link - 1, root)) link = a.root_next + (*link - 1);
      a.root_next[root] = *link;
      *link = root + 1;
    }
    const Number distance = same_root_distance(a, grid_of(a));
    int* link = head;
    while (*link) {
      const int root = *link - 1;
      bool is_new = true;
      for (int before = *head; before != root + 1 && is_new; before = a.root_next[before - 1])
        is_new = !is_same(a, before - 1, root, distance);
      kept += is_new;
      if (is_new)
        link = a.root_next + root;
      else
        *link = a.root_next[root];
    }
  }
  a.kept[query] = kept;
}

extern "C" __global__ void __launch_bounds__(128) write_roots(const Search<Number> a) {
  const long long query = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (query == 0 && a.found) *a.found = *a.staged > a.slots ? *a.staged : a.end[a.queries - 1];
  if (query >= a.queries) return;
  long long at = query ? a.end[query - 1] : 0;
  for (int slot = a.head[query]; slot && at < a.capacity; slot = a.root_next[slot - 1], ++at) {
    const Number* root = a.root + 12 * (long long)(slot - 1);
    for (int i = 0; i < 3; ++i) a.canonical[3 * at + i] = root[i];
    for (int i = 0; i < 9; ++i) a.jacobian_inverse[9 * at + i] = root[3 + i];
    a.query[at] = query;
  }
}

}  // namespace SNARF_ISA
}  // namespace snarf
