"""Completeness and speed of the correspondence searches.

    python benchmarks/bm_search.py                        everything
    python benchmarks/bm_search.py --quick                a minute or two
    python benchmarks/bm_search.py --only time,memory     some parts: completeness, time, scaling, memory, training
    python benchmarks/bm_search.py --out search.md        the tables also as a Markdown file

Completeness is measured against an exhaustive float64 search (tests/deformer/ground_truth.py). The searches are timed in
turns, so that their ratios hold on a busy machine too.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import arguments, median_and_spread
from scenes import QUERY_KINDS, Scene, body_scene, scenes
from scores import MATCH_M, MISS_KINDS, Scores, score
from search_costs import MEMORY_HEADER, TRAINING_HEADER, memory_rows, training_rows
from searches import Method, as_found, methods
from torch import Tensor

from snarfcli.deformer import blend_transforms
from snarfcli.native.library import instruction_set, why_unavailable
from snarfcli.runs import machine_facts
from snarfcli.sampling import winding_numbers

from ground_truth import GroundTruth, true_roots  # isort: skip (scenes puts its folder on the path)

PARTS = ("completeness", "time", "scaling", "memory", "training")
SEAM_M = 1e-5  # the tolerance of the complete search in a grid of 2 m

Scoring = dict[tuple[str, str, str], Scores]


class Report:
    """Text that is printed and kept for a file."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, *sentences: str) -> None:
        """Add a paragraph."""
        text = " ".join(sentences) + "\n"
        print(text, flush=True)
        self.lines.append(text)

    def table(self, header: list[str], rows: list[list[str]]) -> None:
        """Add a table."""
        widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
        lines = [header, ["-" * width for width in widths], *rows]
        padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
        self.say("\n".join(f"| {' | '.join(line)} |" for line in padded))


# ---------------------------------------------------------------------------------------------------- completeness
def completeness(report: Report, chosen: list[Method], quick: bool, queries: int, seam: float) -> None:
    """Compare every search with the true roots in every scene."""
    kinds = QUERY_KINDS[1:] if quick else QUERY_KINDS
    total: Scoring = {}
    rows, all_scenes = [], scenes(quick)
    orientation = np.zeros(7, np.int64)
    start = time.perf_counter()
    for scene in all_scenes:
        group = "body's weights" if "body's weights" in scene.name else "other fields"
        for cells, active in (("near", scene.near_cells), ("all", None)):
            scores = {method.name: Scores() for method in chosen}
            for kind in kinds:
                points = scene.queries(kind, queries)
                truth = _truth(scene, points, active, seam)
                inside = scene.occupied(truth.canonical)
                mask = None if active is None else active.numpy()
                for method in chosen:
                    found = method.run(points[None], scene.transforms[None], scene, active if method.uses_cells else None)
                    scores[method.name] += score(as_found(found), truth, scene, mask, inside)
                if active is None and group == "body's weights":
                    orientation += _orientation(scene, points, truth, inside)
            for name, value in scores.items():
                for key in ((group, cells, name), ("together", cells, name)):
                    total[key] = total.get(key, Scores()) + value
            one = scores[chosen[0].name]
            shares = [_share(s.found, s.roots) + " / " + _share(s.wrong_sets, s.inside, 3) for s in scores.values()]
            rows.append([scene.name, cells, f"{one.roots:,}", f"{one.roots - one.positive:,}", *shares])
    report.say("## Completeness")
    report.say(
        f"{len(all_scenes)} scenes with {queries:,} queries of each kind ({', '.join(kinds)});",
        f"{time.perf_counter() - start:.0f} s. A true root is found if one of the search's lies within {1000 * MATCH_M:g} mm,",
        "one for one. Left out, as on a seam: queries that may have another number of roots",
        f"{1e6 * seam:g} micrometres away. near: cells within 2 cm of the body; all: every cell. Wrong decisions: share of the",
        "points inside (union over the true roots, perfect canonical shape) that come out wrong, either way; by sets: a",
        "matched root is judged at its true place, so that missing and false roots alone count.",
    )
    header = ["fields", "cells", "search", "roots found, %", "missed", "det J > 0 found, %", "missed", "wrong decisions, %"]
    header += ["by sets, %", "false roots", "duplicates", "J^-1 error, median", "99 %", "worst", "seams, of queries"]
    report.table(header, [[*key, *_cells(value)] for key, value in sorted(total.items(), key=lambda item: item[0][:2])])
    report.say("Where the missed roots lie (det J > 0 / det J < 0):")
    kinds_rows = [
        [*key, *(f"{a:,} / {b:,}" for a, b in s.missed.T.tolist())] for key, s in total.items() if key[0] == "together"
    ]
    report.table(["fields", "cells", "search", *MISS_KINDS], kinds_rows)
    report.say("Scene by scene: roots found in %, and wrong decisions by sets in % of the points inside:")
    report.table(["scene", "cells", "true roots", "det J < 0", *(method.name for method in chosen)], rows)
    roots, negative, union, only_negative, labelled, same_all, same_positive = orientation.tolist()
    report.say(
        f"Orientation (body's weights, all cells): {negative:,} of {roots:,} true roots have det J < 0, and {only_negative:,}",
        f"of {union:,} inside points ({_share(only_negative, union, 3)} %) are inside by such roots alone. Of the queries,",
        f"{_share(same_all, labelled, 3)} % have the label of the posed mesh (winding number) with all roots,",
        f"{_share(same_positive, labelled, 3)} % with det J > 0 only.",
    )


