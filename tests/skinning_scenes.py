"""Small weight fields and poses for the deformer's tests, and an exhaustive search to compare with."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.bodies import axis_angle_to_matrix
from snarfcli.deformer import CanonicalGrid, blend_transforms
from snarfcli.deformer.complete import posed_cell_boxes
from snarfcli.deformer.grid import cell_corners, trilinear_weights
from snarfcli.deformer.skinning import forward_jacobian


def smooth_weights(shape: tuple[int, int, int], bones: int, seed: int = 0, dtype=torch.float64) -> Tensor:
    """Return weights [D, H, W, J] that are a softmax of distances to random bone centres."""
    generator = torch.Generator().manual_seed(seed)
    grid = unit_grid(dtype)
    centres = torch.rand(bones, 3, generator=generator, dtype=torch.float64).to(dtype) * 2 - 1
    distance = (grid.nodes(shape)[..., None, :] - centres).norm(dim=-1)
    return torch.softmax(-4 * distance, -1)


def unit_grid(dtype=torch.float64) -> CanonicalGrid:
    """Return a box of two metres a side, not quite centred."""
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
    """Return queries [N, 3] that have a root under one pose [J, 4, 4], and the canonical points they were made from."""
    grid = unit_grid(weights.dtype)
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, 3, generator=generator, dtype=torch.float64).to(weights.dtype)
    canonical = grid.lower + share * (grid.upper - grid.lower)
    return move(canonical, weights, transforms, grid), canonical


def exhaustive_roots(points: Tensor, weights: Tensor, transforms: Tensor, grid: CanonicalGrid, levels: int = 4):
    """Find all roots of one pose in float64: cut cells into eight, `levels` times, while their posed box holds the query.

    Within a sub-cell the field is trilinear too, so the same bound holds with its own corner transforms. From the centre of
    each remaining sub-cell Newton's method is run; roots are kept if they lie in their sub-cell.

    Returns:
        List of [K, 3] tensors, one for each query.
    """
    shape = weights.shape[:3]
    total = (shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1)
    corners = cell_corners(torch.arange(total), shape)
    node_transforms = blend_transforms(weights, transforms[None])[0]
    all_origins = grid.nodes(shape).reshape(-1, 3)[corners[:, 0]]
    cell_size = grid.cell_size(shape)
    query = torch.arange(len(points)).repeat_interleave(total)
    cell = torch.arange(total).repeat(len(points))
    low = torch.zeros(len(cell), 3, dtype=points.dtype)
    side = 1.0
    for level in range(levels + 1):
        local = low[:, None] + side * torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
        sub = torch.bmm(trilinear_weights(local), node_transforms[corners[cell]])
        lower, upper = posed_cell_boxes(sub, all_origins[cell] + low * cell_size, side * cell_size)
        slack = 1e-9
        keep = ((points[query] >= lower - slack) & (points[query] <= upper + slack)).all(1)
        query, cell, low = query[keep], cell[keep], low[keep]
        if level < levels:
            side /= 2
            offsets = side * torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
            low = (low[:, None] + offsets).reshape(-1, 3)
            query, cell = query.repeat_interleave(8), cell.repeat_interleave(8)
    local = low + side / 2
    for _ in range(30):
        posed, jacobian = forward_jacobian(node_transforms[corners[cell]], local, all_origins[cell], cell_size)
        step = torch.linalg.solve(jacobian + 1e-14 * torch.eye(3), posed - points[query])
        local = local - step / (step.abs().amax(1, keepdim=True) / (2 * side)).clamp_min(1)
    posed, _ = forward_jacobian(node_transforms[corners[cell]], local, all_origins[cell], cell_size)
    good = ((posed - points[query]).norm(dim=1) < 1e-10) & (local >= -1e-7).all(1) & (local <= 1 + 1e-7).all(1)
    canonical = all_origins[cell] + local * cell_size
    found = []
    for q in range(len(points)):
        roots: list[Tensor] = []
        for root in canonical[good & (query == q)]:
            if all((root - other).norm() > 1e-6 for other in roots):
                roots.append(root)
        found.append(torch.stack(roots) if roots else canonical.new_empty(0, 3))
    return found
