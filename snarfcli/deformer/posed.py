"""A deformer in some poses, prepared once for many searches and queries."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, SupportsIndex, overload

import torch
from torch import Tensor

from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.field_search import find_correspondences_on_field
from snarfcli.deformer.forward_maps import ForwardMap, check_vectors, map_in_cells, map_on_field
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate
from snarfcli.deformer.grid_search import BlendedPoses, check_capacity, check_points
from snarfcli.deformer.implicit import add_implicit_gradient
from snarfcli.deformer.pose_gradients import PoseGradients, corners_of_poses
from snarfcli.deformer.posed_boxes import posed_boxes
from snarfcli.deformer.search_config import SearchConfig
from snarfcli.deformer.second_derivatives import differentiable_once
from snarfcli.deformer.starts import check_starts
from snarfcli.native import cpu
from snarfcli.native.backend import choose_backend

__all__ = ["PosedDeformer", "PosedField", "PosedGrid"]


class PosedDeformer(ABC):
    """A deformer in B poses, made by `ForwardDeformer.pose`: what all calls need is computed once.

    It keeps the cells that the deformer had when it was made, and the weights in them; those elsewhere are evaluated when
    `skin` or `transforms_at` is first called. Gradients to the weights and transforms are gathered from all calls and passed
    on once per backward pass. So add up the losses of all chunks and call `backward` once; every further pass needs the graph
    of the pose again (`retain_graph=True` for all but the last).
    """

    bone_transforms: Tensor
    """[B, J, 4, 4], canonical to posed, metres."""

    @abstractmethod
    def __call__(self, points: Tensor, capacity: int | None = None, starts: Tensor | None = None) -> Correspondences:
        """Find the correspondences of posed points, as `ForwardDeformer.forward` does.

        Args:
            points: [B, N, 3], posed space, metres.
            capacity: maximum number of roots to return, see `find_correspondences`; not for a field that is searched directly.
            starts: [B, N, I, 3], canonical points from which a broyden search starts, metres; None for the start bones.
        """

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[Any, ...]:
        raise TypeError("a prepared pose cannot be copied or pickled: send the transforms, and call deformer.pose there")

    @property
    @abstractmethod
    def box(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner, [B, 3] each, metres, of a box around the posed images of all cells that are searched.

        Points outside have no correspondence. For a field that is searched directly, which may exceed it slightly, it is the
        box of the values at the grid nodes.
        """

    @abstractmethod
    def _map(self, canonical: Tensor, with_jacobian: bool) -> ForwardMap:
        """Evaluate the forward map at canonical points [B, N, 3]."""

    def transforms_at(self, canonical: Tensor) -> Tensor:
        """Return the blended transforms [B, N, 4, 4] at canonical points [B, N, 3], metres; differentiable."""
        return self._checked_map(canonical, with_jacobian=False).matrices()

    @overload
    def skin(self, canonical: Tensor, *, directions: None = None, normals: None = None) -> Tensor: ...

    @overload
    def skin(
        self, canonical: Tensor, *, directions: Tensor | None = None, normals: Tensor | None = None
    ) -> Tensor | tuple[Tensor, ...]: ...

    def skin(
        self, canonical: Tensor, *, directions: Tensor | None = None, normals: Tensor | None = None
    ) -> Tensor | tuple[Tensor, ...]:
        """Move canonical points into the poses, with the weights that the search goes by; differentiable.

        Args:
            canonical: [B, N, 3], metres.
            directions: [B, N, 3], a vector at each point, such as a tangent; moved by the exact Jacobian of the deformation,
                which contains the derivative of the weights.
            normals: [B, N, 3], a normal at each point; moved by the inverse transpose of the Jacobian and normalised.

        Returns:
            Posed points, [B, N, 3], metres; with `directions` or `normals` a tuple of the points and of these, in this order.

        Raises:
            ValueError, TypeError: a shape, dtype or device does not fit.

        Source: SNARF Eq. 4.
        """
        check_vectors(canonical, directions=directions, normals=normals)
        with_jacobian = directions is not None or normals is not None
        return self._checked_map(canonical, with_jacobian).skinned(directions, normals)

    def _checked_map(self, canonical: Tensor, with_jacobian: bool) -> ForwardMap:
        check_points(canonical, self.bone_transforms, "canonical")
        with torch.autocast(canonical.device.type, enabled=False):
            return self._map(canonical, with_jacobian)


