"""Learn how a body deforms beyond skinning, from posed surfaces without correspondences.

This is the shape of TAVA, IMavatar and ARAH: the forward map is linear blend skinning plus an offset, which a network gives for
each canonical point and pose. `find_correspondences_on_map` finds the roots of the whole map, here from the roots of skinning
alone, with exact gradients to the network. The surfaces are made with a known offset, so that the result can be compared with
it. Run it with `python examples/offsets.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarf import Correspondences, ForwardDeformer, builtin_body, find_correspondences_on_map, skin
from snarf.deformer import CanonicalBody

POSES = 6
POINTS = 250  # per pose and step
FARTHEST_M = 0.05  # a scanned point whose roots are all farther from the surface counts as this far
ELBOWS, UPPER_ARMS = [18, 19], [16, 17]  # joints

Offset = Callable[[Tensor, Tensor], Tensor]  # from canonical points [K, 3] and poses [K, J, 3] to offsets [K, 3], metres


class LearnedOffset(nn.Module):
    """A network of the canonical point and the bend of the elbows."""

    def __init__(self) -> None:
        super().__init__()
        sizes = nn.Linear(9, 64), nn.Softplus(20), nn.Linear(64, 64), nn.Softplus(20), nn.Linear(64, 3, bias=False)
        self.network = nn.Sequential(*sizes)

    def forward(self, x: Tensor, pose: Tensor) -> Tensor:
        return 0.05 * self.network(torch.cat([4 * x, pose[:, ELBOWS].flatten(1)], 1))


class Muscles:
    """The known offset: the upper arms swell upwards when the elbows bend."""

    def __init__(self, body: CanonicalBody) -> None:
        joints = body.skeleton.canonical_joints
        self.middles = (joints[ELBOWS] + joints[UPPER_ARMS]) / 2

    def __call__(self, x: Tensor, pose: Tensor) -> Tensor:
        near = (-torch.cdist(x, self.middles).square() / 0.1**2).exp()
        height = 0.03 * (near * pose[:, ELBOWS].norm(dim=-1)).sum(1)
        return height[:, None] * x.new_tensor([0.0, 1.0, 0.0])


class SoftBody:
    """A deformer with an offset: x goes to LBS(x + offset(x, pose)), with the weights at x."""

    def __init__(self, deformer: ForwardDeformer, offset: Offset) -> None:
        self.deformer, self.offset = deformer, offset

    def find(self, points: Tensor, pose: Tensor, bone_transforms: Tensor) -> Correspondences:
        """Return the correspondences of posed points [B, N, 3]."""
        with torch.no_grad():
            roots, mask = self.deformer(points, bone_transforms).padded()  # [B, N, I, 3] and [B, N, I]
            starts = roots.masked_fill(~mask[..., None], torch.nan)  # NaN is no start

        def forward(x: Tensor, pose_index: Tensor) -> Tensor:
            return self.skin(x, pose[pose_index], bone_transforms[pose_index])

        return find_correspondences_on_map(points, forward, starts, self.deformer.grid)

    def skin(self, x: Tensor, pose: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return the posed points [K, 3] of canonical points [K, 3], each in its own pose."""
        weights = self.deformer.skinning_weights(x)
        moved = x + self.offset(x, pose)
        return skin(moved[:, None], weights[:, None], bone_transforms)[:, 0]  # K batches of one point


def surface_distance(x: Tensor, vertices: Tensor, normals: Tensor) -> Tensor:
    """Return the signed distance [M] of points from the canonical surface: from the plane of the nearest vertex."""
    nearest = torch.cdist(x.detach(), vertices).argmin(1)
    return ((x - vertices[nearest]) * normals[nearest]).sum(1)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return the unit normals [V, 3] of a mesh."""
    a, b, c = vertices[faces].unbind(1)
    each = torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0)
    return F.normalize(torch.zeros_like(vertices).index_add(0, faces.reshape(-1), each), dim=1)


def posed_vertices(body: SoftBody, vertices: Tensor, pose: Tensor, bone_transforms: Tensor) -> Tensor:
    """Return canonical vertices [V, 3] in all poses, [B, V, 3]."""
    index = torch.arange(len(pose)).repeat_interleave(len(vertices))
    return body.skin(vertices.repeat(len(pose), 1), pose[index], bone_transforms[index]).reshape(len(pose), -1, 3)


def random_poses(count: int) -> Tensor:
    """Return poses [count, 24, 3] with bent arms, axis-angle, radians."""
    pose = torch.zeros(count, 24, 3)
    pose[:, UPPER_ARMS + ELBOWS, 1:] = 0.5 * torch.randn(count, 4, 2)
    return pose


def train(steps: int, seed: int = 0) -> list[tuple[float, float]]:
    """Return two errors before each step, in millimetres, root mean square.

    The first is the distance of scanned points from the surface. The second is that of the posed vertices of the upper arms
    from the true ones, in poses of which there is no scan.
    """
    torch.manual_seed(seed)
    body = builtin_body()
    deformer = ForwardDeformer.from_body(body)
    canonical = deformer.body
    assert canonical is not None
    deformer.freeze()  # the weights stay as they are: the grid is kept
    normals = vertex_normals(canonical.vertices, body.faces)
    truth = SoftBody(deformer, Muscles(canonical))
    offset = LearnedOffset()
    learned = SoftBody(deformer, offset)
    arms = canonical.vertices[canonical.weights[:, UPPER_ARMS].sum(1) > 0.5]
    pose, unseen = random_poses(POSES), random_poses(POSES)
    transforms, others = canonical.posed_from_canonical(pose), canonical.posed_from_canonical(unseen)

    optimizer = torch.optim.Adam(offset.parameters(), lr=3e-3)
    history = []
    for _ in range(steps):
        chosen = canonical.vertices[torch.randint(len(canonical.vertices), (POINTS,))]
        with torch.no_grad():
            points = posed_vertices(truth, chosen, pose, transforms)
            difference = posed_vertices(truth, arms, unseen, others) - posed_vertices(learned, arms, unseen, others)
        found = learned.find(points, pose, transforms)
        distance = found.minimum(surface_distance(found.canonical, canonical.vertices, normals).abs(), empty=FARTHEST_M)
        loss = distance.clamp_max(FARTHEST_M).square().mean()
        error = difference.square().sum(-1).mean()
        history.append((1e3 * loss.sqrt().item(), 1e3 * error.sqrt().item()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return history


if __name__ == "__main__":
    for step, (distance, error) in enumerate(train(steps=101)):
        if step % 10 == 0:
            print(f"step {step:3}: scans {distance:.2f} mm from the surface, arms in unseen poses {error:.2f} mm off")
