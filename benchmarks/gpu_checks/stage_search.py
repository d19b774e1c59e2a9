"""Times of the searches and of their gradient, ours beside the released algorithm in the same run."""

from __future__ import annotations

import math

import torch

from gpu_checks.context import Context
from gpu_checks.scene_cases import NEAR, Case

__all__ = ["run", "run_gradient"]

_STEPS = (10, 50)  # Broyden steps of Fast-SNARF and of SNARF
_COUNTS = (20_000, 200_000, 2_000_000)
_TINY = (50, 500, 1000)
_GOAL_COUNT = 200_000
_CASES = (("knees", NEAR), ("knees", "all cells"), ("deep_squats", NEAR), ("deep_squats", "all cells"))


def run(context: Context) -> None:
    """Time both searches for growing numbers of queries."""
    context.section.say(
        "Milliseconds, median (least-most), the searches in turns. In a graph: replayed from a CUDA graph, ours with room for",
        "all roots, so that only the device counts. As called: through the operator, with the wait for the number of roots.",
        "Released: the released algorithm as kernels of our own (released_search.cu) in a graph, with nine start bones and 10",
        "(Fast-SNARF) or 50 steps (SNARF), its roots left padded; as called: with 10 steps, its roots gathered. Both sides",
        "get blended transforms. Ratio: of the times in graphs, with 10 steps. Roots: those of ours, and the number of the",
        "released search's as a percentage.",
    )
    rows, ratios = [], {}
    for pose, cells in _CASES:
        for count, tiny in zip(_COUNTS, _TINY, strict=True):
            case = context.scenes.case(pose, cells, context.size(count, tiny))
            cells_of_row, ratio = _row(context, case)
            rows.append([case.name, f"{case.points.shape[1]:,}", *cells_of_row])
            if count == _GOAL_COUNT:
                ratios[case.name] = ratio
    header = ["case", "queries", "ours, in a graph", "ours, as called", "released, as called", "released, 10 steps, graph"]
    context.section.table([*header, "50 steps, graph", "ratio", "ratio as called", "roots", "released, %"], rows)
    near = f"knees, {NEAR}"
    worst = min(ratios, key=lambda name: ratios[name] if math.isfinite(ratios[name]) else -math.inf)
    context.section.goal("search_near", ratios[near], near)
    context.section.goal("search_worst", ratios[worst], worst)


def _row(context: Context, case: Case) -> tuple[list[str], float]:
    """Return the cells of one row, and how many times as long the released search with 10 steps takes."""
    capacity = case.capacity()
    works = {
        "graph": lambda: case.complete(capacity),
        "called": lambda: case.complete(),
        "released called": case.released_roots,
        **{f"released {steps}": lambda steps=steps: case.released(steps) for steps in _STEPS},
    }
    captured = ("graph", *(f"released {steps}" for steps in _STEPS))
    times = context.clock.in_turns(works, context.size(20, 2), captured)
    roots, theirs = len(case.complete()[1]), int(case.released().valid.sum())
    for name, timing in times.items():
        context.section.number(f"search/{case.name}/{case.points.shape[1]}/{name}/ms", timing.median)
    ratio = times["released 10"].median / times["graph"].median
    shown = [str(timing) for timing in times.values()]
    ratios = [times["released 10"].over(times["graph"]), times["released called"].over(times["called"])]
    return [*shown, *ratios, f"{roots:,}", f"{100 * theirs / max(roots, 1):.1f}"], ratio


def run_gradient(context: Context) -> None:
    """Time the implicit gradient beside the search, for queries and for a training batch."""
    cases = [
        context.scenes.case("knees", NEAR, context.size(200_000, 500)),
        context.scenes.case("deep_squats", NEAR, context.size(200_000, 500)),
        context.scenes.case("knees", NEAR, context.size(2250, 50), batch=8),
    ]
    rows = []
    for case in cases:
        capacity = case.capacity()
        found = case.complete(capacity)
        gradient = torch.randn(capacity, 3, device=context.device)
        works = {
            "search": lambda case=case, capacity=capacity: case.complete(capacity),
            "gradient": lambda case=case, found=found, gradient=gradient: case.backward(found, gradient),
        }
        times = context.clock.in_turns(works, context.size(20, 2), ("search", "gradient"))
        size = f"{case.points.shape[0]} x {case.points.shape[1]:,}"
        context.section.number(f"gradient/{case.name}/{size}/ms", times["gradient"].median)
        rows.append([case.name, size, *(str(t) for t in times.values()), times["gradient"].over(times["search"])])
    context.section.say("Both in a CUDA graph, milliseconds; the gradient by the queries and by the transforms of the nodes.")
    context.section.table(["case", "queries", "search", "gradient", "gradient / search"], rows)
