"""Pose-ONet: an occupancy network of posed point and pose (SNARF Sec. 4.2, Fast-SNARF Sec. 5.1.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from snarfcli.models.pointwise import PointwiseSystem, into_root_frame, move_with_bones
from snarfcli.models.system import Found
from snarfcli.shape import OccupancyNetwork

__all__ = ["PoseONet"]


class PoseONet(PointwiseSystem):
    """The pose is concatenated to the posed point at the input of one network, which does not use bones.

    Points are moved back with the root bone, so that the network need not learn the position of the body. The network is that
    of the canonical shape, except that the pose enters at the input and that there are neither capsules nor feature grids,
    which would have to move with the pose. It takes the whole pose for every `condition`.

    Arguments: as `PointwiseSystem`.
    """

    has_canonical_shape: ClassVar[bool] = False

    def _make_shape(self, bones: Tensor, box: tuple[Tensor, Tensor]) -> OccupancyNetwork:
        pose_size = 3 * (self.num_bones - 1)
        at_input = {"condition_layer": 0, "condition_size": pose_size, "condition_at_start": True}
        shape = replace(self.config.shape, **at_input, prior_radius_m=None, feature_cells_m=[])
        return OccupancyNetwork(shape, pose_size, bones)

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, None]:
        return into_root_frame(points, bone_transforms), None

    def bone_logits(
        self,
        points: Tensor,
        owner: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        precision: str = "highest",
        found: Found | None = None,
    ) -> Tensor:
        """Return logits at the posed points of the bones, [B, M], since there is no canonical shape."""
        return self(move_with_bones(points, owner, bone_transforms), bone_transforms, pose, precision).logits
