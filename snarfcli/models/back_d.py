"""Back-D: a displacement from the posed to the canonical frame, predicted directly (SNARF Sec. 4.2)."""

from __future__ import annotations

from torch import Tensor

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.models.pointwise import PointwiseSystem, PosedNetwork, into_root_frame
from snarfcli.models.system import pose_angles

__all__ = ["BackD"]


class BackD(PointwiseSystem):
    """A network of the posed point and the pose gives the way to the canonical point.

    It starts from no displacement at all. Points are taken back with the root bone first, so that the network need not learn
    where the body stands.

    Arguments: as `PointwiseSystem`.
    """

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        scale = float((grid.upper - grid.lower).max()) / 2
        self.displacement = PosedNetwork(3 * (skeleton.num_joints - 1), 3, self.config, scale, starts_at_zero=True)

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, None]:
        rooted = into_root_frame(points, bone_transforms)
        return rooted + self.displacement.scale * self.displacement(rooted, pose_angles(pose)), None