class PosedField(PosedDeformer):
    """Poses of a field that is searched directly.

    Args:
        bone_transforms: [B, J, 4, 4], canonical to posed, metres.
        field: from canonical points to weights, see `find_correspondences_on_field`.
        grid: canonical box.
        search: settings of the search.
        box: returns the box of the poses, see `PosedDeformer.box`.
    """

    def __init__(
        self,
        bone_transforms: Tensor,
        field: Callable[..., Tensor],
        grid: CanonicalGrid,
        search: SearchConfig,
        box: Callable[[], tuple[Tensor, Tensor]],
    ) -> None:
        self.bone_transforms, self._field, self._grid, self._search, self._box = bone_transforms, field, grid, search, box

    def __call__(self, points: Tensor, capacity: int | None = None, starts: Tensor | None = None) -> Correspondences:
        """As described for `PosedDeformer`."""
        if capacity is not None:
            raise ValueError("capacity: wanted None for a field that is searched directly; it needs a search on the grid")
        check_points(points, self.bone_transforms)
        return find_correspondences_on_field(
            points, self.bone_transforms, self._field, self._grid, starts=starts, search=self._search
        )

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        """As described for `PosedDeformer`."""
        return self._box()

    def _map(self, canonical: Tensor, with_jacobian: bool) -> ForwardMap:
        return map_on_field(self._field, canonical, self.bone_transforms, with_jacobian)


