"""A weight field and the grid that it is evaluated on: nodes, active cells, and weights at points as the search sees them."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from snarfcli.deformer.active_cells import ActiveCells
from snarfcli.deformer.callables import takes_pose, with_pose
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.deformer.roots import is_costly_to_read
from snarfcli.deformer.variation import total_variation
from snarfcli.deformer.weights import GridWeights, NetworkWeights, NodeWeights, WeightField

__all__ = ["FieldOnGrid"]

_VALUES_AT_ONCE = 2**24  # of a layer, at the nodes; 65,536 nodes with layers of 256


class FieldOnGrid(ActiveCells):
    """A weight field, evaluated at the nodes of a grid or, if `searches_field`, used as it is.

    Args:
        grid: canonical box.
        shape: nodes (D, H, W).
        num_bones: J.
        field: from canonical points [N, 3] to weights [N, J].
        searches_field: whether roots are those of the field itself and not of its values at the grid nodes.
        active_cells: [D-1, H-1, W-1], bool, see `set_active_cells`; None for all.
    """

    _frozen: Tensor | None
    field: Callable[..., Tensor]

    def __init__(
        self,
        grid: CanonicalGrid,
        shape: tuple[int, int, int],
        num_bones: int,
        field: Callable[..., Tensor],
        searches_field: bool,
        active_cells: Tensor | None,
    ) -> None:
        super().__init__(grid, shape, active_cells)
        self.num_bones = num_bones
        self.searches_field = searches_field
        """Whether roots are those of the field itself and not of its values at the grid nodes."""
        self.field = field
        if isinstance(self.field, GridWeights) and self.field.shape != self.shape:
            raise ValueError(f"field: wanted the grid's nodes {list(self.shape)} (z, y, x), got {list(self.field.shape)}")
        self.register_buffer("_frozen", None, persistent=False)
        self.register_load_state_dict_post_hook(_after_load)

    @property
    def takes_pose(self) -> bool:
        """Whether the field has a parameter `pose_index`, so that the weights differ from pose to pose."""
        return takes_pose(self.field)

    @property
    def _renews_points(self) -> bool:
        return isinstance(self.field, NetworkWeights) and self.field.prior is not None  # whose logits are kept for the tensor

    # ---------------------------------------------------------------- weights at the nodes
    def weight_grid(self, active_only: bool = False, poses: int | None = None) -> Tensor:
        """Return the skinning weights at the grid nodes, [D, H, W, J], or [B, D, H, W, J] for a field of the pose.

        With `active_only` only the nodes of active cells are evaluated, which are all that a complete search reads; the others
        are zero. Nothing in it waits for a GPU.

        Args:
            active_only: whether only nodes of active cells are evaluated.
            poses: B, for a field with a parameter `pose_index`; otherwise of no effect.
        """
        if self._frozen is not None:
            return self._frozen
        if self.takes_pose:
            if poses is None:
                raise ValueError("poses: wanted the number of poses, for a field with a parameter pose_index, got None")
            return torch.stack([self._one_grid(active_only, pose) for pose in range(poses)]) if poses else self._no_grid()
        return self._one_grid(active_only, None)

    def _no_grid(self) -> Tensor:
        return self.lower.new_empty(0, *self.shape, self.num_bones)

    def _one_grid(self, active_only: bool, pose: int | None) -> Tensor:
        if not active_only:
            return self._weights_of_nodes(None, pose).reshape(*self.shape, -1)
        used, count = self._active_nodes, math.prod(self.shape)
        # With room for more nodes, those that are not used yet go to a row of their own, which is then left out.
        weights = self._weights_of_nodes(used % count if self._keeps_room else used, pose)
        rows = used.clamp_max(count) if self._keeps_room else used
        grid = weights.new_zeros(count + self._keeps_room, self.num_bones).index_copy(0, rows, weights)
        return grid[:count].reshape(*self.shape, -1)

    def _weights_of_nodes(self, nodes: Tensor | None, pose: int | None) -> Tensor:
        """Return the weights [K, J] at the active nodes, given as `nodes`, or at all nodes if None."""
        count = math.prod(self.shape) if nodes is None else len(nodes)
        if isinstance(self.field, GridWeights):
            return self._checked(self.field.at_nodes(nodes), count)
        points = self.grid.nodes(self.shape).reshape(-1, 3) if nodes is None else self._active_points
        # not a subclass, whose `forward` may be another one
        if type(self.field) is not NetworkWeights:
            return self._at_points(points, None if pose is None else torch.full((count,), pose, device=points.device))
        most = count if torch.is_grad_enabled() else max(1, _VALUES_AT_ONCE // self.field.most_values)
        if count <= most:
            return self._checked(self.field.at_fixed_points(points, keeps_prior=nodes is not None), count)
        parts = [self.field.at_fixed_points(part, keeps_prior=False) for part in points.split(most)]
        return self._checked(torch.cat(parts), count)

    def node_weights(self, active_only: bool = False, poses: int | None = None) -> NodeWeights | None:
        """Evaluate the skinning weights at the grid nodes; None for a field that is searched directly.

        Args:
            active_only, poses: as in `weight_grid`.
        """
        if self.searches_field:
            return None
        with torch.autocast(self.lower.device.type, enabled=False):
            return NodeWeights(self.weight_grid(active_only, poses), self.grid)

    def freeze(self) -> FieldOnGrid:
        """Switch to evaluation, evaluate the weight grid once and keep it.

        It is kept until a state is loaded into this module (into the field alone is not enough), or until `train()` is called
        while the field has something to train: a parameter that requires a gradient, or unknown ones of a plain function.

        Raises:
            ValueError: the field depends on the pose.
        """
        if self.takes_pose:
            raise ValueError("freeze: wanted a field without a parameter pose_index, whose weights are the same in all poses")
        self.eval()
        self._frozen = None
        with torch.no_grad(), torch.autocast(self.lower.device.type, enabled=False):
            self._frozen = self.weight_grid()
        return self

    def train(self, mode: bool = True) -> FieldOnGrid:
        """Switch between training and evaluation; training discards a frozen weight grid, see `freeze`."""
        if mode and (
            not isinstance(self.field, nn.Module) or any(parameter.requires_grad for parameter in self.field.parameters())
        ):
            self._frozen = None
        return super().train(mode)

    # ---------------------------------------------------------------- weights at points
    def skinning_weights(
        self, canonical: Tensor, weights: NodeWeights | None = None, pose_index: Tensor | None = None
    ) -> Tensor:
        """Return the skinning weights [..., J] at canonical points [..., 3], as the search uses them; differentiable.

        Only the nodes around the points are evaluated, if they are few. The weights are exact also under autocast.

        Args:
            canonical: [..., 3], metres; points outside the grid get the weights of its border.
            weights: from `node_weights`, if they have been evaluated already; the points must then lie in cells whose nodes
                were evaluated.
            pose_index: [...], the pose of each point, for weights that differ from pose to pose.
        """
        if not canonical.ndim or canonical.shape[-1] != 3:
            raise ValueError(f"canonical: wanted shape [..., 3], got {list(canonical.shape)}")
        leading = canonical.shape[:-1]
        if pose_index is not None and pose_index.shape != leading:
            raise ValueError(f"pose_index: wanted shape {list(leading)} to fit canonical, got {list(pose_index.shape)}")
        points = canonical.to(self.lower.dtype).reshape(-1, 3)
        with torch.autocast(canonical.device.type, enabled=False):
            at = self._weights_at(points, weights, None if pose_index is None else pose_index.reshape(-1))
        return at.reshape(*leading, self.num_bones)

    def _weights_at(self, points: Tensor, weights: NodeWeights | None, pose_index: Tensor | None) -> Tensor:
        if self.searches_field:
            return self._at_points(points, pose_index)
        if weights is None and self._frozen is not None:
            weights = NodeWeights(self._frozen, self.grid)
        if weights is not None:
            return weights.at(points, pose_index)
        corners, local = self.corner_weights(points, pose_index)
        return (trilinear_weights(local.clamp(0, 1))[..., None] * corners).sum(-2)

    def corner_weights(self, canonical: Tensor, pose_index: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the weights [N, 8, J] at the corners of each point's cell, and its coordinates [N, 3] in the cell.

        Coordinates are beyond 0 to 1 for points outside the grid. For arguments see `skinning_weights`.
        """
        nodes = math.prod(self.shape)
        if self._frozen is not None or (8 * len(canonical) >= nodes and not self.takes_pose):
            return NodeWeights(self.weight_grid(), self.grid).corners(canonical, pose_index)
        cell, local = locate(canonical, self.grid, self.shape)
        corners = cell_corners(cell, self.shape)
        if self.takes_pose:
            corners = corners + nodes * self._known(pose_index)[:, None]
        if is_costly_to_read(corners):  # finding the different ones would wait for a GPU
            used, place = corners.reshape(-1), torch.arange(corners.numel(), device=corners.device).reshape(corners.shape)
        else:
            used, place = corners.unique(return_inverse=True)
        if isinstance(self.field, GridWeights):
            weights = self._checked(self.field.at_nodes(used), len(used))
        else:
            points = self.grid.nodes(self.shape).reshape(-1, 3)[used % nodes]
            weights = self._at_points(points, used // nodes)
        return weights[place], local

    def _at_points(self, points: Tensor, pose_index: Tensor | None) -> Tensor:
        """Return the weights [N, J] of the field itself at points [N, 3]."""
        if not self.takes_pose:
            return self._checked(self.field(points), len(points))
        return self._checked(with_pose(self.field)(points, self._known(pose_index)), len(points))

    def _known(self, pose_index: Tensor | None) -> Tensor:
        if pose_index is None:
            raise ValueError("pose_index: wanted the pose of each point, for a field with a parameter pose_index, got None")
        return pose_index

    def _checked(self, weights: Tensor, count: int) -> Tensor:
        """Return the weights of a field, or raise ValueError if their shape is wrong."""
        if tuple(weights.shape) != (count, self.num_bones):
            raise ValueError(f"field: wanted weights of shape [{count}, {self.num_bones}], got {list(weights.shape)}")
        return weights.to(self.lower.dtype)

    def smoothness(self, weights: NodeWeights | None = None) -> Tensor:
        """Return the total variation of the weights over the nodes of active cells (see `total_variation`), [].

        Args:
            weights: from `node_weights`, if they have been evaluated already. Needed for a field with a parameter `pose_index`,
                for the mean over its poses.
        """
        values = self.weight_grid(active_only=True) if weights is None else weights.values
        of_poses = values if values.ndim == 5 else values[None]
        return torch.stack([total_variation(one, self.grid, self._used_nodes) for one in of_poses]).mean()


def _after_load(module: FieldOnGrid, incompatible: object) -> None:
    """Update what follows from the state after load_state_dict: the field's box and the nodes of active cells."""
    module._frozen = None
    if not bool(module.active_cells.any()):
        raise ValueError("active_cells: wanted at least one cell, got none")
    module._update_active_nodes()
    if isinstance(module.field, WeightField):
        module.field.set_box(module.grid)
