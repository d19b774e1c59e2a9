"""Times of the canonical network and of whole queries, eager and in a CUDA graph, in three precisions."""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import torch
from common import in_pytorch
from released_kernels import released_search_native
from torch import Tensor

from gpu_checks.context import AVATARS, PRECISIONS, Context
from gpu_checks.scene_cases import POSES
from gpu_checks.timing import Timing
from snarfcli.avatar import Avatar
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import start_transforms
from snarfcli.models import system
from snarfcli.models.fast_snarf import FastSnarf, FoundRoots

__all__ = ["run"]

_SPARE = 1024
_COUNT = 200_000


class Query:
    """One avatar and queries in one pose."""

    def __init__(self, context: Context, avatar: Avatar, pose: str) -> None:
        saved = context.scenes.saved["poses"][pose]
        case = context.scenes.case(pose, "all cells", context.size(_COUNT, 400))
        assert isinstance(avatar.model, FastSnarf)
        self.avatar, self.model = avatar, avatar.model
        self.points, self.nine = case.points, case.nine
        self.pose: Tensor = saved["pose"][None].to(context.device)
        self.bones = avatar.bone_transforms(saved["pose"][None])
        self.weights = self.model.node_weights()
        self.found = self.model.find(self.points, self.bones, self.pose, self.weights)
        self.capacity = len(self.found.roots.query) + _SPARE

    def network(self, precision: str) -> Tensor:
        """Evaluate the canonical network at the roots."""
        return self.model.shape_at(self.found, self.pose, precision).logits

    def whole(self, precision: str) -> Tensor:
        """Search with a capacity, and evaluate the shape at the roots; never waits."""
        roots = self.model.deformer(self.points, self.bones, capacity=self.capacity, weights=self.weights)
        return self.model.shape_at(FoundRoots(roots, self.weights), self.pose, precision).logits

    def called(self, precision: str) -> Tensor:
        """Evaluate as users do."""
        return self.avatar.query(self.points, self.bones, self.pose, precision).logits

    def released(self, precision: str) -> Tensor:
        """Run the released search, gather its roots, and evaluate the network at them."""
        deformer = self.model.deformer
        assert self.weights is not None
        transforms = blend_transforms(self.weights.values, self.bones)
        starts = start_transforms(self.bones, self.nine)
        found = released_search_native(self.points, transforms, starts, deformer.grid, deformer.shape)
        canonical = found.canonical[found.valid]
        pose = torch.zeros(len(canonical), dtype=torch.long, device=canonical.device)
        logits = self.model.canonical_logits(canonical, self.model.condition(self.pose), pose, precision)
        padded = logits.new_full(found.valid.shape, -1000.0).masked_scatter(found.valid, logits)
        return padded.amax(-1)


@torch.no_grad()
def run(context: Context) -> None:
    """Time the networks and whole queries of the packed avatars."""
    context.section.say(
        "Milliseconds, median (least-most). Network: the shape at the roots of the queries, and their maximum. Whole:",
        "blending, search with room for all roots, and shape. Called: `Avatar.query`. Released, as called: blending, the",
        "released search, its roots gathered, and the same network layer by layer in PyTorch. Labels: queries that the",
        "precision puts on the other side of the surface than float32 does.",
    )
    rows, goal = [], []
    for name in AVATARS:
        avatar = context.avatar(name)
        for pose in POSES:
            query = Query(context, avatar, pose)
            times = _times(context, query)
            rows += _rows(context, f"{name}, {pose}", query, times)
            if name == "paper":
                goal.append((pose, times))
    header = ["avatar, pose", "roots", "precision", "network", "network, graph", "whole", "whole, graph", "called"]
    context.section.table([*header, "released, float32", "its ratio", "released, TF32", "its ratio", "labels"], rows)
    _state_goal(context, goal)


def _times(context: Context, query: Query) -> dict[str, Timing]:
    """Return the times of all works on one query."""
    works: dict[str, Callable[[], object]] = {}
    for precision in PRECISIONS:
        works[f"network {precision}"] = works[f"network graph {precision}"] = lambda p=precision: query.network(p)
        works[f"whole {precision}"] = works[f"whole graph {precision}"] = lambda p=precision: query.whole(p)
        works[f"called {precision}"] = lambda p=precision: query.called(p)
    captured = tuple(name for name in works if "graph" in name)
    times = context.clock.in_turns(works, context.size(10, 1), captured)
    rivals = {f"released {precision}": lambda p=precision: query.released(p) for precision in ("highest", "high")}
    with in_pytorch(), mock.patch.object(system, "can_evaluate", return_value=False):
        return times | context.clock.in_turns(rivals, context.size(10, 1))


def _rows(context: Context, title: str, query: Query, times: dict[str, Timing]) -> list[list[str]]:
    """Return one row for each precision."""
    reference, rows = query.network("highest") > 0, []
    roots = f"{len(query.found.roots.query):,}"
    for precision, shown in PRECISIONS.items():
        mine = [times[f"{kind} {precision}"] for kind in ("network", "network graph", "whole", "whole graph", "called")]
        cells = [str(timing) for timing in mine]
        for other in ("highest", "high"):
            rival = times[f"released {other}"]
            cells += [f"{rival.median:.2f}", rival.over(times[f"whole graph {precision}"])]
        labels = int(((query.network(precision) > 0) != reference).sum())
        rows.append([title, roots, shown, *cells, str(labels)])
        context.section.number(f"field/{title}/{precision}/labels", labels)
    for name, timing in times.items():
        context.section.number(f"field/{title}/{name}/ms", timing.median)
    return rows


def _state_goal(context: Context, measured: list[tuple[str, dict[str, Timing]]]) -> None:
    """State how far the papers' network is ahead: the worst pose, in our fastest precision, beside float32 in PyTorch."""
    worst, note = float("inf"), ""
    for pose, times in measured:
        best = min(PRECISIONS, key=lambda precision: times[f"whole graph {precision}"].median)
        ours = times[f"whole graph {best}"].median
        ratio, lenient = (times[f"released {other}"].median / ours for other in ("highest", "high"))
        if not ratio >= worst:
            worst = ratio
            note = f"{pose}, ours in {PRECISIONS[best]}, the released in float32; {lenient:.1f} with the released in TF32"
    context.section.goal("query", worst, note)
