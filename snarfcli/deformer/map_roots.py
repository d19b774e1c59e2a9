"""Broyden's method on any differentiable forward map: its roots without duplicates, and their implicit gradient."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.inference_tensors import NormalTensors
from snarfcli.deformer.search_config import SearchConfig
from snarfcli.deformer.second_derivatives import differentiable_once
from snarfcli.precision import matmul_precision

__all__ = ["MapSettings", "PosedMap", "search_map"]

_SAME_ROOT = 50.0  # times the tolerance: a root is only as exact as the tolerance times how much J^-1 stretches it
_POLISH = 20.0  # times the tolerance: a last step this short leaves the Jacobian as it is


class PosedMap:
    """A forward map in one pose, from canonical points [K, 3] to posed ones [K, 3]; each row on its own, metres."""

    def __call__(self, x: Tensor) -> Tensor:
        """Return the posed points [K, 3] of canonical points [K, 3]."""
        raise NotImplementedError

    def with_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posed points [K, 3] and the exact Jacobian [K, 3, 3], row by row through autograd."""
        rows: list[Tensor | None] = [None]
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            posed = self(x)
            if posed.requires_grad:
                rows = [torch.autograd.grad(posed[:, i].sum(), x, retain_graph=i < 2, allow_unused=True)[0] for i in range(3)]
        known = [row for row in rows if row is not None]
        if len(known) < 3:
            raise ValueError("forward: wanted a result that is differentiable by the canonical points, got one that is not")
        return posed.detach(), torch.stack(known, 1)

    def at_start(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posed points [K, 3] and the Jacobian [K, 3, 3] that the iteration starts with."""
        return self.with_jacobian(x)


@dataclass(frozen=True)
class MapSettings:
    """Settings of one search, lengths in metres."""

    box: CanonicalGrid | None
    """Box to which iterates are clamped, if any."""
    tolerance: float
    divergence: float
    max_steps: int
    exact_at_roots: bool
    orientation_preserving: bool
    points_at_once: int
    """Maximum number of iterates, and of roots, per evaluation of the map."""

    @classmethod
    def of(cls, search: SearchConfig, box: CanonicalGrid | None, length: float, points_at_once: int) -> MapSettings:
        """Return the settings for shares of `length`, metres.

        Raises:
            ValueError: `points_at_once` is less than 1.
        """
        if points_at_once < 1:
            raise ValueError(f"points_at_once: wanted at least 1, got {points_at_once}")
        return cls(
            box=box,
            tolerance=search.tolerance * length,
            divergence=search.divergence * length,
            max_steps=search.max_steps,
            exact_at_roots=search.jacobian == "exact",
            orientation_preserving=search.orientation_preserving,
            points_at_once=points_at_once,
        )

    def bounded(self, x: Tensor) -> Tensor:
        """Return points [K, 3] clamped to the box, if there is one."""
        return x if self.box is None else x.clamp(self.box.lower, self.box.upper)


def search_map(
    points: Tensor,
    at_pose: Callable[[int], PosedMap],
    starts: Callable[[int, slice], Tensor],
    start_count: int,
    settings: MapSettings,
) -> Correspondences:
    """Find the roots of a forward map, differentiable in the points and in everything that the map depends on.

    Args:
        points: [B, N, 3], queries, posed space, metres. A non-finite point has no correspondence.
        at_pose: the map in pose b.
        starts: the starts [n, I, 3] of some queries of pose b, canonical, metres. One that is not finite is no start.
        start_count: I.
        settings: of the search.

    Returns:
        The correspondences without duplicates, those of a query in the order of the starts.
    """
    device = points.device
    # The derivative by the point needs autograd even where the caller has switched it off; inference tensors have none.
    normal = NormalTensors() if torch.is_inference_mode_enabled() else nullcontext()
    full_precision = torch.autocast(device.type, enabled=False)
    with torch.inference_mode(False), torch.no_grad(), normal, full_precision, matmul_precision("highest"):
        still = points.detach().clone()
        parts = [(still.new_empty(0, 3), torch.empty(0, dtype=torch.long, device=device), still.new_empty(0, 3, 3))]
        each = max(1, settings.points_at_once // max(start_count, 1))
        for b in range(points.shape[0]):
            posed_map = at_pose(b)
            for first in range(0, points.shape[1] if start_count else 0, each):
                some = slice(first, first + each)
                x, query, inverse = _search(posed_map, still[b, some], starts(b, some), settings)
                parts.append((x, query + (b * points.shape[1] + first), inverse))
        canonical, query, inverse = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
    with full_precision, matmul_precision("highest"):
        canonical = _attach_gradient(points, at_pose, canonical, query, inverse, settings.points_at_once)
    total = torch.tensor([len(query)], device=device)
    return Correspondences(canonical, query, inverse, points.shape[0], points.shape[1], total)


def _search(posed_map: PosedMap, queries: Tensor, starts: Tensor, settings: MapSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Find the roots of queries [N, 3] of one pose from starts [N, I, 3]; return roots, their queries and J^-1."""
    query, number = (queries.isfinite().all(1)[:, None] & starts.isfinite().all(2)).nonzero(as_tuple=True)
    distance = _SAME_ROOT * settings.tolerance
    found = _unique(*_iterate(posed_map, queries, query, starts[query, number], settings), distance)
    return _unique(*_finish(posed_map, queries, *found, settings), distance)


def _iterate(
    posed_map: PosedMap, points: Tensor, query: Tensor, x: Tensor, settings: MapSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Run Broyden's method for each pair of query [S] and start [S, 3]; return roots, their queries and J^-1, by start."""
    x = settings.bounded(x)
    if not len(x):
        return x, query, x.new_empty(0, 3, 3)
    posed, matrix = posed_map.at_start(x)
    inverse = torch.linalg.inv_ex(matrix)[0].nan_to_num(0, 0, 0)
    residual = posed - points[query]
    start = torch.arange(len(query), device=query.device)
    found = []
    for step_number in range(settings.max_steps + 1):
        distance = residual.norm(dim=1)
        converged = distance < settings.tolerance
        done = converged.nonzero()[:, 0]
        found.append((x[done], query[done], inverse[done], start[done]))
        limit = settings.divergence if step_number else torch.inf  # as SNARF does, the start itself is not judged
        going = (~converged & (distance < limit)).nonzero()[:, 0]
        if step_number == settings.max_steps or not len(going):
            break
        query, x, residual, inverse, start = query[going], x[going], residual[going], inverse[going], start[going]
        moved = settings.bounded(x - torch.bmm(inverse, residual[:, :, None])[:, :, 0])
        step, x = moved - x, moved
        change = posed_map(x) - points[query] - residual
        residual = residual + change
        # Rank-one update of the inverse (Broyden 1965, "good" method by Sherman and Morrison).
        towards = torch.bmm(inverse, change[:, :, None])
        scale = torch.bmm(step[:, None], towards)
        update = (step[:, :, None] - towards) @ torch.bmm(step[:, None], inverse) / scale
        inverse = inverse + torch.where(scale.abs() > 1e-20, update, 0.0)
    x, query, inverse, start = (torch.cat(pieces) for pieces in zip(*found, strict=True))
    order = start.argsort()
    return x[order], query[order], inverse[order]


def _finish(
    posed_map: PosedMap, points: Tensor, x: Tensor, query: Tensor, inverse: Tensor, settings: MapSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Replace the approximate inverse Jacobians by exact ones, and polish the roots with one short Newton step.

    A root on a fold, where the Jacobian has no inverse, has no gradient either and is dropped.
    """
    if not (settings.exact_at_roots or settings.orientation_preserving) or not len(x):
        return x, query, inverse
    posed, matrix = posed_map.with_jacobian(x)
    at_root = torch.linalg.inv_ex(matrix)[0]
    keep = at_root.isfinite().all(2).all(1)
    if settings.orientation_preserving:
        keep &= torch.linalg.det(matrix) > 0
    if settings.exact_at_roots:
        step = torch.bmm(at_root, (posed - points[query])[:, :, None])[:, :, 0]
        x = torch.where(step.norm(dim=1, keepdim=True) < _POLISH * settings.tolerance, x - step, x)
        x = settings.bounded(x)
        inverse = at_root
    return x[keep], query[keep], inverse[keep]


def _unique(x: Tensor, query: Tensor, inverse: Tensor, distance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Keep the first of those roots of a query (in a row) that lie closer together than `distance`, metres."""
    keep = torch.ones(len(query), dtype=torch.bool, device=query.device)
    for k in range(1, len(query)):  # roots of one query stand side by side: comparing each with the k-th before it meets all
        same = query[k:] == query[:-k]
        if not bool(same.any()):
            break
        close = (x[k:] - x[:-k]).norm(dim=1) < distance
        keep[k:] &= ~(same & close & keep[:-k])
    return x[keep], query[keep], inverse[keep]


def _attach_gradient(
    points: Tensor, at_pose: Callable[[int], PosedMap], canonical: Tensor, query: Tensor, inverse: Tensor, at_once: int
) -> Tensor:
    """Return the roots [M, 3] with the implicit gradient to queries and all that the map depends on."""
    if not torch.is_grad_enabled():
        return canonical
    batch, count = points.shape[:2]
    per_pose = torch.bincount(query // max(count, 1), minlength=batch).tolist()
    parts, first = [], 0
    for b, many in enumerate(per_pose):
        posed_map = at_pose(b)
        for x in canonical[first : first + many].split(at_once):
            # More roots than fit at once: the map's intermediate results are computed again in the backward pass.
            whole = len(canonical) <= at_once
            parts.append(posed_map(x) if whole else checkpoint(posed_map, x, use_reentrant=False))
        first += many
    posed = torch.cat(parts) if parts else canonical
    queries = points.reshape(-1, 3).index_select(0, query)
    if not (posed.requires_grad or queries.requires_grad):
        return canonical
    return _ImplicitRoots.apply(posed, queries, canonical, inverse)


class _ImplicitRoots(torch.autograd.Function):
    """Derivative of the roots of d(x; theta) = x' by d at fixed x and by x': -J^-T g and J^-T g (SNARF Eq. 14)."""

    @staticmethod
    def forward(ctx, posed, queries, canonical, jacobian_inverse):
        roots = canonical.clone()
        ctx.save_for_backward(jacobian_inverse, roots)  # the roots, since J^-1 depends on them
        return roots

    @staticmethod
    @differentiable_once
    def backward(ctx, gradient):
        jacobian_inverse, _ = ctx.saved_tensors
        with matmul_precision("highest"):
            pulled = torch.bmm(jacobian_inverse.transpose(1, 2), gradient[:, :, None])[:, :, 0]
        return -pulled, pulled, None, None
