"""SMPL NN: skinning weights of the nearest vertex of a posed base mesh (Fast-SNARF Sec. 5.2)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.skinning import skin
from snarfcli.models.pointwise import PointwiseSystem, invert_blended
from snarfcli.shape import CONDITIONS

__all__ = ["SmplNN"]

_PAIRS_AT_ONCE = 2**26  # maximum number of distances in memory at once on a GPU
_LEAF_SIZE = 16  # decides between vertices at the same distance


class SmplNN(PointwiseSystem):
    """The base mesh is moved by linear blend skinning; each query is moved back with the weights of its nearest vertex.

    The skinning is not learned. The mesh is saved in the avatar's file, to which its licence then applies.

    Arguments: as `PointwiseSystem`; the template is that base mesh.
    """

    needs_template: ClassVar[bool] = True
    keeps_template: ClassVar[bool] = True
    has_skinning_weights: ClassVar[bool] = True
    conditions: ClassVar[tuple[str, ...]] = CONDITIONS
    vertices: Tensor
    vertex_weights: Tensor

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        if template is None:
            raise ValueError("template: wanted the base mesh, got none; model smpl_nn takes its skinning weights from it")
        self.register_buffer("vertices", torch.tensor(template.vertices, dtype=torch.float32), persistent=False)
        self.register_buffer("vertex_weights", torch.tensor(template.weights, dtype=torch.float32), persistent=False)

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        posed = skin(self.vertices, self.vertex_weights, bone_transforms)
        nearest = torch.stack([nearest_vertex(part, mesh) for part, mesh in zip(points, posed, strict=True)])
        weights = self.vertex_weights[nearest]
        return invert_blended(points, weights, bone_transforms), weights

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        return self.vertex_weights[nearest_vertex(canonical, self.vertices)]


@torch.no_grad()
def nearest_vertex(points: Tensor, vertices: Tensor) -> Tensor:
    """Return the number of the nearest of the vertices [V, 3] to each of the points [N, 3], [N]."""
    if points.device.type == "cpu":
        from scipy.spatial import KDTree

        finite = np.nan_to_num(points.detach().numpy(), posinf=1e6, neginf=-1e6)
        return torch.from_numpy(KDTree(vertices.detach().numpy(), leafsize=_LEAF_SIZE).query(finite)[1]).long()
    parts = points.split(max(1, _PAIRS_AT_ONCE // len(vertices)))
    # From differences: from a matrix product, distances of 1 cm are wrong by millimetres some metres from the origin.
    exact = "donot_use_mm_for_euclid_dist"
    return torch.cat([torch.cdist(part, vertices, compute_mode=exact).argmin(1) for part in parts])
