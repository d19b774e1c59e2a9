"""Check and measure the CUDA kernels on one GPU: correctness, speed, share of the bandwidth, memory.

    python benchmarks/gpu_check.py                           everything, ten minutes; writes benchmarks/results/gpu-<name>.md
    python benchmarks/gpu_check.py --write-scenes scenes.pt  with all packages: writes the scenes for another machine,
    python benchmarks/gpu_check.py --scenes scenes.pt        which then needs only PyTorch and NumPy

In order: compile all kernels (cold and from the cache); run tests/native/test_cuda.py, plainly and, if compute-sanitizer
is installed, under its checkers; compare with the CPU library on 200,000 queries per scene; time the searches and the
gradient, alone (in a CUDA graph, by events) and as called from Python, beside the broyden kernel and a Fast-SNARF search in
PyTorch; time every kernel and compare the bytes it must move with the bandwidth that a plain copy reaches; measure the memory.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from released_search import released_search
from torch import Tensor

from snarfcli.deformer import CanonicalGrid, SearchConfig, find_correspondences
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import start_transforms
from snarfcli.native import cuda, cuda_compile, cuda_driver, cuda_launches

ROOT = Path(__file__).resolve().parents[1]
TEST = "tests/native/test_cuda.py"
SCENES = ("knees", "arms_behind_back", "random joints")
TOLERANCE, STEPS = SearchConfig().tolerance, SearchConfig().max_steps
BROYDEN_M = (1e-4, 0.5)  # the released thresholds, metres
TARGET_OVER_BROYDEN, TARGET_BACKWARD = 10, 2
NUMBERS = torch.float32
RECORD_BYTES, ROOT_BYTES, RESULT_BYTES, TRANSFORM_BYTES, POINT_BYTES = 320, 56, 56, 48, 12
BOUNDS_BYTES, ENTRY_BYTES = 80, 16


@dataclass
class Case:
    """Queries in one scene."""

    name: str
    weights: Tensor
    """[D, H, W, J], skinning weights."""
    bones: Tensor
    """[B, J, 4, 4], canonical to posed, metres."""
    grid: CanonicalGrid
    points: Tensor
    """[B, N, 3], posed space, metres."""
    active: Tensor | None
    nine: list[int]
    """The released start bones."""

    def __post_init__(self) -> None:
        self.shape = tuple(self.weights.shape[:3])
        self.transforms = blend_transforms(self.weights, self.bones)
        self.box = (self.grid.lower, self.grid.upper, self.shape)
        self.starts = {"9": start_transforms(self.bones, self.nine), "all": start_transforms(self.bones, None)}

    @property
    def cells(self) -> int:
        """Number of cells that are searched, over all poses."""
        each = (self.shape[0] - 1) * (self.shape[1] - 1) * (self.shape[2] - 1)
        return len(self.bones) * (each if self.active is None else int(self.active.sum()))

    def complete(self, capacity: int | None = None):
        return cuda.complete_search(self.points, self.transforms, *self.box, self.active, TOLERANCE, STEPS, False, capacity)

    def broyden(self, starts: str, capacity: int | None = None):
        limits = [metres / self.grid.longest_side for metres in BROYDEN_M]
        settings = (*limits, STEPS, True, False, capacity)
        return cuda.broyden_search(self.points, self.transforms, self.starts[starts], *self.box, *settings)

    def backward(self, found, gradient: Tensor):
        return cuda.implicit_backward(gradient, *found[:3], *self.box, *self.points.shape[:2], True, True)

    def released(self):
        with torch.device(self.points.device):  # on which it makes its tensors
            return released_search(self.points, self.bones, self.weights, self.grid, self.nine)


class Report:
    """Text that is printed and kept for the file."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        print(text, flush=True)
        self.lines += [text, ""]

    def table(self, header: list[str], rows: list[list[str]]) -> None:
        widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
        lines = [header, ["-" * width for width in widths], *rows]
        padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
        self.say("\n".join(f"| {' | '.join(line)} |" for line in padded) + "\n")


# ---------------------------------------------------------------- scenes
def write_scenes(path: Path) -> None:
    """Write the scenes that the cases need into a file."""
    from scenes import NINE_BONES, QUERY_KINDS, body_scene

    saved = []
    for pose in SCENES:
        scene = body_scene(pose)
        saved.append(
            {
                "name": pose,
                "weights": scene.weights,
                "bones": scene.transforms,
                "box": torch.stack([scene.grid.lower, scene.grid.upper]),
                "near": scene.near_cells,
                "points": {kind: scene.queries(kind, 200_000) for kind in QUERY_KINDS},
                "nine": list(NINE_BONES),
            }
        )
    torch.save(saved, path)


