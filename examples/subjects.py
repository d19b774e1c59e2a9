"""Learn one shape and one set of skinning weights for subjects of different body shapes, from posed scans.

This is the shape of gDNA and X-Avatar: a network maps the canonical points of each subject, given its betas, to those of a mean
subject, where shape and weights are defined. So the weights differ within a batch; latent codes or facial expressions in the
place of betas work the same way. The occupancy of a point is the softmax union over its roots. The scans are made from the
built-in body, so that the result can be compared with it. Run it with `python examples/subjects.py`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarf import Body, CanonicalGrid, ForwardDeformer, PresetWeights, Skeleton, SkinningConfig, builtin_body, skin
from snarf.deformer import WeightField, cells_near

SUBJECTS = 3
NODES = (12, 48, 40)  # of the grid, along z, y, x
POINTS = 2000  # per scan and step
SHARPNESS = 20.0  # of the softmax over the roots; 5 in the released code of the papers, which give no number


def network(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 64), nn.Softplus(20), nn.Linear(64, 64), nn.Softplus(20), nn.Linear(64, outputs))


class Warp(nn.Module):
    """From canonical points [K, 3] of subjects with betas [K, S] to those of the mean subject."""

    def __init__(self, betas: int) -> None:
        super().__init__()
        self.network = network(3 + betas, 3)

    def forward(self, x: Tensor, betas: Tensor) -> Tensor:
        return x + 0.1 * self.network(torch.cat([2 * x, betas], 1))


class SubjectWeights(WeightField):
    """The weights of the mean subject at warped points. They are those of the batch in `betas` [B, S]."""

    def __init__(self, mean: PresetWeights, warp: Warp) -> None:
        super().__init__()
        self.mean, self.warp = mean, warp
        self.betas = torch.empty(0)

    def forward(self, x: Tensor, pose_index: Tensor) -> Tensor:  # a parameter of this name gets the sample of each point
        return self.mean(self.warp(x, self.betas[pose_index]))


class Subjects(nn.Module):
    """Occupancy of posed points for a batch of subjects and poses."""

    def __init__(self, mean: PresetWeights, grid: CanonicalGrid, cells: Tensor, bones: Tensor, betas: int) -> None:
        super().__init__()
        self.warp = Warp(betas)
        self.weights = SubjectWeights(mean, self.warp)
        settings = SkinningConfig(resolution=list(NODES[::-1]))
        self.deformer = ForwardDeformer(grid, 24, settings, active_cells=cells, field=self.weights)
        self.bones = bones
        self.shape = network(3, 1)

    def logits(self, x: Tensor) -> Tensor:
        """Return the logits [K] of the mean subject's occupancy, which start from the distance to the bones."""
        return 40 * (0.08 - torch.cdist(x, self.bones).amin(1)) + 4 * self.shape(4 * x)[:, 0]

    def forward(self, points: Tensor, betas: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return the probability [B, N] that posed points [B, N, 3] are inside."""
        self.weights.betas = betas
        found = self.deformer(points, bone_transforms)
        inside = self.logits(self.warp(found.canonical, betas[found.pose])).sigmoid()
        return found.blend(inside, SHARPNESS, empty=0.0)


def canonical_vertices(body: Body, betas: Tensor) -> Tensor:
    """Return the vertices [V, 3] of a subject in its canonical pose, metres."""
    skeleton = body.skeleton(betas)
    return skin(body.shaped(betas)[0], body.weights, skeleton.posed_from_rest(skeleton.canonical_pose[None])[0])


def points_on_bones(skeleton: Skeleton) -> Tensor:
    """Return points [K, 3] along the bones in the canonical pose, metres."""
    ends = skeleton.canonical_joints[torch.tensor(skeleton.bones)]
    return torch.lerp(ends[:, :1], ends[:, 1:], torch.linspace(0, 1, 8)[:, None]).flatten(0, 1)


def normals_of(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return the unit normals [B, V, 3] of a mesh with vertices [B, V, 3]."""
    a, b, c = vertices[:, faces].unbind(2)
    each = torch.linalg.cross(b - a, c - a).repeat_interleave(3, 1)
    return F.normalize(torch.zeros_like(vertices).index_add(1, faces.reshape(-1), each), dim=-1)


def make_model(body: Body, canonical: Tensor) -> Subjects:
    """Return an untrained model for subjects with canonical vertices [B, V, 3], the mean subject last."""
    grid = CanonicalGrid.around(canonical.flatten(0, 1), [0.1, 0.1, 0.15])
    cells = cells_near(grid, NODES, [(canonical[:, ::20].flatten(0, 1), 0.12)])
    mean = PresetWeights.from_vertices(canonical[-1], body.weights, grid, NODES)
    return Subjects(mean, grid, cells, points_on_bones(body.skeleton()), body.num_betas)


def scan(body: Body, betas: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose each subject at random, and return points near vertices `chosen` [N], distances and bone transforms.

    They are [B, N, 3], [B, N] (negative inside) and [B, J, 4, 4], metres.
    """
    pose = 0.3 * torch.randn(len(betas), 1, 24, 3)
    vertices = torch.cat([body.pose(one, shape).vertices for one, shape in zip(pose, betas, strict=True)])
    transforms = [body.skeleton(shape).posed_from_canonical(one) for one, shape in zip(pose, betas, strict=True)]
    distance = 0.02 * torch.randn(len(betas), len(chosen))
    points = vertices[:, chosen] + distance[..., None] * normals_of(vertices, body.faces)[:, chosen]
    return points, distance, torch.cat(transforms)


def train(steps: int, seed: int = 0) -> list[dict[str, float]]:
    """Return some figures before each step.

    They are the loss of the occupancy, the share of points on the right side of the surface, and at the vertices of the
    subjects the error of the warp and the mean L1 error of the weights.
    """
    torch.manual_seed(seed)
    body = builtin_body()
    betas = 1.5 * torch.randn(SUBJECTS, body.num_betas)
    canonical = torch.stack([canonical_vertices(body, shape) for shape in [*betas, torch.zeros(0)]])
    model = make_model(body, canonical)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    index = torch.arange(SUBJECTS).repeat_interleave(POINTS)
    history = []
    for _ in range(steps):
        chosen = torch.randint(len(body.weights), (POINTS,))
        points, distance, transforms = scan(body, betas, chosen)
        inside = model(points, betas, transforms)
        occupancy = F.binary_cross_entropy(inside.clamp(1e-4, 1 - 1e-4), (distance < 0).float())
        at = canonical[:-1, chosen].flatten(0, 1)
        offset = model.warp(at, betas[index]) - canonical[-1, chosen].repeat(SUBJECTS, 1)
        warp = offset.square().sum(1).mean()
        error = (model.weights(at, index) - body.weights[chosen].repeat(SUBJECTS, 1)).abs().sum(1).mean()
        right = ((inside > 0.5) == (distance < 0)).float().mean()
        figures = {"loss": occupancy, "right": right, "warp in mm": 1e3 * warp.sqrt(), "weights": error}
        history.append({name: value.item() for name, value in figures.items()})
        optimizer.zero_grad()
        (occupancy + 100 * warp).backward()
        optimizer.step()
    return history


if __name__ == "__main__":
    for step, row in enumerate(train(steps=101)):
        if step % 10 == 0:
            print(f"step {step:3}: " + ", ".join(f"{name} {value:.3f}" for name, value in row.items()))
