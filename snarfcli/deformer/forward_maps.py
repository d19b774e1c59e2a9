"""Forward skinning at given canonical points: the blended transforms, the posed points and the exact Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.callables import with_pose
from snarfcli.deformer.centring import Centred
from snarfcli.deformer.inference_tensors import NormalTensors
from snarfcli.deformer.skinning import blended_matrices, moved_vectors
from snarfcli.deformer.trilinear import between_corners, trilinear_transforms

__all__ = ["ForwardMap", "check_vectors", "map_by_weights", "map_in_cells", "map_on_field"]


@dataclass(frozen=True, eq=False)
class ForwardMap:
    """d(x) = T(x) [x; 1] at canonical points."""

    rows: Tensor
    """[B, N, 3, 4], upper rows of the blended transforms T(x)."""
    posed: Tensor
    """[B, N, 3], d(x), metres."""
    jacobian: Tensor | None
    """[B, N, 3, 3], dd/dx, which contains the derivative of the weights; None if it was not asked for."""

    def skinned(self, directions: Tensor | None, normals: Tensor | None) -> Tensor | tuple[Tensor, ...]:
        """Return the posed points, and with them those of directions and normals [B, N, 3] that are given, moved."""
        if self.jacobian is None:
            return self.posed
        return self.posed, *moved_vectors(self.jacobian, directions, normals)

    def matrices(self) -> Tensor:
        """Return T(x) as [B, N, 4, 4]."""
        last = self.rows.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*self.rows.shape[:2], 1, 4)
        return torch.cat([self.rows, last], 2)

    def restored(self, centred: Centred) -> ForwardMap:
        """Return the map of the given frames, where this is the one of the moved frames."""
        if centred.posed_origin is None or centred.canonical_origin is None:
            return self
        origin = centred.posed_origin[:, None]
        shift = self.rows[..., 3] - (self.rows[..., :3] * centred.canonical_origin).sum(-1) + origin
        return ForwardMap(torch.cat([self.rows[..., :3], shift[..., None]], -1), self.posed + origin, self.jacobian)


def check_vectors(points: Tensor, **vectors: Tensor | None) -> None:
    """Raise ValueError or TypeError for vectors that do not have the shape, dtype and device of the points."""
    for name, given in vectors.items():
        if given is None:
            continue
        if given.shape != points.shape:
            raise ValueError(f"{name}: wanted the shape of the points, {list(points.shape)}, got {list(given.shape)}")
        if given.dtype != points.dtype:
            raise TypeError(f"{name}: wanted the dtype of the points, {points.dtype}, got {given.dtype}")
        if given.device != points.device:
            raise ValueError(f"{name}: wanted the device of the points, {points.device}, got {given.device}")


def map_in_cells(
    corner_transforms: Tensor, local: Tensor, canonical: Tensor, cell_size: Tensor, with_jacobian: bool
) -> ForwardMap:
    """Evaluate the map that is trilinear between the grid nodes; outside the grid the weights are those of its border.

    Args:
        corner_transforms: [B, N, 8, 12], blended transforms at the corners of each point's cell.
        local: [B, N, 3], coordinates in the cell, beyond 0 to 1 for a point outside the grid.
        canonical: [B, N, 3], metres.
        cell_size: [3], metres.
        with_jacobian: whether the Jacobian is computed.
    """
    inside = local.clamp(0, 1)
    corners = corner_transforms.reshape(-1, 8, 12), inside.reshape(-1, 3)
    shape = [*canonical.shape[:2], 3, 4]
    if not with_jacobian:
        rows = between_corners(*corners).reshape(shape)
        return ForwardMap(rows, _applied(rows, canonical), None)
    rows, *by_local = (part.reshape(shape) for part in trilinear_transforms(*corners))
    varies = (local == inside) / cell_size
    columns = [_applied(part, canonical) * varies[..., axis, None] for axis, part in enumerate(by_local)]
    return ForwardMap(rows, _applied(rows, canonical), rows[..., :3] + torch.stack(columns, -1))


def map_by_weights(weights: Tensor, canonical: Tensor, bone_transforms: Tensor) -> ForwardMap:
    """Evaluate the map without its Jacobian, for weights [B, N, J] at the points [B, N, 3]."""
    rows = blended_matrices(weights, bone_transforms)[..., :3, :]
    return ForwardMap(rows, _applied(rows, canonical), None)


def map_on_field(field: Callable[..., Tensor], canonical: Tensor, bone_transforms: Tensor, with_jacobian: bool) -> ForwardMap:
    """Evaluate the map with the weights of a field itself.

    Args:
        field: canonical points [K, 3], metres, to weights [K, J]; with a parameter `pose_index` also of the poses.
        canonical: [B, N, 3], metres.
        bone_transforms: [B, J, 4, 4], canonical to posed, metres.
        with_jacobian: whether the Jacobian is computed.
    """
    if with_jacobian and torch.is_inference_mode_enabled():  # whose tensors have no derivatives
        with torch.inference_mode(False), torch.no_grad(), NormalTensors():
            return map_on_field(field, canonical, bone_transforms, with_jacobian)
    batch, count = canonical.shape[:2]
    is_recorded = torch.is_grad_enabled()
    pose = torch.arange(batch, device=canonical.device).repeat_interleave(count)
    with torch.set_grad_enabled(is_recorded or with_jacobian):
        x = canonical if is_recorded and canonical.requires_grad else canonical.detach().requires_grad_(with_jacobian)
        weights = with_pose(field)(x.reshape(-1, 3), pose)
        if tuple(weights.shape) != (batch * count, bone_transforms.shape[1]):
            wanted = [batch * count, bone_transforms.shape[1]]
            raise ValueError(f"field: wanted weights of shape {wanted}, got {list(weights.shape)}")
        weights = weights.reshape(batch, count, bone_transforms.shape[1]).to(canonical.dtype)
        at = map_by_weights(weights, x, bone_transforms)
        if not with_jacobian:
            return at
        rows_of_jacobian = [
            torch.autograd.grad(part.sum(), x, create_graph=is_recorded, retain_graph=True)[0] for part in at.posed.unbind(-1)
        ]
        parts = at.rows, at.posed, torch.stack(rows_of_jacobian, -2)
    return ForwardMap(*(parts if is_recorded else (part.detach() for part in parts)))


def _applied(rows: Tensor, x: Tensor) -> Tensor:
    """Apply transforms [..., 3, 4] to points [..., 3]."""
    return (rows[..., :3] * x[..., None, :]).sum(-1) + rows[..., 3]
