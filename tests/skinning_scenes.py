"""Small weight fields and poses for the deformer's tests, and an exhaustive search to compare with."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.bodies import axis_angle_to_matrix
from snarfcli.deformer import CanonicalGrid


def smooth_weights(shape: tuple[int, int, int], bones: int, seed: int = 0, dtype=torch.float64) -> Tensor:
    """Return weights [D, H, W, J] that are a softmax of distances to random bone centres."""
    generator = torch.Generator().manual_seed(seed)
    grid = unit_grid(dtype)
    centres = torch.rand(bones, 3, generator=generator, dtype=torch.float64).to(dtype) * 2 - 1
    distance = (grid.nodes(shape)[..., None, :] - centres).norm(dim=-1)
    return torch.softmax(-4 * distance, -1)


def unit_grid(dtype=torch.float64) -> CanonicalGrid:
    """Return a box with sides of two metres, not quite centred."""
    return CanonicalGrid(torch.tensor([-1.0, -0.9, -1.1], dtype=dtype), torch.tensor([1.0, 1.1, 0.9], dtype=dtype))


def random_transforms(batch: int, bones: int, angle: float, seed: int = 0, dtype=torch.float64) -> Tensor:
    """Return rigid transforms [B, J, 4, 4] with rotations of about `angle` radians and small translations."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.randn(batch, bones, 3, generator=generator, dtype=torch.float64).to(dtype) * angle
    transforms = torch.eye(4, dtype=dtype).repeat(batch, bones, 1, 1)
    transforms[..., :3, :3] = axis_angle_to_matrix(turn)
    transforms[..., :3, 3] = 0.1 * torch.randn(batch, bones, 3, generator=generator, dtype=torch.float64).to(dtype)
    return transforms


def move(canonical: Tensor, weights: Tensor, transforms: Tensor, grid: CanonicalGrid) -> Tensor:
    """Return canonical points [N, 3] in the posed frame of one pose [J, 4, 4], computed node by node."""
    shape = weights.shape[:3]
    cells = torch.tensor([shape[2] - 1, shape[1] - 1, shape[0] - 1])
    scaled = (canonical - grid.lower) / (grid.upper - grid.lower) * cells
    index = scaled.floor().long().clamp_min(0).minimum(cells - 1)
    local = scaled - index
    out = torch.zeros_like(canonical)
    for k in range(8):
        offset = torch.tensor([k & 1, k >> 1 & 1, k >> 2 & 1])
        phi = torch.where(offset.bool(), local, 1 - local).prod(1)
        node = index + offset
        w = weights[node[:, 2], node[:, 1], node[:, 0]]
        blended = torch.einsum("nj,jrc->nrc", w, transforms[:, :3])
        moved = torch.einsum("nrc,nc->nr", blended[..., :3], canonical) + blended[..., 3]
        out += phi[:, None] * moved
    return out


def posed_queries(weights: Tensor, transforms: Tensor, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return queries [N, 3] that have a root in one pose [J, 4, 4], and the canonical points they were made from."""
    grid = unit_grid(weights.dtype)
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, 3, generator=generator, dtype=torch.float64).to(weights.dtype)
    canonical = grid.lower + share * (grid.upper - grid.lower)
    return move(canonical, weights, transforms, grid), canonical


def scene(dtype=torch.float32, batch=2, count=40, bones=4, angle=0.6, shape=(6, 7, 8), seed=0):
    """Return points [B, N, 3] with roots and some without, transforms and weights."""
    weights = smooth_weights(shape, bones, seed, dtype)
    transforms = random_transforms(batch, bones, angle, seed, dtype)
    points = torch.stack([posed_queries(weights, pose, count, seed + 1)[0] for pose in transforms])
    points[:, ::7] += 5.0
    return points, transforms, weights


def exhaustive_roots(points: Tensor, weights: Tensor, transforms: Tensor, grid: CanonicalGrid) -> list[Tensor]:
    """Return all roots of one pose in float64, a [K, 3] tensor for each query (see `deformer/ground_truth.py`)."""
    from ground_truth import true_roots  # beside the deformer's tests, which put their folder on the path

    truth = true_roots(points.numpy(), weights.numpy(), transforms.numpy(), grid.lower.numpy(), grid.upper.numpy())
    return [torch.from_numpy(truth.of(q)) for q in range(len(points))]
