"""Find every canonical correspondence of posed points on a weight grid, with exact implicit gradients."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.centring import Centred, centre
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.ops import broyden_search, complete_search
from snarfcli.deformer.roots import invert_3x3, is_costly_to_read
from snarfcli.deformer.search_config import SearchConfig, as_search_config, check_search_config
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import check_starts, start_transforms

__all__ = [
    "BlendedPoses",
    "check_capacity",
    "check_points",
    "check_tensor",
    "check_transforms",
    "check_values",
    "find_correspondences",
]


def find_correspondences(
    points: Tensor,
    bone_transforms: Tensor,
    skinning_weights: Tensor,
    grid: CanonicalGrid,
    *,
    search: SearchConfig | str | None = None,
    starts: Tensor | None = None,
    active_cells: Tensor | None = None,
    capacity: int | None = None,
    check: bool = True,
) -> Correspondences:
    """Find the canonical points that forward skinning moves onto the given posed points.

    Args:
        points: [B, N, 3], queries, posed space, metres. A non-finite point has no correspondence.
        bone_transforms: [B, J, 4, 4], canonical to posed, metres; invertible.
        skinning_weights: [D, H, W, J], at the grid nodes (z, y, x), rows sum to 1; or [B, D, H, W, J], those of each pose.
        grid: the box of the nodes.
        search: settings of the search, or its name: "complete" (cell by cell, without start bones) or "broyden" (the papers',
            from one start per bone). None for the defaults of `SearchConfig`.
        starts: [B, N, I, 3], canonical points, metres, from which a broyden search starts instead of from bones. One that is
            not finite is no start. They get no gradient.
        active_cells: [D-1, H-1, W-1], bool, the cells in which a complete search looks for roots; None for all.
        capacity: maximum number of roots to return. The results always have this length, and rows beyond the roots have the
            query B * N; so nothing waits for a GPU, and the call can be captured in a CUDA graph. torch.compile with
            fullgraph=True needs it too, or torch._dynamo.config.capture_dynamic_output_shape_ops.
        check: whether to check the values of transforms and weights; skipped on a GPU, where it would force a synchronisation.

    Returns:
        The correspondences, differentiable in `points`, `bone_transforms` and `skinning_weights` by implicit
        differentiation at the roots; the iterations are not differentiated. There is no second derivative.

    Raises:
        ValueError: a shape, name or index does not fit, a transform is not finite or singular, or weights do not sum to 1; the
            message names the argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Sec. 3.2 and 3.4 (Eq. 5-9, 14); Fast-SNARF Sec. 4.
    """
    search = as_search_config(search)
    _check_shapes(points, bone_transforms, skinning_weights, active_cells)
    check_search_config(search, bone_transforms.shape[1])
    check_starts(starts, points, search)
    if search.name == "broyden" and active_cells is not None:
        raise ValueError("active_cells needs search.name 'complete': a broyden search has no cells")
    check_capacity(capacity)
    grid = grid.to(points)
    if check:
        check_values(grid, bone_transforms, skinning_weights, active_cells)
    poses = BlendedPoses.of(bone_transforms, skinning_weights, grid, search, active_cells)
    return poses.correspondences(points, poses.find(poses.centred.points(points), starts, capacity))


@dataclass(frozen=True, eq=False)
class BlendedPoses:
    """B poses whose bone transforms are blended at the grid nodes, and how they are searched."""

    transforms: Tensor
    """[B, D * H * W, 12], upper rows of the blended transforms, in the moved frames of `centred`; differentiable."""
    centred: Centred
    """The poses and the grid near the origin."""
    shape: list[int]
    """Nodes (D, H, W)."""
    search: SearchConfig
    """Settings of the search."""
    active_cells: Tensor | None
    """[D-1, H-1, W-1], bool, the cells in which a complete search looks for roots; None for all."""

    @classmethod
    def of(
        cls,
        bone_transforms: Tensor,
        skinning_weights: Tensor,
        grid: CanonicalGrid,
        search: SearchConfig,
        active_cells: Tensor | None,
    ) -> BlendedPoses:
        """Blend arguments that have been checked; see `find_correspondences`."""
        centred = centre(bone_transforms, grid)
        transforms = blend_transforms(skinning_weights, centred.transforms, active_cells, search.backend)
        return cls(transforms, centred, list(skinning_weights.shape[-4:-1]), search, active_cells)

    @property
    def box(self) -> tuple[Tensor, Tensor, list[int]]:
        """Corners of the moved grid, [3] each, metres, and the nodes (D, H, W), as the operators take them."""
        return self.centred.grid.lower, self.centred.grid.upper, self.shape

    def find(self, near: Tensor, starts: Tensor | None, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Search for points [B, N, 3] in the moved frames; returns what the operators return (see `ops`)."""
        search = self.search
        common = (search.orientation_preserving, capacity, search.backend)
        if search.name == "complete":
            limits = (search.tolerance, search.max_steps)
            return complete_search(near, self.transforms, *self.box, self.active_cells, *limits, *common)
        bones = self.centred.transforms
        given = start_transforms(bones, search.init_bones) if starts is None else self.centred.starts(starts)
        limits = (search.tolerance, search.divergence, search.max_steps)
        exact = search.jacobian == "exact"
        return broyden_search(near, self.transforms, given.detach(), *self.box, *limits, exact, *common)

    def correspondences(self, points: Tensor, found: tuple[Tensor, Tensor, Tensor, Tensor]) -> Correspondences:
        """Return what a search for points [B, N, 3] has found, in the given canonical frame."""
        canonical, query, jacobian_inverse, total = found
        if self.centred.canonical_origin is not None:
            canonical = self.centred.restored(canonical, query < points.shape[0] * points.shape[1])
        return Correspondences(canonical, query, jacobian_inverse.detach(), points.shape[0], points.shape[1], total)


