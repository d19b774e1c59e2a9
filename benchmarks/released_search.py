"""The search of the released Fast-SNARF in PyTorch, written from the paper and the known settings of the release.

Differences to `search="broyden"` of this package, which cost accuracy: the start Jacobian is the transpose of the blended 3x3
(no gradient of the weights, and no inverse); outside the grid the transforms are zero, so points collapse; J^-1 is the one
from before the last step; the thresholds are fixed lengths. All queries and starts go through every step together, with
`grid_sample` for the look-up; those that have converged or diverged leave.

released_search.cu has the same as CUDA kernels, released_kernels.py runs them.

Source: Fast-SNARF Sec. 3 (Eq. 7-9), Sec. 4.1 and Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.deformer import CanonicalGrid

__all__ = ["CONVERGED_M", "DIVERGED_M", "DUPLICATE_M", "STEPS", "released_search"]

CONVERGED_M = 1e-4
DIVERGED_M = 0.5
STEPS = 10
DUPLICATE_M = 1e-3  # roots of several starts agree to the convergence threshold times the norm of J^-1


def released_search(
    points: Tensor,
    bone_transforms: Tensor,
    skinning_weights: Tensor,
    grid: CanonicalGrid,
    init_bones: Sequence[int],
    steps: int = STEPS,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find correspondences as the released code does.

    Args:
        points: [B, N, 3], posed space, metres.
        bone_transforms: [B, J, 4, 4], canonical to posed.
        skinning_weights: [D, H, W, J], at the nodes of the grid.
        grid: box of the nodes.
        init_bones: bones that give a start.
        steps: maximum number of Broyden steps; 10 in Fast-SNARF, 50 in SNARF.

    Returns:
        Canonical points [M, 3], metres; index b * N + n of their queries, ascending, [M]; J^-1 [M, 3, 3].
    """
    parts = [
        _one_pose(pose_points, transforms, skinning_weights, grid, list(init_bones), steps)
        for pose_points, transforms in zip(points, bone_transforms, strict=True)
    ]
    query = torch.cat([part[1] + b * points.shape[1] for b, part in enumerate(parts)])
    return torch.cat([part[0] for part in parts]), query, torch.cat([part[2] for part in parts])


@torch.no_grad()
def _one_pose(points: Tensor, transforms: Tensor, weights: Tensor, grid: CanonicalGrid, bones: list[int], steps: int):
    nodes = weights.reshape(-1, weights.shape[-1]) @ transforms[:, :3].reshape(-1, 12)
    volume = nodes.reshape(*weights.shape[:3], 12).permute(3, 0, 1, 2)[None].contiguous()

    def blended(x: Tensor) -> Tensor:
        place = (2 * (x - grid.lower) / (grid.upper - grid.lower) - 1)[None, :, None, None]
        sampled = torch.nn.functional.grid_sample(volume, place, mode="bilinear", padding_mode="zeros", align_corners=True)
        return sampled[0, :, :, 0, 0].T.reshape(-1, 3, 4)

    def residual(x: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        rows = blended(x)
        return (rows[:, :, :3] @ x[:, :, None])[:, :, 0] + rows[:, :, 3] - target, rows

    inverse_bones = torch.linalg.inv(transforms[bones])
    starts = torch.einsum("jrc,nc->njr", inverse_bones[:, :3, :3], points) + inverse_bones[:, :3, 3]
    x, target = starts.reshape(-1, 3), points[:, None].expand(-1, len(bones), -1).reshape(-1, 3)
    start = torch.arange(len(x), device=x.device)
    error, rows = residual(x, target)
    inverse = rows[:, :, :3].transpose(1, 2).contiguous()
    canonical, jacobian_inverse = torch.zeros_like(x), x.new_zeros(len(x), 3, 3)
    valid = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    for _ in range(steps):
        step = -(inverse @ error[:, :, None])
        x = x + step[:, :, 0]
        moved, _ = residual(x, target)
        distance = moved.norm(dim=1)
        done = distance < CONVERGED_M
        finished = start[done]
        canonical[finished], jacobian_inverse[finished], valid[finished] = x[done], inverse[done], True
        going = (~done & (distance < DIVERGED_M)).nonzero()[:, 0]
        if not len(going):
            break
        change = (moved - error)[going, :, None]
        x, target, start, error = x[going], target[going], start[going], moved[going]
        step, inverse = step[going], inverse[going]
        row = step.transpose(1, 2) @ inverse
        update = (step - inverse @ change) @ row / (row @ change)
        inverse = inverse + update.nan_to_num(0, 0, 0)
    canonical, valid = canonical.reshape(-1, len(bones), 3), valid.reshape(-1, len(bones))
    for i in range(1, len(bones)):
        near = (canonical[:, :i] - canonical[:, i : i + 1]).norm(dim=-1) < DUPLICATE_M
        valid[:, i] &= ~(near & valid[:, :i]).any(1)
    query, slot = valid.nonzero(as_tuple=True)
    return canonical[query, slot], query, jacobian_inverse.reshape(-1, len(bones), 3, 3)[query, slot]
