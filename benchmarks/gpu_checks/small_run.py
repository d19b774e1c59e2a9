"""Every kernel on little work, for compute-sanitizer and ncu, which make a program many times slower.

python benchmarks/gpu_checks/small_run.py --device cuda --pack outputs/gpu_check
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace

import torch
from torch import nn

if __name__ == "__main__":  # the folders of the benchmarks and of the package
    sys.path[:0] = [str(folder) for folder in Path(__file__).resolve().parents[1:3]]

from gpu_checks.scene_cases import NEAR, POSES, Scenes
from snarfcli.avatar import Avatar
from snarfcli.deformer import SearchConfig, find_correspondences
from snarfcli.training.optimizer import AveragedAdam

__all__ = ["main"]


def _searches(scenes: Scenes, count: int) -> int:
    """Run both searches of this package, their gradient, and the released search; return the number of roots."""
    roots = 0
    for pose, cells in ((POSES[0], NEAR), (POSES[1], "all cells")):
        case = scenes.case(pose, cells, count, batch=2)
        found = case.complete(case.capacity())
        case.backward(found, torch.ones_like(found[0]))
        roots += int(found[3]) + int(case.released().valid.sum())
        search = SearchConfig("broyden", init_bones=case.nine, backend="native")
        weights = case.weights.clone().requires_grad_()
        broyden = find_correspondences(case.points, case.bones, weights, case.grid, search=search)
        broyden.canonical.square().sum().backward()
        roots += len(broyden.query)
    return roots


@torch.no_grad()
def _queries(avatar: Avatar, scenes: Scenes, count: int) -> int:
    """Query an avatar in every pose and precision; return the number of points inside."""
    inside = 0
    for pose in POSES:
        points = scenes.case(pose, NEAR, count).points
        angles = scenes.saved["poses"][pose]["pose"][None].to(points.device)
        found = avatar.find(points, avatar.bone_transforms(angles.cpu()), angles)
        for precision in ("highest", "high", "bfloat16"):
            inside += int((avatar.model.shape_at(found, angles, precision).logits > 0).sum())
    return inside


def _optimizer_steps(device: torch.device) -> float:
    """Take two steps of the optimiser without the host; return the sum of the parameters."""
    module = nn.Sequential(nn.Linear(3, 50), nn.Linear(50, 1)).to(device)
    optimizer = AveragedAdam(module, SimpleNamespace(feature_rate=1.0, average_decay=0.99))  # pyright: ignore[reportArgumentType]
    for step in range(2):
        optimizer.zero_gradients()
        module(torch.rand(20, 3, device=device)).square().sum().backward()
        rate, number, skip = (torch.tensor(value, device=device) for value in (1e-3, step, False))
        optimizer.step_on_device(rate, number, skip)
    return float(sum(parameter.detach().sum() for parameter in module.parameters()))


def main() -> None:
    parser = argparse.ArgumentParser(description="Every kernel on little work.")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--pack", type=Path, required=True, help="folder made by pack_gpu_check.py")
    parser.add_argument("--queries", type=int, default=300, help="per pose")
    parser.add_argument("--only-search", action="store_true")
    options = parser.parse_args()
    device = torch.device(options.device)
    scenes = Scenes.load(options.pack / "scenes.pt", device)
    print(f"{_searches(scenes, options.queries)} roots")
    if not options.only_search:
        for name in ("quick", "paper"):
            avatar = Avatar.load(options.pack / "avatars" / f"{name}.pt", device)
            print(f"{name}: {_queries(avatar, scenes, options.queries)} queries inside")
        print(f"parameters: {_optimizer_steps(device):.6f}")


if __name__ == "__main__":
    main()
