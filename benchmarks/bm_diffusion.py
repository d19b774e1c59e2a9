"""Processor time and errors of a mesh's weights diffused into grids of several sizes.

    python benchmarks/bm_diffusion.py

The built-in body with 24 bones. Errors are the largest differences from a converged solution in float64.
"""

from __future__ import annotations

import statistics
import time
from unittest import mock

import torch
from common import arguments, print_machine, print_table

from snarfcli.datasets.builtin import builtin_subject
from snarfcli.deformer import CanonicalGrid, diffusion
from snarfcli.deformer.harmonic import harmonic
from snarfcli.deformer.multigrid import Multigrid

_SHAPES = ((8, 32, 32), (16, 64, 64), (24, 96, 96), (32, 128, 128))
_MARGIN_M = (0.12, 0.12, 0.20)  # as conf/skinning/distilled.yaml
_CONVERGED = 1e-8


class _Watch:
    """The solver, with its time and its number of cycles."""

    def __init__(self) -> None:
        self.seconds, self.cycles, self.columns = 0.0, 0, 0

    def __call__(self, start: torch.Tensor, *rest) -> torch.Tensor:
        cycle = Multigrid.cycle

        def counted(multigrid: Multigrid, residuals: torch.Tensor, depth: int = 0) -> torch.Tensor:
            self.cycles += len(residuals) * (depth == 0)
            return cycle(multigrid, residuals, depth)

        begin = time.process_time()
        with mock.patch.object(Multigrid, "cycle", counted):
            values = harmonic(start, *rest)
        self.seconds += time.process_time() - begin
        self.columns += start.shape[-1]
        return values


def main() -> None:
    options = arguments("Diffused weights.")
    torch.set_num_threads(options.threads or 1)
    print_machine()
    template = builtin_subject("50002").template
    vertices, weights = (torch.as_tensor(part, dtype=torch.float64) for part in (template.vertices, template.weights))
    box = CanonicalGrid.around(vertices, _MARGIN_M)
    rows = []
    for shape in _SHAPES:
        with mock.patch.object(diffusion, "_SOLVED", _CONVERGED):
            exact = diffusion.diffuse_weights(vertices, weights, box, shape)
        seconds, watch = [], _Watch()
        for _ in range(options.repeats):
            begin = time.process_time()
            with mock.patch.object(diffusion, "harmonic", watch):
                values = diffusion.diffuse_weights(vertices, weights, box.to(torch.empty(0)), shape)
            seconds.append(time.process_time() - begin)
        error = float((values - exact).abs().max())
        solver = watch.seconds / options.repeats
        per_bone = f"{watch.cycles / watch.columns:.1f}"
        size = " x ".join(str(n) for n in reversed(shape))
        rows.append([size, f"{statistics.median(seconds):.2f}", f"{solver:.2f}", per_bone, f"{error:.1e}"])
    print_table(["nodes", "processor time, s", "of it the solver, s", "cycles per bone", "largest error"], rows)


if __name__ == "__main__":
    main()
