"""SNARF's correspondence search on any weight field: Broyden's method with the field itself inside the iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from snarfcli.deformer.callables import with_pose
from snarfcli.deformer.centring import Centred, centre
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.map_roots import MapSettings, PosedMap, search_map
from snarfcli.deformer.search_config import SearchConfig, as_search_config, check_search_config
from snarfcli.deformer.starts import check_starts

__all__ = ["find_correspondences_on_field"]


def find_correspondences_on_field(
    points: Tensor,
    bone_transforms: Tensor,
    field: Callable[..., Tensor],
    grid: CanonicalGrid,
    *,
    starts: Tensor | None = None,
    search: SearchConfig | str = "broyden",
    bounded: bool = True,
    start_jacobian: str = "exact",
    points_at_once: int = 32_768,
) -> Correspondences:
    """Find the canonical points that forward skinning with a continuous weight field moves onto the given posed points.

    From each start Broyden's method runs on the field itself; whether there are roots beyond those that it reaches is not known
    (the grid's complete search knows). The field may be any function of PyTorch: it is called with canonical points [K, 3] in
    chunks, must treat each row on its own, give the same answer for the same point, and be differentiable by the points. It
    always runs in full precision here.

    Args:
        points: [B, N, 3], queries, posed space, metres. A non-finite point has no correspondence.
        bone_transforms: [B, J, 4, 4], canonical to posed, metres; finite and invertible.
        field: canonical points [K, 3], metres, to weights [K, J], rows sum to 1. If it has a parameter named `pose_index`, it
            also gets the pose of each point, [K], 0 to B - 1.
        grid: canonical box. Its longest side is the unit of `search.tolerance` and `search.divergence`.
        starts: [B, N, I, 3], canonical points, metres, instead of B_i^-1 x' for the start bones. One that is not finite is no
            start. They get no gradient.
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
    _check(points, bone_transforms, starts, search, start_jacobian)
    grid = grid.to(points)
    centred = centre(bone_transforms, grid)
    near, inverses = centred.points(points), _inverses(centred.transforms)
    settings = MapSettings.of(search, centred.grid if bounded else None, grid.longest_side, points_at_once)
    field = with_pose(field)

    def at_pose(b: int) -> PosedMap:
        return _Skinning(field, centred, b, start_jacobian == "exact")

    def starts_of(b: int, some: slice) -> Tensor:
        return _images(inverses[b, bones], near[b, some]) if starts is None else centred.starts(starts[b, some])

    bones = list(range(inverses.shape[1])) if search.init_bones is None else list(search.init_bones)
    found = search_map(near, at_pose, starts_of, len(bones) if starts is None else starts.shape[2], settings)
    return replace(found, canonical=centred.restored(found.canonical))


@torch.no_grad()
def _inverses(bone_transforms: Tensor) -> Tensor:
    """Return the upper rows of the inverse transforms, [B, J, 3, 4]; raise ValueError if there is none."""
    inverses, failed = torch.linalg.inv_ex(bone_transforms)
    if bool(failed.any()) or not bool(inverses.isfinite().all()):
        raise ValueError("bone_transforms: wanted finite and invertible ones, got one that is not")
    return inverses[:, :, :3]


def _images(transforms: Tensor, points: Tensor) -> Tensor:
    """Return the images [N, I, 3] of points [N, 3] under transforms [I, 3, 4]."""
    return torch.einsum("jrc,nc->njr", transforms[..., :3], points) + transforms[..., 3]


class _Skinning(PosedMap):
    """Forward skinning d(x) = sum_j w_j(x) B_j x in one pose with a callable field (SNARF Eq. 4), in centred frames."""

    def __init__(self, field: Callable[[Tensor, Tensor], Tensor], centred: Centred, pose: int, exact_start: bool) -> None:
        self.field, self.centred, self.pose, self.exact_start = field, centred, pose, exact_start
        self.rows = centred.transforms[pose, :, :3].flatten(1)

    def blended(self, x: Tensor) -> Tensor:
        """Return the blended transforms [K, 3, 4] at canonical points [K, 3]."""
        weights = self.field(self.centred.restored(x), torch.full((len(x),), self.pose, device=x.device))
        if tuple(weights.shape) != (len(x), len(self.rows)):
            raise ValueError(f"field: wanted weights of shape [{len(x)}, {len(self.rows)}], got {list(weights.shape)}")
        return (weights.to(self.rows.dtype) @ self.rows).reshape(-1, 3, 4)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the posed points [K, 3]."""
        blended = self.blended(x)
        return (blended[:, :, :3] @ x[:, :, None])[:, :, 0] + blended[:, :, 3]

    def at_start(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posed points and the Jacobian, exact or the blended 3x3 without the weights' derivative."""
        if self.exact_start:
            return self.with_jacobian(x)
        blended = self.blended(x)
        return (blended[:, :, :3] @ x[:, :, None])[:, :, 0] + blended[:, :, 3], blended[:, :, :3]


def _check(points: Tensor, bone_transforms: Tensor, starts: Tensor | None, search: SearchConfig, start_jacobian: str) -> None:
    """Raise ValueError or TypeError if arguments do not fit together."""
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
    check_starts(starts, points, search)
