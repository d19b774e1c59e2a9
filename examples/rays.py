"""Learn a canonical field and the poses of the frames from pictures, by volume rendering.

This is the shape of InstantAvatar and IntrinsicAvatar: rays through the box of a posed body, samples in chunks, the best root
of each sample with its colour and normal, and gradients to the field and to the poses. The network is a toy, and the pictures
are drawn from a known field, so that the result can be compared with it. Run it with `python examples/rays.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarf import ForwardDeformer, Skeleton, builtin_body
from snarf.deformer import PosedDeformer

FRAMES = 4
CHUNK = 4096  # samples per frame and call: bounds the memory
SAMPLES = 32  # per ray
SOFTNESS = 0.02  # metres over which the density rises at the surface
SIZE = 48  # pixels along each side of a picture
MOVED = slice(16, 20)  # joints that move: shoulders and elbows

Field = Callable[[Tensor], tuple[Tensor, Tensor]]  # from canonical points [M, 3] to signed distances [M] and colours [M, 3]


class LearnedField(nn.Module):
    """A network that corrects the distance to points [K, 3] on the bones, metres."""

    def __init__(self, bones: Tensor) -> None:
        super().__init__()
        self.bones = bones
        self.network = nn.Sequential(nn.Linear(3, 64), nn.Softplus(100), nn.Linear(64, 64), nn.Softplus(100), nn.Linear(64, 4))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        distance, colour = self.network(4 * x).split([1, 3], dim=1)
        return torch.cdist(x, self.bones).amin(1) - 0.08 + 0.05 * distance[:, 0], colour.sigmoid()


def known_field(x: Tensor, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Return the field that the pictures are drawn from: a coloured body with a belly."""
    belly = 0.04 * (-20 * (x[:, 1] + 0.1) ** 2).exp()
    return torch.cdist(x, bones).amin(1) - 0.09 - belly, 0.5 + 0.4 * (6 * x + torch.tensor([0.0, 2.0, 4.0])).sin()


def query(posed: PosedDeformer, field: Field, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return distance [B, N], colour and posed normal [B, N, 3] at posed points [B, N, 3], of the root deepest inside."""
    found = posed(points)
    x = found.canonical.requires_grad_()  # also where neither poses nor points require a gradient
    distance, colour = field(x)
    gradient = torch.autograd.grad(distance.sum(), x, create_graph=True)[0]
    # Gradients move with the inverse transpose of the Jacobian, which is exact at the root and counts as constant.
    normal = F.normalize((found.jacobian_inverse * gradient[:, :, None]).sum(1), dim=1)
    best = found.argmin(distance)  # [B, N], the row of the winning root; -1 where there is none
    return found.gather(distance, best, 1.0), found.gather(colour, best, 0.0), found.gather(normal, best, 0.0)


def render(posed: PosedDeformer, field: Field, origins: Tensor, directions: Tensor) -> Tensor:
    """Return the colours [B, R, 3] that rays [B, R, 3] see, lit from the camera, on black."""
    lower, upper = (corner[:, None] for corner in posed.box)  # a sample outside has no root
    crossings = torch.stack([(lower - origins) / directions, (upper - origins) / directions])
    near, far = crossings.amin(0).amax(-1).clamp_min(0), crossings.amax(0).amin(-1)
    step = (far - near).clamp_min(0)[..., None] / SAMPLES
    depths = near[..., None] + step * (torch.arange(SAMPLES) + 0.5)
    points = origins[:, :, None] + depths[..., None] * directions[:, :, None]
    parts = [query(posed, field, chunk) for chunk in points.flatten(1, 2).split(CHUNK, dim=1)]
    distance, colour, normal = (torch.cat(part, 1).unflatten(1, (-1, SAMPLES)) for part in zip(*parts, strict=True))
    light = 0.4 + 0.6 * (normal * -directions[:, :, None]).sum(-1, keepdim=True).relu()
    opacity = 1 - (-step / SOFTNESS * (-distance / SOFTNESS).sigmoid()).exp()
    passed = torch.cat([torch.ones_like(step), (1 - opacity).cumprod(-1)[..., :-1]], -1)  # of the light, up to each sample
    return ((passed * opacity)[..., None] * colour * light).sum(2)


def cameras(angles: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rays of cameras 4 m from the centre: origins and unit directions, [B, SIZE * SIZE, 3]."""
    back = torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], 1)[:, None]
    right = torch.stack([angles.cos(), torch.zeros_like(angles), -angles.sin()], 1)[:, None]
    v, u = torch.meshgrid(*[torch.linspace(-0.26, 0.26, SIZE)] * 2, indexing="ij")
    directions = u.reshape(-1, 1) * right + v.reshape(-1, 1) * torch.tensor([0.0, 1.0, 0.0]) - back
    return (centre + 4 * back).expand_as(directions), F.normalize(directions, dim=-1)


def points_on_bones(skeleton: Skeleton) -> Tensor:
    """Return points [K, 3] along the bones in the canonical pose, metres."""
    ends = skeleton.canonical_joints[torch.tensor(skeleton.bones)]
    return torch.lerp(ends[:, :1], ends[:, 1:], torch.linspace(0, 1, 8)[:, None]).flatten(0, 1)


def train(steps: int, rays: int = 512, seed: int = 0) -> list[tuple[float, float]]:
    """Return the mean square error of the pictures and the mean error of the poses (degrees) before each step."""
    torch.manual_seed(seed)
    deformer = ForwardDeformer.from_body(builtin_body())
    body = deformer.body
    assert body is not None
    bones = points_on_bones(body.skeleton)

    truth = torch.zeros(FRAMES, 24, 3)  # axis-angle, radians
    truth[:, MOVED, 1:] = 0.4 * torch.randn(FRAMES, 4, 2)
    centre = (bones.amin(0) + bones.amax(0)) / 2
    views = [cameras((torch.arange(FRAMES) + side) * math.pi / 2, centre) for side in (0.5, 1.5)]
    origins, directions = (torch.cat(parts, 1) for parts in zip(*views, strict=True))  # two pictures per frame
    posed = deformer.pose(body.posed_from_canonical(truth))
    pictures = render(posed, lambda x: known_field(x, bones), origins, directions).detach()

    field = LearnedField(bones)
    turns = nn.Parameter(truth[:, MOVED] + 0.2 * torch.randn(FRAMES, 4, 3) * torch.tensor([0.0, 1.0, 1.0]))
    optimizer = torch.optim.Adam([*field.parameters(), turns], lr=1e-2)
    history = []
    for _ in range(steps):
        pose = torch.cat([truth[:, : MOVED.start], turns, truth[:, MOVED.stop :]], 1)
        posed = deformer.pose(body.posed_from_canonical(pose))  # once per step, for all chunks
        chosen = torch.randint(origins.shape[1], (FRAMES, rays, 1)).expand(-1, -1, 3)
        seen = render(posed, field, origins.gather(1, chosen), directions.gather(1, chosen))
        loss = F.mse_loss(seen, pictures.gather(1, chosen))
        history.append((loss.item(), (turns - truth[:, MOVED]).norm(dim=-1).mean().rad2deg().item()))
        optimizer.zero_grad()
        loss.backward()  # once: the gradients of all chunks reach the poses together
        optimizer.step()
    return history


if __name__ == "__main__":
    for step, (error, angle) in enumerate(train(steps=101)):
        if step % 10 == 0:
            print(f"step {step:3}: error of the pictures {error:.5f}, of the poses {angle:.1f} degrees")