def cases(path: Path, device: torch.device) -> list[Case]:
    """Read the scenes; add a training batch."""
    out = []
    for saved in torch.load(path, weights_only=True):
        weights, bones, near = (saved[name].to(device) for name in ("weights", "bones", "near"))
        grid = CanonicalGrid(*saved["box"].to(device))
        for kind, active in (("cube", None), ("half near", None), ("half near", near)):
            name = f"{saved['name']}, {kind}, {'all cells' if active is None else 'cells near the body'}"
            points = saved["points"][kind].to(device)[None]
            out.append(Case(name, weights, bones[None], grid, points, active, saved["nine"]))
        if saved["name"] == SCENES[0]:
            points = saved["points"]["half near"][:18_000].reshape(8, 2250, 3).to(device)
            out.append(
                Case("training step, 8 x 2,250", weights, bones.expand(8, -1, -1, -1), grid, points, near, saved["nine"])
            )
    return out


# ---------------------------------------------------------------- correctness
def compile_all(report: Report) -> None:
    """Compile every kernel for this device, without and with the cache."""
    architecture = cuda_compile.architecture_for(torch.cuda.get_device_capability())
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        before = os.environ.get("XDG_CACHE_HOME")
        os.environ["XDG_CACHE_HOME"] = folder
        for source in sorted(path.stem for path in (cuda_compile.cuda_sources() / "cuda").glob("*.cu")):
            for dtype in (torch.float32, torch.float64):
                seconds = []
                for _ in range(2):
                    start = time.perf_counter()
                    code = cuda_compile.load_kernels(source, dtype, architecture)
                    seconds.append(time.perf_counter() - start)
                rows.append([source, str(dtype)[6:], f"{len(code) // 1024}", f"{seconds[0]:.2f}", f"{seconds[1] * 1000:.1f}"])
        if before is None:
            del os.environ["XDG_CACHE_HOME"]
        else:
            os.environ["XDG_CACHE_HOME"] = before
    report.say(f"## Compiling for {architecture}\n")
    report.table(["source", "numbers", "kB", "first time, s", "from the cache, ms"], rows)


def run_tests(report: Report) -> None:
    """Run the kernels' tests on this device, plainly and under compute-sanitizer."""
    report.say("## Tests\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", TEST]
    runs = {"pytest": command}
    sanitizer = shutil.which("compute-sanitizer") or shutil.which("compute-sanitizer", path="/usr/local/cuda/bin")
    on_gpu = ["-k", "cuda and (reference or folds or faces or capacity or gradient or finite)"]
    for tool in ("memcheck", "racecheck", "synccheck") if sanitizer else ():
        checked = [sanitizer, "--tool", tool, "--error-exitcode", "99", *command, *on_gpu]
        runs[f"compute-sanitizer {tool}"] = checked
    rows = []
    for name, line in runs.items():
        start = time.perf_counter()
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
        lines = [text for text in done.stdout.splitlines() if text.strip()]
        ending = [text for text in lines if "passed" in text or "failed" in text or "ERROR SUMMARY" in text]
        rows.append([name, str(done.returncode), "; ".join(ending)[:160], f"{time.perf_counter() - start:.0f}"])
        if done.returncode:
            print(done.stdout[-6000:], done.stderr[-2000:], sep="\n")
    report.table(["run", "exit code", "result", "s"], rows)
    if not sanitizer:
        report.say("compute-sanitizer was not found.")


def compare(report: Report, chosen: list[Case]) -> None:
    """Compare the kernels with the CPU library, and two runs with each other."""
    rows = []
    for case in chosen:
        found, again = case.complete(), case.complete()
        same = all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
        active = None if case.active is None else case.active.cpu()
        given = (case.points.cpu(), case.bones.cpu(), case.weights.cpu(), case.grid.to(case.points.cpu()))
        wanted = find_correspondences(*given, search=SearchConfig(tolerance=TOLERANCE, max_steps=STEPS), active_cells=active)
        total = case.points.shape[0] * case.points.shape[1]
        here, there = (torch.bincount(query.cpu(), minlength=total) for query in (found[1], wanted.query))
        equal = here == there
        mine, theirs = found[0].cpu()[equal[found[1].cpu()]], wanted.canonical[equal[wanted.query]]
        distance = (mine - theirs).norm(dim=1)
        off = f"{int((distance > 1e-4).sum())}"
        rows.append([case.name, f"{len(found[1]):,}", f"{int((~equal).sum())}", off, f"{distance.median():.1e}", str(same)])
    report.say("## Against the CPU library\n")
    header = [
        "case",
        "roots",
        "queries with another number of roots",
        "roots off by more than 0.1 mm",
        "median, m",
        "same bits again",
    ]
    report.table(header, rows)