@torch.no_grad()
def check_transforms(bone_transforms: Tensor) -> None:
    """Raise ValueError for transforms [B, J, 4, 4] that are not finite or singular.

    Skipped on a GPU, where the check would force a synchronisation.
    """
    if is_costly_to_read(bone_transforms):
        return
    if not bool(bone_transforms.isfinite().all()):
        raise ValueError("bone_transforms: wanted finite numbers, got NaN or infinite ones")
    turn = bone_transforms[..., :3, :3].reshape(-1, 3, 3)
    _, determinant = invert_3x3(turn)
    singular = (determinant.abs() <= 1e-9 * turn.abs().amax((1, 2)) ** 3).nonzero()[:, 0]
    if len(singular):
        pose, bone = divmod(int(singular[0]), bone_transforms.shape[1])
        raise ValueError(f"bone_transforms: wanted invertible ones, got a singular one for bone {bone} of pose {pose}")
    last = bone_transforms[..., 3, :] - bone_transforms.new_tensor([0.0, 0.0, 0.0, 1.0])
    if bool((last.abs() > 1e-3).any()):
        row = bone_transforms[..., 3, :][(last.abs() > 1e-3).any(-1)][0].tolist()
        came = ", ".join(f"{value:.3g}" for value in row)
        raise ValueError(f"bone_transforms: wanted 0, 0, 0, 1 as the last row, got {came}; are they transposed?")


