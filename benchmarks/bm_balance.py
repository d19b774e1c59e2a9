"""How evenly the CUDA kernels of the complete search share out their work, counted without a GPU.

    python benchmarks/bm_balance.py                        three poses, 20,000 and 200,000 queries
    python benchmarks/bm_balance.py --counts 2000000       other numbers of queries
    python benchmarks/bm_balance.py --kernels OTHER/tests/native    the kernels of another checkout, with the same counters

The kernels run as C++ (tests/native/cuda_emulation.py) with the blocks of a GPU. Counted are the rounds in which the threads of
a block take one candidate each, the halvings of a cell, and the runs of Newton's method. "perfect": the work of all blocks,
spread evenly over the threads that a GPU of 132 multiprocessors keeps at once, which is the least that the busiest thread can
have. The launches are those of one search.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from common import print_table
from scenes import body_scene

from snarfcli.deformer import SearchConfig
from snarfcli.deformer.skinning import blend_transforms

POSES = ("knees", "arms_behind_back", "deep_squats", "random joints")
CASES = (("half near", True), ("half near", False), ("cube", False))
THREADS_AT_ONCE = 132 * 512  # 128 registers for each
KINDS = ("rounds", "halvings", "solves")


def rows_of(case: str, work: dict[str, list[np.ndarray]]) -> list[list[str]]:
    """Return the rows of a table on what the blocks did, `EmulatedGpu.work`."""
    rows = []
    for kernel, launches in work.items():
        blocks = np.concatenate(launches)
        for k, kind in enumerate(KINDS):
            if not blocks[:, 0, k].sum():
                continue
            total = int(blocks[:, 0, k].sum())
            busiest = [int(blocks[:, 1, k].max()), int(blocks[:, 0, k].max())]
            busy = int((blocks[:, 0].sum(1) > 0).sum())
            perfect = f"{total / THREADS_AT_ONCE:.1f}"
            rows.append([case, kernel, kind, f"{total:,}", f"{busy:,} of {len(blocks):,}", *map(str, busiest), perfect])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 200_000], help="numbers of queries")
    parser.add_argument("--poses", nargs="+", default=list(POSES))
    folder = Path(__file__).resolve().parents[1] / "tests" / "native"
    parser.add_argument("--kernels", type=Path, default=folder, help="folder with the emulation")
    options = parser.parse_args()
    sys.path[:0] = [str(options.kernels), str(options.kernels.parents[1])]
    from cuda_emulation import EmulatedGpu

    from snarfcli.native import cuda_launches

    settings, rows = SearchConfig(), []
    for pose in options.poses:
        scene = body_scene(pose)
        transforms = blend_transforms(scene.weights, scene.transforms[None])
        for count in options.counts:
            for kind, near in CASES:
                launcher = EmulatedGpu(torch.float32, block=128)
                box = (scene.grid.lower, scene.grid.upper, scene.shape, scene.near_cells if near else None)
                limits = (settings.tolerance, settings.max_steps, False, 3 * count)  # room for all roots: no second search
                cuda_launches.run_complete(launcher, scene.queries(kind, count)[None], transforms, *box, *limits)
                case = f"{pose}, {count:,} {kind}, {'cells near the body' if near else 'all cells'}"
                print(f"{case}: {len(launcher.launches)} launches of kernels", file=sys.stderr, flush=True)
                rows += rows_of(case, launcher.work)
    print_table(["case", "kernel", "of each", "together", "busy blocks", "busiest thread", "busiest block", "perfect"], rows)


if __name__ == "__main__":
    main()