def _truth(scene: Scene, points: Tensor, active: Tensor | None, seam: float) -> GroundTruth:
    lower, upper = scene.grid.lower.double().numpy(), scene.grid.upper.double().numpy()
    cells = None if active is None else active.numpy()
    fields = points.numpy(), scene.weights.numpy(), scene.transforms.numpy()
    return true_roots(*fields, lower, upper, active_cells=cells, seam=seam)


def _orientation(scene: Scene, points: Tensor, truth: GroundTruth, inside: np.ndarray) -> np.ndarray:
    """Count roots, those with det J < 0, inside points, those inside by such roots alone, queries, and queries that have the
    posed mesh's label with all roots and without such roots."""
    positive, count = truth.determinant > 0, len(truth.seam)
    union = np.bincount(truth.query[inside], minlength=count) > 0
    kept = np.bincount(truth.query[inside & positive], minlength=count) > 0
    vertices, faces = scene.mesh
    label = winding_numbers(scene.posed(vertices), faces, points.double().numpy()) > 0.5
    counts = len(positive), (~positive).sum(), union.sum(), (union & ~kept).sum(), count
    return np.array([*counts, (union == label).sum(), (kept == label).sum()])


def _share(part: int, whole: int, digits: int = 2) -> str:
    return f"{100 * part / whole:.{digits}f}" if whole else "-"


def _cells(s: Scores) -> list[str]:
    """Return the table's cells of one search."""
    errors = np.concatenate(s.jacobian_errors) if s.found else np.full(1, np.nan)
    return [
        _share(s.found, s.roots, 3),
        f"{s.roots - s.found:,} of {s.roots:,}",
        _share(s.found_positive, s.positive, 3),
        f"{s.positive - s.found_positive:,}",
        _share(s.wrong, s.inside, 3),
        f"{_share(s.wrong_sets, s.inside, 3)} ({s.wrong_sets} of {s.inside:,})",
        f"{s.false:,}",
        f"{s.duplicates:,}",
        *(f"{value:.1e}" for value in np.quantile(errors, [0.5, 0.99, 1.0])),
        f"{s.seams} of {s.seams + s.queries:,}",
    ]


