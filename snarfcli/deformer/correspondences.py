"""The result of a correspondence search: the roots of all queries, and what users gather from them."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.utils import _pytree  # torch.export's documentation names it; there is no public module in all versions

from snarfcli.field_docs import documented

__all__ = ["Correspondences"]


@documented
@dataclass(frozen=True, repr=False, eq=False)
class Correspondences:
    """Canonical correspondences of B x N posed points: the roots of all queries in one list.

    If a capacity was given, rows beyond the roots belong to no query; they hold zeros and the query B * N. Methods that take
    one value per root ignore the values of these rows, which then get a zero gradient. A capacity that cut roots is reported
    by a UserWarning as soon as a method or `counts` or `found` is used; on a GPU only by those that wait for it (see `is_cut`).

    The methods are differentiable in the values. Under torch.compile with fullgraph=True and in torch.export they need a
    search with a capacity, and `padded` needs `slots`. The class is a pytree, whose leaves are the four tensors.
    """

    canonical: Tensor
    """[M, 3], metres; differentiable in the points, the skinning weights and the bone transforms."""
    query: Tensor
    """[M], index b * N + n of each root's query, ascending."""
    jacobian_inverse: Tensor
    """[M, 3, 3], inverse of dd/dx at each root; has no gradient."""
    batch: int
    """B, number of poses."""
    count: int
    """N, number of queries per pose."""
    total: Tensor
    """[1], number of roots found; more than M only if a capacity cut them."""
    _is_reported: ClassVar[bool] = False  # on an instance: whether a cut has been looked for

    def __repr__(self) -> str:
        return f"Correspondences({self.query.shape[0]} rows for {self.batch} x {self.count} points)"

    @property
    def pose(self) -> Tensor:
        """[M], index b of each root's pose."""
        return (self.query // max(self.count, 1)).clamp_max(max(self.batch - 1, 0))

    @property
    def found(self) -> Tensor:
        """[B, N], bool, whether each query has a correspondence."""
        self._report_cut()
        mask = torch.zeros(self.batch * self.count + 1, dtype=torch.bool, device=self.query.device)
        return self._per_query(mask.index_fill(0, self.query, True))

    @property
    def counts(self) -> Tensor:
        """[B, N], number of correspondences per query."""
        self._report_cut()
        return self._per_query(self._counts())

    @property
    def is_cut(self) -> Tensor:
        """Bool [], whether a capacity cut roots; does not wait for a GPU."""
        return (self.total > self.query.shape[0])[0]

    def unreported(self) -> Correspondences:
        """Return the same, for which no warning reports a cut: for callers who look at `is_cut` or `total` themselves."""
        same = copy.copy(self)
        object.__setattr__(same, "_is_reported", True)
        return same

    def padded(self, values: Tensor | None = None, slots: int | None = None) -> tuple[Tensor, Tensor]:
        """Return what belongs to the roots of each query side by side.

        Args:
            values: [M, ...], anything per root, such as features or `jacobian_inverse`; None for the roots, `canonical`.
            slots: I, number of roots per query to return; further ones are left out, the last first. None for the largest
                number of roots of a query, at least 1, which waits for a GPU.

        Returns:
            The values [B, N, I, ...], in the order of the roots, zero where there is none; and a mask of the roots [B, N, I].
        """
        values = self.canonical if values is None else self._checked(values)
        if slots is not None and slots < 1:
            raise ValueError(f"slots: wanted at least 1, got {slots}")
        self._report_cut(waits=slots is None)
        counts, total = self._counts(), self.batch * self.count
        if slots is None:
            slots = max(int(counts[:total].max()), 1) if total else 1
        slot = torch.arange(self.query.shape[0], device=self.query.device) - (counts.cumsum(0) - counts)[self.query]
        # One row more than slots, for what is left out.
        at = torch.where((slot < slots) & (self.query < total), self.query * slots + slot, total * slots)
        out = values.new_zeros(total * slots + 1, *values.shape[1:]).index_copy(0, at, values)[:-1]
        mask = torch.arange(slots, device=self.query.device) < counts[:-1, None]
        shape = (self.batch, self.count, slots)
        return out.reshape(*shape, *values.shape[1:]), mask.reshape(shape)

    def argmax(self, values: Tensor) -> Tensor:
        """Return the row of each query's root with the largest of `values` [M], [B, N], long; -1 for a query without a root.

        As in torch.argmax NaN counts as the largest; the first of equal ones is taken. See `gather`.
        """
        self._report_cut()
        return self._winners(values, "amax")

    def argmin(self, values: Tensor) -> Tensor:
        """Return the row of each query's root with the smallest of `values` [M]; otherwise as `argmax`, NaN included."""
        self._report_cut()
        return self._winners(values, "amin")

    def gather(self, values: Tensor, rows: Tensor, empty: float) -> Tensor:
        """Return `values` [M, ...] of the roots at `rows` [B, N] from `argmax` or `argmin`, [B, N, ...]; `empty` for row -1."""
        self._report_cut()
        values = self._checked(values)
        last = torch.cat([values, values.new_full((1, *values.shape[1:]), empty)])
        chosen = torch.where(rows < 0, values.shape[0], rows).reshape(-1)
        return last.index_select(0, chosen).reshape(*rows.shape, *values.shape[1:])

    def maximum(self, values: Tensor, empty: float) -> Tensor:
        """Return the maximum of `values` [M] over the correspondences of each query, [B, N]; `empty` if there are none.

        As in torch.amax NaN counts as the largest, and equal values share the gradient.

        Source: SNARF Eq. 9.
        """
        self._report_cut()
        return self._per_query(self._reduced(values, "amax", empty))

    def minimum(self, values: Tensor, empty: float) -> Tensor:
        """Return the minimum of `values` [M] over the correspondences of each query; otherwise as `maximum`."""
        self._report_cut()
        return self._per_query(self._reduced(values, "amin", empty))

    def blend(self, values: Tensor, sharpness: float, empty: float) -> Tensor:
        """Return the softmax-weighted mean of `values` [M] over the correspondences of each query, [B, N].

        Every root gets a gradient, and the result does not depend on how the roots were found.

        Args:
            values: [M], finite; NaN or infinity makes the result of its query NaN.
            sharpness: factor of the values before the softmax; 0 gives the mean, infinity would give the maximum.
            empty: result for a query without a correspondence.

        Source: SNARF Sec. 3.2 (after Eq. 9).
        """
        self._report_cut()
        exact = self._known(values.float() if values.dtype in (torch.float16, torch.bfloat16) else values)
        with torch.autocast(values.device.type, enabled=False):
            scores = sharpness * exact
            # One row more than queries, for the padding of a search with a capacity, which belongs to no query.
            zeros = exact.new_zeros(self.batch * self.count + 1)
            highest = zeros.scatter_reduce(0, self.query, scores.detach(), "amax", include_self=False)
            weights = (scores - highest[self.query]).exp()
            norm = zeros.index_add(0, self.query, weights)
            mean = zeros.index_add(0, self.query, weights * exact) / norm.clamp_min(1e-12)
        return self._per_query(torch.where(self._counts() > 0, mean, empty).to(values.dtype))

    def _checked(self, values: Tensor) -> Tensor:
        """Return values [M, ...], or raise ValueError if there is not one for each root."""
        if not values.ndim or values.shape[0] != self.query.shape[0]:
            raise ValueError(f"values: wanted shape [{self.query.shape[0]}, ...], one per root, got {list(values.shape)}")
        return values

    def _known(self, values: Tensor) -> Tensor:
        """Return values [M] with zeros in rows beyond the roots, where NaN would make a gradient of NaN."""
        if values.ndim != 1 or values.shape[0] != self.query.shape[0]:
            raise ValueError(f"values: wanted shape [{self.query.shape[0]}], one per root, got {list(values.shape)}")
        return torch.where(self.query < self.batch * self.count, values, 0)

    def _per_query(self, values: Tensor) -> Tensor:
        """Return values [B * N + 1] as [B, N], without the last, which is that of rows beyond the roots."""
        return values[:-1].reshape(self.batch, self.count)

    def _counts(self) -> Tensor:
        """Return the number of roots per query, [B * N + 1]."""
        zeros = self.query.new_zeros(self.batch * self.count + 1)
        return zeros.index_add(0, self.query, torch.ones_like(self.query))

    def _reduced(self, values: Tensor, reduction: str, empty: float) -> Tensor:
        """Return the largest ("amax") or smallest ("amin") of `values` [M] per query, [B * N + 1]."""
        out = values.new_full((self.batch * self.count + 1,), empty)
        return out.scatter_reduce(0, self.query, self._known(values), reduction, include_self=False)

    def _winners(self, values: Tensor, reduction: str) -> Tensor:
        """Return the first row of each query that has the largest ("amax") or smallest ("amin") of `values` [M], [B, N]."""
        values = values.detach()
        best = self._reduced(values, reduction, 0)[self.query]
        count = self.query.shape[0]
        rows = torch.arange(count, device=self.query.device)
        rows = torch.where((values == best) | values.isnan(), rows, count)
        first = self.query.new_full((self.batch * self.count + 1,), count).scatter_reduce(0, self.query, rows, "amin")
        return self._per_query(torch.where(first < count, first, -1))

    def _report_cut(self, waits: bool = False) -> None:
        """Warn once if a capacity cut roots; where reading would wait for a GPU, only if the caller waits for it anyway."""
        if self._is_reported or torch.compiler.is_compiling() or (_reading_waits(self.total) and not waits):
            return
        object.__setattr__(self, "_is_reported", True)
        try:
            total = int(self.total)
        except RuntimeError:  # values cannot be read inside torch.vmap, and shapes alone have none
            return
        if total > self.query.shape[0]:
            text = f"capacity: wanted at least {total} for all roots, got {self.query.shape[0]}; the others are left out"
            warnings.warn(text, stacklevel=3)  # at the caller of the method


def _reading_waits(tensor: Tensor) -> bool:
    """Return whether reading the values of a tensor would wait for a device."""
    return tensor.device.type != "cpu"


_LEAVES = tuple(field.name for field in fields(Correspondences) if field.name not in ("batch", "count"))


def _flatten(found: Correspondences) -> tuple[list[Tensor], tuple[int, int]]:
    return [getattr(found, name) for name in _LEAVES], (found.batch, found.count)


def _flatten_with_keys(found: Correspondences) -> tuple[list[tuple[Any, Tensor]], tuple[int, int]]:
    leaves, context = _flatten(found)
    return [(_pytree.GetAttrKey(name), leaf) for name, leaf in zip(_LEAVES, leaves, strict=True)], context


def _unflatten(leaves: Iterable[Any], context: tuple[int, int]) -> Correspondences:
    batch, count = context
    return Correspondences(**dict(zip(_LEAVES, leaves, strict=True)), batch=batch, count=count)


_pytree.register_pytree_node(
    Correspondences,
    _flatten,
    _unflatten,
    serialized_type_name="snarfcli.deformer.Correspondences",
    to_dumpable_context=list,
    from_dumpable_context=lambda context: (int(context[0]), int(context[1])),
    flatten_with_keys_fn=_flatten_with_keys,
)
