"""Forward skinning with the weights of a field: canonical points moved into poses, and boxes around their images."""

from __future__ import annotations

from typing import overload

import torch
from torch import Tensor

from snarfcli.deformer.field_on_grid import FieldOnGrid
from snarfcli.deformer.forward_maps import ForwardMap, check_vectors, map_by_weights, map_in_cells, map_on_field
from snarfcli.deformer.grid_search import check_points, check_tensor
from snarfcli.deformer.posed_boxes import posed_boxes
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.weights import NodeWeights

__all__ = ["ForwardSkinning"]


class ForwardSkinning(FieldOnGrid):
    """A weight field that moves points. For arguments see `FieldOnGrid`."""

    @overload
    def skin(self, canonical: Tensor, bone_transforms: Tensor, *, directions: None = None, normals: None = None) -> Tensor: ...

    @overload
    def skin(
        self, canonical: Tensor, bone_transforms: Tensor, *, directions: Tensor | None = None, normals: Tensor | None = None
    ) -> Tensor | tuple[Tensor, ...]: ...

    def skin(
        self, canonical: Tensor, bone_transforms: Tensor, *, directions: Tensor | None = None, normals: Tensor | None = None
    ) -> Tensor | tuple[Tensor, ...]:
        """Move canonical points into poses: the inverse of the search, differentiable and exact also under autocast.

        Args:
            canonical: [B, N, 3], metres; or [N, 3] for one pose.
            bone_transforms: [B, J, 4, 4], canonical to posed, metres; or [J, 4, 4].
            directions: of the shape of `canonical`, a vector at each point, such as a tangent; moved by the exact Jacobian of
                the deformation, which contains the derivative of the weights.
            normals: of the shape of `canonical`, a normal at each point; moved by the inverse transpose of the Jacobian and
                normalised.

        Returns:
            Posed points, of the shape of `canonical`, metres; with `directions` or `normals` a tuple of the points and of
            these, in this order.

        Raises:
            ValueError, TypeError: a shape, dtype or device does not fit.

        Source: SNARF Eq. 4.
        """
        check_vectors(canonical, directions=directions, normals=normals)
        is_one = canonical.ndim == 2 and bone_transforms.ndim == 3
        if is_one:
            canonical, bone_transforms = canonical[None], bone_transforms[None]
            directions, normals = (None if vectors is None else vectors[None] for vectors in (directions, normals))
        with_jacobian = directions is not None or normals is not None
        results = self._forward_map(canonical, bone_transforms, with_jacobian).skinned(directions, normals)
        if not is_one:
            return results
        return results[0] if isinstance(results, Tensor) else tuple(result[0] for result in results)

    def transforms_at(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return the blended transforms [B, N, 4, 4] at canonical points [B, N, 3], metres; differentiable.

        Args:
            canonical: [B, N, 3], metres.
            bone_transforms: [B, J, 4, 4], canonical to posed, metres.
        """
        return self._forward_map(canonical, bone_transforms, with_jacobian=False).matrices()

    def _forward_map(self, canonical: Tensor, bone_transforms: Tensor, with_jacobian: bool) -> ForwardMap:
        self._check_poses(bone_transforms)
        check_points(canonical, bone_transforms, "canonical")
        batch, count = canonical.shape[:2]
        with torch.autocast(canonical.device.type, enabled=False):
            if self.searches_field:
                return map_on_field(self.field, canonical, bone_transforms, with_jacobian)
            pose = torch.arange(batch, device=canonical.device).repeat_interleave(count)
            if not with_jacobian:  # without corners, in a fifth of the time
                weights = self.skinning_weights(canonical.reshape(-1, 3), pose_index=pose)
                return map_by_weights(weights.reshape(batch, count, self.num_bones), canonical, bone_transforms)
            corners, local = self.corner_weights(canonical.reshape(-1, 3), pose)
            transforms = blend_transforms(corners.reshape(batch, 1, count, 8, self.num_bones), bone_transforms)
            transforms = transforms.reshape(batch, count, 8, 12)
            size = self.grid.cell_size(self.shape)
            return map_in_cells(transforms, local.reshape(batch, count, 3), canonical, size, with_jacobian)

    def _check_poses(self, bone_transforms: Tensor, weights: NodeWeights | None = None) -> None:
        """Raise ValueError or TypeError for transforms that are not [B, J, 4, 4], or for either if it does not fit."""
        check_tensor("bone_transforms", bone_transforms)
        given, shape = {"bone_transforms": bone_transforms}, list(bone_transforms.shape)
        if len(shape) != 4 or shape[1:] != [self.num_bones, 4, 4]:
            raise ValueError(f"bone_transforms: wanted shape [B, {self.num_bones}, 4, 4], got {shape}")
        if weights is not None:
            given["weights"], wanted = weights.values, [*self.shape, self.num_bones]
            if list(weights.values.shape) not in (wanted, [shape[0], *wanted]):
                raise ValueError(
                    f"weights: wanted shape {wanted}, or {[shape[0], *wanted]} for weights of each pose, "
                    f"got {list(weights.values.shape)}"
                )
        for name, tensor in given.items():
            if tensor.dtype != self.lower.dtype:
                raise TypeError(f"{name}: wanted the dtype of the deformer, {self.lower.dtype}, got {tensor.dtype}")
            if tensor.device != self.lower.device:
                raise ValueError(f"{name}: wanted the device of the deformer, {self.lower.device}, got {tensor.device}")

    # ---------------------------------------------------------------- boxes
    def posed_box(self, bone_transforms: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box around the images of `cells` in one pose, metres.

        It bounds the field that is trilinear between the nodes. A field that is searched directly may exceed it slightly.

        Args:
            bone_transforms: [J, 4, 4], canonical to posed.
            cells: [D-1, H-1, W-1], bool, at least one.
        """
        if bone_transforms.ndim != 3:
            raise ValueError(f"bone_transforms: wanted [{self.num_bones}, 4, 4], one pose, got {list(bone_transforms.shape)}")
        self._check_poses(bone_transforms[None])
        self._check_cells("cells", cells)
        lower, upper = self._box_of_nodes(bone_transforms[None], cells)
        lower, upper = torch.stack([lower[0], upper[0]]).cpu()  # one copy from a GPU
        return lower, upper

    def _box_of_nodes(self, bone_transforms: Tensor, cells: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the corners, [B, 3] each, of boxes around the images of `cells`, or of the active cells if None."""
        transforms = blend_transforms(self.weight_grid(poses=len(bone_transforms)), bone_transforms)
        boxes = posed_boxes(transforms, self.grid, self.shape, self.active_cells if cells is None else cells)
        return boxes[:, 0], boxes[:, 1]