class PosedGrid(PosedDeformer):
    """Poses of weights on a grid: the transforms are blended at the nodes, and the cells are sorted for a complete search.

    Args:
        bone_transforms: [B, J, 4, 4], canonical to posed, metres.
        poses: the same, blended at the nodes of the cells that are searched.
        everywhere: returns them blended at all nodes.
    """

    def __init__(self, bone_transforms: Tensor, poses: BlendedPoses, everywhere: Callable[[], BlendedPoses]) -> None:
        self.bone_transforms = bone_transforms
        self._searched = _Gathered(poses)
        self._everywhere = everywhere
        self._is_recorded = torch.is_grad_enabled()
        self._all_nodes: _Gathered | None = None
        self._cells: cpu.PreparedCells | None = None
        self._boxes: Tensor | None = None
        search, device = poses.search, poses.transforms.device.type
        if search.name == "complete" and device == "cpu" and choose_backend(search.backend, device) == "native":
            limits = (search.tolerance, search.max_steps, search.orientation_preserving)
            still = self._searched.still
            self._cells = cpu.PreparedCells(still.transforms, *still.box, still.active_cells, *limits)
            self._boxes = self._cells.boxes

    def __call__(self, points: Tensor, capacity: int | None = None, starts: Tensor | None = None) -> Correspondences:
        """As described for `PosedDeformer`."""
        poses = self._searched.poses
        check_points(points, self.bone_transforms)
        check_capacity(capacity)
        check_starts(starts, points, poses.search)
        near = poses.centred.points(points)
        if torch.compiler.is_compiling():  # the operators can be compiled, and what gathers their gradients cannot
            return poses.correspondences(points, poses.find(near, starts, capacity))
        if torch.is_grad_enabled() and (near.requires_grad or self._searched.gradients.ticket.requires_grad):
            found: Any = _Roots.apply(near, self._searched.gradients.ticket, self, starts, capacity)
        else:
            found = self.find(near, starts, capacity)
        return poses.correspondences(points, found)

    def find(self, near: Tensor, starts: Tensor | None, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Search for points [B, N, 3] in the moved frames, without gradients; returns what the operators return."""
        if self._cells is not None:
            return self._cells.find(near, capacity)
        with torch.no_grad(), torch.autocast(near.device.type, enabled=False):
            return self._searched.still.find(near, starts, capacity)

    def pull_back(self, roots: tuple[Tensor, ...], count: int, wants: tuple[bool, bool]) -> Tensor:
        """Return the gradient by the queries, [B, N, 3], from (the gradient by the roots, roots, queries, J^-1).

        The gradient by the transforms is added to their sum. What is not wanted is left out.
        """
        still = self._searched.still
        into = self._searched.gradients.sum() if wants[1] else None
        gradient, canonical, query, inverse = roots
        lower, upper, shape = still.box
        return add_implicit_gradient(
            into,
            gradient,
            canonical,
            query,
            inverse,
            lower,
            upper,
            shape,
            batch=len(still.transforms),
            count=count,
            wants_points=wants[0],
            backend=still.search.backend,
        )

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        """As described for `PosedDeformer`."""
        still = self._searched.still
        if self._boxes is None:
            self._boxes = posed_boxes(still.transforms, still.centred.grid, still.shape, still.active_cells)
        lower, upper = self._boxes.unbind(1)
        origin = still.centred.posed_origin
        return (lower, upper) if origin is None else (lower + origin, upper + origin)

    @property
    def _gathered(self) -> _Gathered:
        """The poses blended at all nodes, with gradients if the pose was made with them, wherever it is asked for first."""
        if self._all_nodes is None:
            with torch.inference_mode(False), torch.set_grad_enabled(self._is_recorded):
                poses = self._everywhere()
                self._all_nodes = self._searched if poses is self._searched.poses else _Gathered(poses)
        return self._all_nodes

    def _map(self, canonical: Tensor, with_jacobian: bool) -> ForwardMap:
        gathered = self._gathered
        poses = gathered.still
        nodes, size = math.prod(poses.shape), poses.centred.grid.cell_size(poses.shape)
        x = poses.centred.starts(canonical)
        cell, local = locate(x, poses.centred.grid, poses.shape)
        first = nodes * torch.arange(len(x), device=x.device)[:, None, None]
        at_corners = (cell_corners(cell, poses.shape) + first).reshape(-1, 8)
        if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():  # as in a search; and torch.func
            corners = gathered.poses.transforms.reshape(-1, 12)[at_corners]
        else:
            corners = corners_of_poses(gathered.gradients, at_corners)
        at = map_in_cells(corners.reshape(*x.shape[:2], 8, 12), local, x, size, with_jacobian)
        return at.restored(poses.centred)


class _Gathered:
    """Blended poses, the same without gradients, and the gradients by them."""

    def __init__(self, poses: BlendedPoses) -> None:
        self.poses = poses
        self.gradients = PoseGradients(poses.transforms)
        self.still = replace(poses, transforms=self.gradients.transforms)


class _Roots(torch.autograd.Function):
    """A search with the implicit gradient of SNARF Eq. 14, of which that by the transforms is gathered."""

    @staticmethod
    def forward(ctx, near, ticket, posed, starts, capacity):
        found = posed.find(near, starts, capacity)
        ctx.posed, ctx.count = posed, near.shape[1]
        ctx.save_for_backward(*found[:3])
        ctx.mark_non_differentiable(*found[1:])
        ctx.set_materialize_grads(False)
        return found

    @staticmethod
    @differentiable_once
    def backward(ctx, gradient, *_):
        if gradient is None:
            return (None,) * 5
        wants = ctx.needs_input_grad[:2]
        v_points = ctx.posed.pull_back((gradient, *ctx.saved_tensors), ctx.count, wants)
        return v_points if wants[0] else None, gradient.new_zeros(()) if wants[1] else None, None, None, None