def check_values(grid: CanonicalGrid, bone_transforms: Tensor, skinning_weights: Tensor, active_cells: Tensor | None) -> None:
    """Raise ValueError if grid, transforms or weights are invalid. Skipped on a GPU, as in `check_transforms`."""
    if is_costly_to_read(bone_transforms):
        return
    if not bool((grid.upper > grid.lower).all()):
        box = f"{grid.lower.tolist()} and {grid.upper.tolist()}"
        raise ValueError(f"grid.upper: wanted more than grid.lower in {grid.lower.dtype}, got {box}")
    check_transforms(bone_transforms)
    with torch.no_grad():
        wrong = ~((skinning_weights.sum(-1) - 1).abs() < 1e-3)
        if active_cells is not None:
            wrong &= corners_of(active_cells)
        if bool(wrong.any()):
            came = float(skinning_weights[wrong][0].sum())
            raise ValueError(f"skinning_weights: wanted a sum of 1 at every node of a searched cell, got {came:.4g}")


def check_tensor(name: str, value: object) -> None:
    """Raise TypeError for what is not a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: wanted a tensor, got a {type(value).__name__}; torch.as_tensor makes one")


def check_points(points: Tensor, poses: Tensor | None = None, name: str = "points") -> None:
    """Raise ValueError or TypeError if points are not [B, N, 3], or do not fit the transforms [B, J, 4, 4] of poses."""
    check_tensor(name, points)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"{name}: wanted shape [B, N, 3], got {list(points.shape)}")
    if poses is None:
        return
    if len(points) != len(poses):
        raise ValueError(f"{name}: wanted shape [{len(poses)}, N, 3] to fit the poses, got {list(points.shape)}")
    if points.dtype != poses.dtype:
        raise TypeError(f"{name}: wanted the dtype of the poses, {poses.dtype}, got {points.dtype}")
    if points.device != poses.device:
        raise ValueError(f"{name}: wanted the device of the poses, {poses.device}, got {points.device}")


def check_capacity(capacity: int | None) -> None:
    """Raise ValueError for a negative capacity, and TypeError for what is no number."""
    if capacity is None:
        return
    if not isinstance(capacity, int | torch.SymInt):
        raise TypeError(f"capacity: wanted a number or None, got a {type(capacity).__name__}")
    if capacity < 0:
        raise ValueError(f"capacity: wanted 0 or more, got {capacity}")


def _check_shapes(points: Tensor, bone_transforms: Tensor, skinning_weights: Tensor, active_cells: Tensor | None) -> None:
    """Raise ValueError or TypeError if the tensors do not fit together."""
    check_points(points)
    check_tensor("bone_transforms", bone_transforms)
    check_tensor("skinning_weights", skinning_weights)
    batch, shape = points.shape[0], list(skinning_weights.shape)
    if len(shape) not in (4, 5) or min(shape[-4:-1]) < 2 or shape[-1] < 1:
        raise ValueError(f"skinning_weights: wanted shape [D, H, W, J], at least 2 nodes per side, got {shape}")
    if len(shape) == 5 and shape[0] != batch:
        raise ValueError(f"skinning_weights: wanted shape [{batch}, D, H, W, J] to fit points, got {shape}")
    wanted = [batch, shape[-1], 4, 4]
    if list(bone_transforms.shape) != wanted:
        raise ValueError(f"bone_transforms: wanted shape {wanted} to fit the others, got {list(bone_transforms.shape)}")
    for name, tensor in (("points", points), ("bone_transforms", bone_transforms), ("skinning_weights", skinning_weights)):
        if tensor.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name}: wanted float32 or float64, got {tensor.dtype}")
        if tensor.dtype != points.dtype:
            raise TypeError(f"{name}: wanted the dtype of points, {points.dtype}, got {tensor.dtype}")
        if tensor.device != points.device:
            raise ValueError(f"{name}: wanted the device of points, {points.device}, got {tensor.device}")
    if active_cells is None:
        return
    cells = [n - 1 for n in shape[-4:-1]]
    if list(active_cells.shape) != cells or active_cells.dtype != torch.bool:
        raise ValueError(f"active_cells: wanted bool {cells}, got {active_cells.dtype} {list(active_cells.shape)}")
    if active_cells.device != points.device:
        raise ValueError(f"active_cells: wanted the device of points, {points.device}, got {active_cells.device}")
