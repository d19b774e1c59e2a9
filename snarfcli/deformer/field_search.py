"""SNARF's correspondence search on any weight field: Broyden's method with the field itself inside the iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.search_config import SearchConfig, as_search_config, check_search_config
from snarfcli.precision import matmul_precision

__all__ = ["find_correspondences_on_field"]

_SAME_ROOT = 50.0  # times the tolerance: a root is only as exact as the tolerance times how much J^-1 stretches it
_POLISH = 20.0  # times the tolerance: a last step this short leaves the Jacobian as it is

Field = Callable[[Tensor], Tensor]


def find_correspondences_on_field(
    points: Tensor,
    bone_transforms: Tensor,
    field: Field,
    grid: CanonicalGrid,
    *,
    search: SearchConfig | str = "broyden",
    bounded: bool = True,
    start_jacobian: str = "exact",
    points_at_once: int = 32_768,
) -> Correspondences:
    """Find the canonical points that forward skinning with a continuous weight field moves onto the given posed points.

    From each start B_i^-1 x' Broyden's method runs on the field itself; whether there are roots beyond those that it reaches is
    not known (the grid's complete search knows). The field may be any function of PyTorch: it is called with canonical points
    [K, 3] in chunks, must treat each row on its own, give the same answer for the same point, and be differentiable by the
    points. It always runs in full precision here.

    Args:
        points: [B, N, 3], queries, posed space, metres. A non-finite point has no correspondence.
        bone_transforms: [B, J, 4, 4], canonical to posed, metres; finite and invertible.
        field: canonical points [K, 3], metres, to weights [K, J], rows sum to 1.
        grid: canonical box. Its longest side is the unit of `search.tolerance` and `search.divergence`.
        search: settings of the search; its name must be "broyden", and its backend is not used. The papers' values are a
            tolerance of 1e-5 m, 50 steps and a divergence of 1 m.
        bounded: whether iterates are clamped to the box, so that all roots lie in it.
        start_jacobian: "exact" (SNARF Eq. 7), or "blended" for the blended 3x3 alone, without the weights' derivative.
        points_at_once: maximum number of iterates, and of roots, per evaluation of the field; bounds the memory.

    Returns:
        The correspondences without duplicates, those of a query in the order of the starts. They are differentiable in
        `points`, `bone_transforms` and everything that `field` depends on, by implicit differentiation at the roots; the
        iterations are not differentiated. There is no second derivative.

    Raises:
        ValueError: a shape, name, index or transform does not fit, or `field` returns another shape; the message names the
            argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Eq. 5-8 and 14.
    """
    search = as_search_config(search)
    bones = _check(points, bone_transforms, search, start_jacobian)
    if points_at_once < 1:
        raise ValueError(f"points_at_once: wanted at least 1, got {points_at_once}")
    grid = grid.to(points)
    length = grid.longest_side
    settings = _Settings(
        box=grid if bounded else None,
        tolerance=search.tolerance * length,
        divergence=search.divergence * length,
        max_steps=search.max_steps,
        exact_start=start_jacobian == "exact",
        exact_at_roots=search.jacobian == "exact",
        orientation_preserving=search.orientation_preserving,
    )
    # The derivative by the point needs autograd even where the caller has switched it off; inference tensors have none.
    with (
        torch.inference_mode(False),
        torch.no_grad(),
        torch.autocast(points.device.type, enabled=False),
        matmul_precision("highest"),
    ):
        still, moves = points.detach().clone(), bone_transforms.detach().clone()
        inverses, failed = torch.linalg.inv_ex(moves)
        if bool(failed.any()) or not bool(inverses.isfinite().all()):
            raise ValueError("bone_transforms: wanted finite and invertible ones, got one that is not")
        parts = [(still.new_empty(0, 3), torch.empty(0, dtype=torch.long, device=still.device), still.new_empty(0, 3, 3))]
        each = max(1, points_at_once // len(bones))
        for b in range(points.shape[0]):
            at_pose = _Skinning(field, moves[b])
            for start in range(0, points.shape[1], each):
                x, query, inverse = _search(at_pose, still[b, start : start + each], inverses[b, bones, :3], settings)
                parts.append((x, query + (b * points.shape[1] + start), inverse))
        canonical, query, inverse = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
    with torch.autocast(points.device.type, enabled=False), matmul_precision("highest"):
        canonical = _attach_gradient(points, bone_transforms, field, canonical, query, inverse, points_at_once)
    total = torch.tensor([len(query)], device=query.device)
    return Correspondences(canonical, query, inverse, points.shape[0], points.shape[1], total)


@dataclass(frozen=True)
class _Settings:
    """Settings of one search, lengths in metres."""

    box: CanonicalGrid | None
    tolerance: float
    divergence: float
    max_steps: int
    exact_start: bool
    exact_at_roots: bool
    orientation_preserving: bool

    def bounded(self, x: Tensor) -> Tensor:
        """Return points [K, 3] clamped to the box, if there is one."""
        return x if self.box is None else x.clamp(self.box.lower, self.box.upper)


def _search(
    at_pose: _Skinning, queries: Tensor, canonical_from_posed: Tensor, settings: _Settings
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the roots of queries [N, 3] of one pose from start bones [I, 3, 4]; return roots, their queries and J^-1."""
    known = queries.isfinite().all(1).nonzero()[:, 0]
    starts = torch.einsum("jrc,nc->njr", canonical_from_posed[..., :3], queries[known])
    starts = (starts + canonical_from_posed[..., 3]).reshape(-1, 3)
    query = known[:, None].expand(-1, len(canonical_from_posed)).reshape(-1)
    distance = _SAME_ROOT * settings.tolerance
    found = _unique(*_iterate(at_pose, queries, query, starts, settings), distance)
    return _unique(*_finish(at_pose, queries, *found, settings), distance)


class _Skinning:
    """Forward skinning d(x) = sum_j w_j(x) B_j x of one pose [J, 4, 4] with a callable field (SNARF Eq. 4)."""

    def __init__(self, field: Field, transforms: Tensor) -> None:
        self.field = field
        self.rows = transforms[:, :3].reshape(len(transforms), 12)

    def blended(self, x: Tensor) -> Tensor:
        """Return the blended transforms [K, 3, 4] at canonical points [K, 3]."""
        weights = self.field(x)
        if tuple(weights.shape) != (len(x), len(self.rows)):
            raise ValueError(f"field: wanted weights of shape [{len(x)}, {len(self.rows)}], got {list(weights.shape)}")
        return (weights.to(self.rows.dtype) @ self.rows).reshape(-1, 3, 4)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the posed points [K, 3]."""
        blended = self.blended(x)
        return (blended[:, :, :3] @ x[:, :, None])[:, :, 0] + blended[:, :, 3]

    def with_blended(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posed points [K, 3] and the blended 3x3 [K, 3, 3], the Jacobian without the weights' derivative."""
        blended = self.blended(x)
        return (blended[:, :, :3] @ x[:, :, None])[:, :, 0] + blended[:, :, 3], blended[:, :, :3]

    def with_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posed points [K, 3] and the exact Jacobian [K, 3, 3], row by row through autograd."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            posed = self(x)
            rows = [torch.autograd.grad(posed[:, i].sum(), x, retain_graph=i < 2)[0] for i in range(3)]
        return posed.detach(), torch.stack(rows, 1)


def _iterate(
    at_pose: _Skinning, points: Tensor, query: Tensor, x: Tensor, settings: _Settings
) -> tuple[Tensor, Tensor, Tensor]:
    """Run Broyden's method for each pair of query [S] and start [S, 3]; return roots, their queries and J^-1, by start."""
    x = settings.bounded(x)
    posed, matrix = at_pose.with_jacobian(x) if settings.exact_start else at_pose.with_blended(x)
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
        change = at_pose(x) - points[query] - residual
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
    at_pose: _Skinning, points: Tensor, x: Tensor, query: Tensor, inverse: Tensor, settings: _Settings
) -> tuple[Tensor, Tensor, Tensor]:
    """Replace the approximate inverse Jacobians by exact ones, and polish the roots with one short Newton step.

    A root on a fold, where the Jacobian has no inverse, has no gradient either and is dropped.
    """
    if not (settings.exact_at_roots or settings.orientation_preserving) or not len(x):
        return x, query, inverse
    posed, matrix = at_pose.with_jacobian(x)
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
    points: Tensor, bone_transforms: Tensor, field: Field, canonical: Tensor, query: Tensor, inverse: Tensor, at_once: int
) -> Tensor:
    """Return the roots [M, 3] with the implicit gradient to queries, transforms and all that the field depends on."""
    if not torch.is_grad_enabled():
        return canonical
    batch, count = points.shape[:2]
    per_pose = torch.bincount(query // max(count, 1), minlength=batch).tolist()
    parts, first = [], 0
    for b, many in enumerate(per_pose):
        at_pose = _Skinning(field, bone_transforms[b])
        for x in canonical[first : first + many].split(at_once):
            # More roots than fit at once: the field's intermediate results are computed again in the backward pass.
            whole = len(canonical) <= at_once
            parts.append(at_pose(x) if whole else checkpoint(at_pose, x, use_reentrant=False))
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
        ctx.save_for_backward(jacobian_inverse)
        return canonical.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        (jacobian_inverse,) = ctx.saved_tensors
        with matmul_precision("highest"):
            pulled = torch.bmm(jacobian_inverse.transpose(1, 2), gradient[:, :, None])[:, :, 0]
        return -pulled, pulled, None, None


def _check(points: Tensor, bone_transforms: Tensor, search: SearchConfig, start_jacobian: str) -> list[int]:
    """Raise ValueError or TypeError if arguments do not fit together; return the bones to start from."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points: wanted shape [B, N, 3], got {list(points.shape)}")
    shape = list(bone_transforms.shape)
    if len(shape) != 4 or shape[0] != points.shape[0] or shape[1] < 1 or shape[2:] != [4, 4]:
        raise ValueError(f"bone_transforms: wanted shape [{points.shape[0]}, J, 4, 4] to fit points, got {shape}")
    for name, tensor in (("points", points), ("bone_transforms", bone_transforms)):
        if tensor.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name}: wanted float32 or float64, got {tensor.dtype}")
    if bone_transforms.dtype != points.dtype:
        raise TypeError(f"bone_transforms: wanted the dtype of points, {points.dtype}, got {bone_transforms.dtype}")
    if bone_transforms.device != points.device:
        raise ValueError(f"bone_transforms: wanted the device of points, {points.device}, got {bone_transforms.device}")
    check_search_config(search, shape[1])
    if search.name != "broyden":
        raise ValueError(f"search.name: wanted broyden, got {search.name!r}: a field has no cells to search")
    if start_jacobian not in ("exact", "blended"):
        raise ValueError(f"start_jacobian: wanted exact or blended, got {start_jacobian!r}")
    return list(range(shape[1])) if search.init_bones is None else list(search.init_bones)