# ---------------------------------------------------------------- speed
def by_events(work: Callable[[], object], repeats: int) -> list[float]:
    """Return the milliseconds on the device per call."""
    for _ in range(3):
        work()
    marks = [(torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) for _ in range(repeats)]
    for start, end in marks:
        start.record()
        work()
        end.record()
    torch.cuda.synchronize()
    return [start.elapsed_time(end) for start, end in marks]


def in_graph(work: Callable[[], object], repeats: int) -> list[float]:
    """Return the milliseconds on the device per replay of `work` in a CUDA graph; `work` must not synchronise."""
    work()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return by_events(graph.replay, repeats)


def shown(milliseconds: list[float]) -> str:
    return f"{statistics.median(milliseconds):.3f} ({min(milliseconds):.3f}-{max(milliseconds):.3f})"


def timings(report: Report, chosen: list[Case], repeats: int) -> None:
    """Time the searches and the gradient."""
    rows = []
    for case in chosen:
        found = case.complete()
        capacity = len(found[1]) + 1024
        padded = case.complete(capacity)
        gradient = torch.randn(capacity, 3, device=case.points.device)
        most = {starts: int(case.broyden(starts)[3]) + 1024 for starts in ("9", "all")}
        times = {
            "complete": in_graph(lambda case=case, capacity=capacity: case.complete(capacity), repeats),
            "as called": by_events(lambda case=case: case.complete(), repeats),
            "backward": in_graph(lambda case=case, padded=padded, gradient=gradient: case.backward(padded, gradient), repeats),
            "broyden 9": in_graph(lambda case=case, most=most: case.broyden("9", most["9"]), max(repeats // 5, 3)),
            "broyden all": in_graph(lambda case=case, most=most: case.broyden("all", most["all"]), max(repeats // 5, 3)),
            "PyTorch": by_events(lambda case=case: case.released(), max(repeats // 10, 3)),
        }
        middle = {name: statistics.median(values) for name, values in times.items()}
        ratios = [middle[name] / middle["complete"] for name in ("broyden 9", "broyden all", "PyTorch")]
        backward = middle["backward"] / middle["complete"]
        rows.append(
            [case.name, *(shown(values) for values in times.values()), *(f"{r:.1f}" for r in ratios), f"{backward:.2f}"]
        )
    report.say("## Time, ms on the device: median (least-most)\n")
    report.say(
        "Complete, backward and the broyden kernel are replayed from a CUDA graph, so that only the device counts; `as called` "
        "is the complete search from Python with its synchronisation, and so is the released algorithm in PyTorch. Wanted: "
        f"{TARGET_OVER_BROYDEN} times ahead of broyden with nine start bones, backward within {TARGET_BACKWARD} times forward."
    )
    names = ["complete", "complete, as called", "backward", "broyden, 9", "broyden, all", "PyTorch, 9"]
    report.table(
        ["case", *names, "broyden 9 / complete", "broyden all / complete", "PyTorch / complete", "backward / complete"], rows
    )


class TimedGpu:
    """A launcher that records the time of each kernel."""

    def __init__(self, gpu: cuda_driver.Gpu) -> None:
        self.gpu = gpu
        self.marks: dict[str, list] = defaultdict(list)

    def threads(self, most: int) -> int:
        return self.gpu.threads(most)

    def launch(self, source, kernel, blocks, threads, arguments) -> None:
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        self.gpu.launch(source, kernel, blocks, threads, arguments)
        end.record()
        self.marks[kernel].append((start, end))

    def medians(self) -> dict[str, float]:
        torch.cuda.synchronize()
        return {name: statistics.median(s.elapsed_time(e) for s, e in marks[1:]) for name, marks in self.marks.items()}


def copy_bandwidth() -> float:
    """Return the bytes per second that a plain copy reads and writes."""
    source = torch.empty(1 << 30, dtype=torch.uint8, device="cuda")
    target = torch.empty_like(source)
    return 2 * source.numel() / (statistics.median(by_events(lambda: target.copy_(source), 20)) / 1000)


def bandwidth(report: Report, chosen: list[Case], repeats: int) -> None:
    """Compare the traffic of each kernel with a plain copy, and the whole search with its lower bound."""
    peak = copy_bandwidth()
    report.say("## Bandwidth\n")
    report.say(
        f"A copy of 1 GiB moves {peak / 1e12:.2f} TB/s. `must move` counts what a kernel reads and writes at least, each array "
        "once. Much of it stays in the L2 cache, so that more than the copy's rate is possible; less means that the kernel "
        "waits for something else: latency, atomics or arithmetic. The floor of a whole search is reading queries and "
        "transforms and writing the results, nothing else, at the copy's rate."
    )
    rows, floors = [], []
    for case in chosen:
        gpu = TimedGpu(cuda_driver.gpu(case.points))
        for _ in range(repeats + 1):
            cuda_launches.run_complete(gpu, case.points, case.transforms, *case.box, case.active, TOLERANCE, STEPS, False, None)
        found = case.complete()
        gradient = torch.randn(len(found[1]), 3, device=case.points.device)
        for _ in range(repeats + 1):
            sizes = case.points.shape[:2]
            cuda_launches.run_backward(gpu, gradient, *found[:3], *case.box, *sizes, True, True)
        queries, roots, poses = case.points.shape[0] * case.points.shape[1], len(found[1]), len(case.bones)
        nodes = case.transforms.shape[1] * poses * TRANSFORM_BYTES
        records, bins = case.cells * RECORD_BYTES, 4 * poses * min(max(case.points.shape[1], 64), 1 << 20)
        in_bins = queries * (POINT_BYTES + 4)
        must_move = {
            "survey": nodes + records + queries * POINT_BYTES,
            "count_queries": queries * POINT_BYTES + bins,
            "place_queries": queries * POINT_BYTES + in_bins + 2 * bins,
            "search_cells": case.cells * BOUNDS_BYTES + bins + in_bins + roots * ENTRY_BYTES,
            "search_rest": 0,
            "halve_parts": 0,
            "solve_parts": roots * (ENTRY_BYTES + POINT_BYTES + ROOT_BYTES) + records,
            "collect_roots": 8 * queries + 8 * roots,
            "write_roots": 8 * queries + roots * (ROOT_BYTES + RESULT_BYTES),
            "implicit_backward": roots * (12 + RESULT_BYTES + 8 * TRANSFORM_BYTES) + queries * POINT_BYTES,
        }
        for kernel, ms in gpu.medians().items():
            moved = must_move[kernel]
            rate = moved / (ms / 1000)
            rows.append(
                [case.name, kernel, f"{ms * 1000:.1f}", f"{moved / 1e6:.1f}", f"{rate / 1e12:.2f}", f"{rate / peak:.0%}"]
            )
        whole = statistics.median(in_graph(lambda case=case, rows=roots + 1024: case.complete(rows), repeats))
        floor = 1000 * (nodes + queries * POINT_BYTES + roots * RESULT_BYTES) / peak
        floors.append([case.name, f"{whole * 1000:.0f}", f"{floor * 1000:.1f}", f"{whole / floor:.1f}"])
    report.table(["case", "kernel", "us", "must move, MB", "TB/s", "of a copy"], rows)
    report.table(["case", "whole search, us", "floor, us", "times the floor"], floors)


def memory(report: Report, chosen: list[Case]) -> None:
    """Measure the peak memory of a search of many queries."""
    case = chosen[0]
    rows = []
    for count in (200_000, 1_000_000, 10_000_000):
        points = case.points[:1].repeat(1, -(-count // case.points.shape[1]), 1)[:, :count].contiguous()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        found = cuda.complete_search(points, case.transforms[:1], *case.box, None, TOLERANCE, STEPS, False, None)
        peak = torch.cuda.max_memory_allocated() - before
        rows.append([f"{count:,}", f"{len(found[1]):,}", f"{peak / 2**20:.0f}"])
        del points, found
    report.say("## Memory of one search, beyond its inputs\n")
    report.table(["queries", "roots", "peak, MiB"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=Path, help="file written by --write-scenes")
    parser.add_argument("--write-scenes", type=Path, help="write this file and stop")
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--parts", default="compile,tests,compare,time,bandwidth,memory")
    parser.add_argument("--out", type=Path, help="file of the report")
    options = parser.parse_args()
    if options.write_scenes:
        return write_scenes(options.write_scenes)
    if not torch.cuda.is_available():
        raise SystemExit(f"gpu_check: {cuda.cuda_status()}")
    device = torch.device("cuda", torch.cuda.current_device())
    name = torch.cuda.get_device_name(device)
    report = Report()
    report.say(f"# {name}\n")
    report.say(
        f"`python benchmarks/gpu_check.py`: {cuda.cuda_status()}; PyTorch {torch.__version__}, CUDA {torch.version.cuda}."
    )
    parts = options.parts.split(",")
    if "compile" in parts:
        compile_all(report)
    if "tests" in parts:
        run_tests(report)
    with tempfile.TemporaryDirectory() as folder:
        path = options.scenes or Path(folder) / "scenes.pt"
        if not options.scenes:
            write_scenes(path)
        chosen = cases(path, device)
    if "compare" in parts:
        compare(report, chosen)
    if "time" in parts:
        timings(report, chosen, options.repeats)
    if "bandwidth" in parts:
        bandwidth(report, chosen, options.repeats)
    if "memory" in parts:
        memory(report, chosen)
    place = options.out or ROOT / "benchmarks" / "results" / f"gpu-{name.lower().replace(' ', '-')}.md"
    place.write_text("\n".join(report.lines))
    print(f"written: {place}")


if __name__ == "__main__":
    main()
