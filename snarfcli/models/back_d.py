"""Back-D: a displacement from the posed to the canonical frame, predicted directly (SNARF Sec. 4.2)."""

from __future__ import annotations

from torch import Tensor

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.models.pointwise import PointwiseSystem, PosedNetwork, into_root_frame
from snarfcli.models.system import pose_angles

__all__ = ["BackD"]


class BackD(PointwiseSystem):
    """A network of the posed point and the pose predicts the displacement to the canonical point.

    The displacement is almost zero before training. Points are first moved back with the root bone, so that the network need
    not learn the position of the body.

    Arguments: as `PointwiseSystem`.
    """

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        scale = float((grid.upper - grid.lower).max()) / 2
        self.displacement = PosedNetwork(3 * (skeleton.num_joints - 1), 3, self.config, scale, starts_at_zero=True)

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, None]:
        rooted = into_root_frame(points, bone_transforms)
        return rooted + self.displacement.scale * self.displacement(rooted, pose_angles(pose)), None
