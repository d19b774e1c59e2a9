"""What a deformer needs of a body: canonical pose, vertices and weights there, and the box and cells around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.bodies.extent import bone_segments
from snarfcli.bodies.skinned_body import as_skinned_body
from snarfcli.deformer.cells import cells_near
from snarfcli.deformer.diffusion import PresetWeights
from snarfcli.deformer.grid import CanonicalGrid, locate
from snarfcli.deformer.grid_sides import with_grid_sides
from snarfcli.deformer.hierarchy import PlainSoftmax
from snarfcli.deformer.skinning import skin
from snarfcli.deformer.skinning_config import BodySkinningConfig, SkinningConfig
from snarfcli.deformer.weights import GridWeights, VoxelWeights
from snarfcli.field_docs import documented

__all__ = ["CanonicalBody", "canonical_body", "weights_around"]

_ADULT_M = 1.75  # longest side of SMPL's body in the canonical pose, for which the margins of `BodySkinningConfig` are
_LEAST_WEIGHT = 1e-5  # of trained weights: a weight of zero has no gradient. 24 bones 1 m away move a point by 0.2 mm


@documented
@dataclass(frozen=True, eq=False)
class CanonicalBody:
    """A body in the canonical pose of a deformer, and the grid around it."""

    skeleton: Skeleton
    """Joint tree, rest joints and canonical pose."""
    vertices: Tensor
    """[V, 3], in the canonical pose, metres."""
    weights: Tensor
    """[V, J], skinning weights, rows sum to 1."""
    grid: CanonicalGrid
    """Box around the vertices, with a margin."""
    shape: tuple[int, int, int]
    """Grid nodes (D, H, W) along z, y, x."""
    active_cells: Tensor
    """[D-1, H-1, W-1], bool, the cells near the body."""

    def mapped(self, change: Callable[[Tensor], Tensor]) -> CanonicalBody:
        """Return the body with all tensors changed by a function, such as one that moves them to a device."""
        skeleton = replace(
            self.skeleton,
            joints_rest=change(self.skeleton.joints_rest),
            canonical_pose=change(self.skeleton.canonical_pose),
        )
        grid = CanonicalGrid(change(self.grid.lower), change(self.grid.upper), checked=True)
        vertices, weights, cells = (change(tensor) for tensor in (self.vertices, self.weights, self.active_cells))
        return CanonicalBody(skeleton, vertices, weights, grid, self.shape, cells)

    def posed_from_canonical(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return the bone transforms [B, J, 4, 4] that a deformer takes, metres.

        Args:
            pose: [B, J, 3], axis-angle relative to the rest pose, radians, global orientation first.
            translation: [B, 3], metres, none by default.
        """
        return self.skeleton.posed_from_canonical(pose, translation)


def canonical_body(
    body: object,
    *,
    betas: Tensor | Sequence[float] | None = None,
    canonical_pose: Tensor | None = None,
    resolution: Sequence[int] | None = None,
    margin_m: Sequence[float] | None = None,
) -> CanonicalBody:
    """Bring a body into the canonical pose and lay a grid around it; see `ForwardDeformer.from_body`.

    Raises:
        ValueError: an array is missing, or a shape, a number or a parent is not valid.
        UserError: the file cannot be read.
    """
    with torch.no_grad():
        rest = as_skinned_body(body, betas)
        skeleton = rest.skeleton
        if canonical_pose is not None:
            skeleton = replace(skeleton, canonical_pose=torch.as_tensor(canonical_pose).to(skeleton.joints_rest))
        canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0]
        vertices = skin(rest.vertices, rest.weights, canonical_from_rest)
        return _with_grid(skeleton, vertices, rest.weights, resolution, margin_m)


def weights_around(body: CanonicalBody, trainable: bool) -> GridWeights:
    """Return the weights of a body, extended from its vertices to the grid: fixed, or trained from there."""
    preset = PresetWeights.from_vertices(body.vertices, body.weights, body.grid, body.shape)
    if not trainable:
        return preset
    field = VoxelWeights(PlainSoftmax(body.skeleton.num_joints), body.grid, body.shape, SkinningConfig().sharpness)
    field.set_weights(preset.weights.reshape(*body.shape, -1), _LEAST_WEIGHT)
    return field


def _with_grid(
    skeleton: Skeleton, vertices: Tensor, weights: Tensor, resolution: Sequence[int] | None, margin_m: Sequence[float] | None
) -> CanonicalBody:
    """Lay the grid around a body; its margins and the reach of its cells grow with the body."""
    size = float((vertices.amax(0) - vertices.amin(0)).max()) / _ADULT_M
    if not size > 0:
        raise ValueError("vertices: wanted a body, got vertices that are all in one place")
    settings = BodySkinningConfig()
    assert settings.bone_radius_m is not None
    chosen = replace(settings, margin_m=[size * margin for margin in settings.margin_m])
    chosen = with_grid_sides(chosen, vertices, skeleton)
    margin = _three("margin_m", chosen.margin_m if margin_m is None else margin_m)
    nodes = _three("resolution", chosen.resolution if resolution is None else resolution)
    grid = CanonicalGrid.around(vertices, margin)
    shape = (int(nodes[2]), int(nodes[1]), int(nodes[0]))
    cell = locate(vertices, grid, shape)[0]
    first = torch.full((int(cell.max()) + 1,), len(vertices), device=cell.device)
    first = first.scatter_reduce(0, cell, torch.arange(len(cell), device=cell.device), "amin")
    surface = vertices[first[first < len(vertices)]]  # one vertex per cell
    bones = bone_segments(skeleton).to(vertices)
    reach = max(size * settings.surface_radius_m, float(grid.cell_size(shape).norm()))  # at least the cells of all vertices
    places = [(bones, size * settings.bone_radius_m), (surface, reach)]
    return CanonicalBody(skeleton, vertices, weights, grid, shape, cells_near(grid, shape, places))


def _three(name: str, values: Sequence[float]) -> Sequence[float]:
    least = 2 if name == "resolution" else 0
    if len(values) != 3 or not all(value >= least for value in values):
        raise ValueError(f"{name}: wanted three numbers of at least {least}, along x, y, z, got {list(values)}")
    return values
