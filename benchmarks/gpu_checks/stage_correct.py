"""The GPU's roots beside those of the CPU library, and beside a second run."""

from __future__ import annotations

import torch

from gpu_checks.context import Context
from gpu_checks.scene_cases import NEAR, Case
from snarfcli.deformer import SearchConfig, find_correspondences

__all__ = ["run"]

_OFF_M = 1e-4
_HEADER = ["case", "queries", "roots", "queries with another number of roots", "roots off by more than 0.1 mm", "median, m"]


def run(context: Context) -> None:
    """Compare the searches of some cases with the CPU library."""
    chosen = [("knees", NEAR, 100_000), ("deep_squats", NEAR, 100_000), ("deep_squats", "all cells", 50_000)]
    rows = []
    for pose, cells, count in chosen[: context.size(3, 2)]:
        case = context.scenes.case(pose, cells, context.size(count, 500))
        rows.append([case.name, f"{case.points.shape[1]:,}", *_compare(context, case)])
    context.section.table([*_HEADER, "same bits again", "J^-1 off by more than 1 %"], rows)


def _compare(context: Context, case: Case) -> list[str]:
    """Return the cells of one row."""
    found, again = case.complete(), case.complete()
    same = all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
    active = None if case.active is None else case.active.cpu()
    given = (case.points.cpu(), case.bones.cpu(), case.weights.cpu(), case.grid.to(case.points.cpu()))
    wanted = find_correspondences(*given, search=SearchConfig(), active_cells=active)
    total = case.points.shape[0] * case.points.shape[1]
    canonical, query, inverse = (part.cpu() for part in found[:3])
    here, there = (torch.bincount(numbers, minlength=total) for numbers in (query, wanted.query))
    equal = here == there
    mine, theirs = equal[query], equal[wanted.query]
    distance = (canonical[mine] - wanted.canonical[theirs]).norm(dim=1)
    change = (inverse[mine] - wanted.jacobian_inverse[theirs]).flatten(1).norm(dim=1)
    off = int((change > 0.01 * wanted.jacobian_inverse[theirs].flatten(1).norm(dim=1)).sum())
    others, far = int((~equal).sum()), int((distance > _OFF_M).sum())
    context.section.number(f"correct/{case.name}/other number of roots", others)
    context.section.number(f"correct/{case.name}/roots off", far)
    return [f"{len(query):,}", str(others), str(far), f"{distance.median():.1e}", str(same), str(off)]