# ---------------------------------------------------------------------------------------------------- time
def interleaved(works: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Return the seconds of `repeats` rounds in which all functions take turns, after one round to warm up."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for round_number in range(repeats + 1):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            if round_number:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def times(report: Report, chosen: list[Method], quick: bool, queries: int, repeats: int) -> None:
    """Time all searches on mild and extreme poses, with one thread and with two."""
    threads, rows = torch.get_num_threads(), []
    for count in (2,) if quick else (1, 2):
        torch.set_num_threads(count)
        for pose in ("arms_behind_back",) if quick else ("punching", "splits", "random joints"):
            scene = body_scene(pose)
            for kind in QUERY_KINDS[1:] if quick else QUERY_KINDS:
                points = scene.queries(kind, queries)[None]
                works = {}
                for cells, active in (("near", scene.near_cells), ("all", None)):
                    for method in chosen:
                        if method.uses_cells or cells == "all":
                            key = f"{method.name}|{cells if method.uses_cells else '-'}"
                            works[key] = _work(method, points, scene, active)
                works["(blending of the node transforms alone)|-"] = _blending(scene)
                seconds = interleaved(works, repeats)
                base = next(iter(seconds.values()))
                for key, values in seconds.items():
                    ratio = statistics.median(value / first for value, first in zip(values, base, strict=True))
                    rows.append([pose, kind, str(count), *key.split("|"), median_and_spread(values), f"{ratio:.2f}"])
    torch.set_num_threads(threads)
    report.say("## Time")
    report.say(
        f"{queries:,} queries, 64x64x16 grid, 24 bones, with the blending of the node transforms; median (least-most) of",
        f"{repeats} rounds in which the searches take turns; ratio to the first row of the block, median over the rounds.",
    )
    report.table(["pose", "queries", "threads", "search", "cells", "ms", "ratio"], rows)


def _blending(scene: Scene) -> Callable[[], object]:
    return lambda: blend_transforms(scene.weights, scene.transforms[None])


def _work(method: Method, points: Tensor, scene: Scene, active: Tensor | None) -> Callable[[], object]:
    return lambda: method.run(points, scene.transforms[None], scene, active)


def scaling(report: Report, chosen: list[Method], quick: bool, repeats: int) -> None:
    """Time the complete search, the first of `chosen`, for growing numbers of queries."""
    scene = body_scene("arms_behind_back")
    counts = [25_000, 100_000, 400_000] if quick else [25_000 * 2**k for k in range(7)]
    rows = []
    for method in [m for m in chosen if m.uses_cells][:1]:
        for kind in QUERY_KINDS:
            points = scene.queries(kind, counts[-1])[None]
            for cells, active in (("near", scene.near_cells), ("all", None)):
                works = {str(n): _work(method, points[:, :n].contiguous(), scene, active) for n in counts}
                seconds = interleaved(works, repeats)
                per_query = (1e9 * statistics.median(seconds[str(n)]) / n for n in counts)
                rows.append([method.name, kind, cells, *(f"{value:.0f}" for value in per_query)])
    report.say("## Nanoseconds per query, by the number of queries")
    report.say(f"{scene.name}, {torch.get_num_threads()} threads, median of {repeats}.")
    report.table(["search", "queries", "cells", *(f"{n // 1000}k" for n in counts)], rows)


# ---------------------------------------------------------------------------------------------------- main
def main() -> None:
    options = arguments(
        "Correspondence searches.",
        quick={"action": "store_true", "help": "few scenes, few queries"},
        out={"type": Path, "help": "Markdown file to write"},
        only={"help": f"comma-separated parts: {', '.join(PARTS)}"},
        methods={"help": "comma-separated pieces of names of searches"},
        queries={"type": int, "help": "queries of each kind in a scene, for completeness (default 4000, quick 500)"},
        seam={"type": float, "default": SEAM_M, "help": "metres; see the note above the table"},
    )
    parts = options.only.split(",") if options.only else PARTS
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        raise SystemExit(f"no part {', '.join(unknown)}; known are {', '.join(PARTS)}")
    chosen = methods(options.methods)
    if not chosen:
        raise SystemExit(f"no search is called '{options.methods}'; known are: {'; '.join(m.name for m in methods())}")
    torch.set_num_threads(options.threads or min(2, torch.get_num_threads()))
    timed = [method for method in chosen if method.timed]
    quick, repeats = options.quick, min(options.repeats, 3) if options.quick else options.repeats
    report, facts = Report(), machine_facts()
    versions = [f"{name} {facts['versions'][name]}" for name in ("snarf", "python", "torch", "numpy")]
    library = f"native library with {instruction_set()}" if instruction_set() else f"no native library: {why_unavailable()}"
    report.say("# Correspondence searches")
    report.say(f"{facts['machine']['processor']}, {facts['machine']['cores']} cores; {library}; {', '.join(versions)}.")
    report.say(f"`python benchmarks/bm_search.py {' '.join(sys.argv[1:])}`".replace(" `", "`"))
    if "completeness" in parts:
        completeness(report, chosen, quick, options.queries or (500 if quick else 4000), options.seam)
    if "time" in parts:
        times(report, timed, quick, 50_000 if quick else 200_000, repeats)
    if "scaling" in parts:
        scaling(report, timed, quick, repeats)
    if "memory" in parts and Path("/proc/self/clear_refs").exists():
        report.say("## Peak extra memory")
        report.say(
            "Growth of the peak memory (VmHWM) of a process during one search, results included; one process per search."
        )
        which, counts = (timed[:1], (1_000_000,)) if quick else (timed, (1_000_000, 10_000_000))
        report.table(MEMORY_HEADER, memory_rows(which, counts))
    if "training" in parts:
        report.say("## Training step of 8 poses x 2,250 points")
        report.say(
            f"Searches with the blending of the transforms, backward to the weights; {torch.get_num_threads()} threads. The",
            "whole step: weights network of the papers at the nodes, search in the cells active in training, shape network of",
            "the papers (8 x 256) at the roots, backward, Adam.",
        )
        sizes = ((64, 64, 16),) if quick else ((64, 64, 16), (32, 32, 8))
        report.table(TRAINING_HEADER, [row for size in sizes for row in training_rows(timed, size, repeats)])
    if options.out:
        options.out.write_text("\n".join(report.lines))


if __name__ == "__main__":
    main()
