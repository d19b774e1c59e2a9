"""Harmonic values against a dense solution, for any size of grid and shape of cells."""

from __future__ import annotations

import pytest
import torch

from snarfcli.deformer import harmonic as module
from snarfcli.deformer.harmonic import harmonic
from snarfcli.deformer.multigrid import Multigrid

CUBES = (0.1, 0.1, 0.1)


def problem(shape, share: float, columns: int = 3, dtype=torch.float64):
    """Return start values in [0, 1] and random fixed nodes, at least one."""
    generator = torch.Generator().manual_seed(0)
    start = torch.rand(*shape, columns, generator=generator, dtype=torch.float64).to(dtype)
    fixed = torch.rand(shape, generator=generator) < share
    fixed[0, 0, 0] = True
    return start, fixed


def laplacian(shape, cell_size):
    """Return the matrix [n, n] of the flow into nodes from their neighbours."""
    count = shape[0] * shape[1] * shape[2]
    index = torch.arange(count).reshape(shape)
    matrix = torch.zeros(count, count, dtype=torch.float64)
    for axis in range(3):
        length = shape[axis] - 1
        a, b = (index.narrow(axis, first, length).reshape(-1) for first in (0, 1))
        for here, there in ((a, b), (b, a)):
            matrix[here, there] += 1 / cell_size[2 - axis] ** 2
            matrix[here, here] -= 1 / cell_size[2 - axis] ** 2
    return matrix


def dense(start, fixed, cell_size):
    matrix, known = laplacian(fixed.shape, cell_size), fixed.reshape(-1)
    values = start.reshape(len(known), -1).clone()
    if not bool(known.all()):
        values[~known] = torch.linalg.solve(matrix[~known][:, ~known], -matrix[~known][:, known] @ values[known])
    return values.reshape(start.shape)


@pytest.mark.parametrize("cell_size", [CUBES, (0.1, 0.02, 0.5)])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("shape", [(2, 2, 2), (2, 2, 40), (5, 9, 33), (8, 8, 8), (7, 6, 5)])
def test_they_are_those_of_a_dense_solution(shape, share, cell_size):
    start, fixed = problem(shape, share)
    wanted = dense(start, fixed, cell_size)
    size = torch.tensor(cell_size, dtype=torch.float64)
    torch.testing.assert_close(harmonic(start, fixed, size, 1e-10), wanted, atol=1e-8, rtol=0)
    for solved in (1e-2, 1e-4):
        assert float((harmonic(start, fixed, size, solved) - wanted).abs().max()) < 3 * solved
    rough = harmonic(start.float(), fixed, size.float(), 1e-4)
    assert rough.dtype == torch.float32
    assert float((rough - wanted).abs().max()) < 3e-4
    assert torch.equal(rough[fixed], start.float()[fixed])


@pytest.mark.parametrize("shape", [(6, 12, 12), (24, 48, 48)])
def test_steps_hardly_depend_on_the_number_of_nodes(monkeypatch, shape):
    cycles = 0
    cycle = Multigrid.cycle

    def counted(self, residuals, depth=0):
        nonlocal cycles
        cycles += depth == 0
        return cycle(self, residuals, depth)

    monkeypatch.setattr(Multigrid, "cycle", counted)
    start, fixed = problem(shape, 0.0, 1)
    harmonic(start, fixed, torch.tensor(CUBES).double(), 1e-6)
    assert 3 < cycles < 15  # one fixed node in a corner is the worst case; measured 9 and 10


def test_a_cycle_is_symmetric_and_positive():
    """As conjugate gradients need it."""
    _, fixed = problem((3, 7, 10), 0.1)
    multigrid = Multigrid(~fixed, torch.tensor([0.1, 0.2, 0.1]).double())
    units = torch.eye(fixed.numel(), dtype=torch.float64)[~fixed.reshape(-1)].reshape(-1, *fixed.shape)
    matrix = multigrid.cycle(units)[:, ~fixed]
    torch.testing.assert_close(matrix, matrix.T, atol=1e-12, rtol=1e-10)
    assert float(torch.linalg.eigvalsh(matrix).min()) > 0
    assert not bool(multigrid.cycle(units)[:, fixed].any())


def test_columns_are_solved_on_their_own(monkeypatch):
    start, fixed = problem((5, 6, 7), 0.1, 5)
    told = []
    size = torch.tensor(CUBES).double()
    together = harmonic(start, fixed, size, 1e-8, told.append)
    assert told == [5]
    monkeypatch.setattr(module, "_VALUES_AT_ONCE", 500)
    torch.testing.assert_close(harmonic(start, fixed, size, 1e-8, told.append), together, atol=1e-7, rtol=0)
    assert told == [5, 2, 2, 1]


def test_more_than_the_precision_allows_ends():
    start, fixed = problem((5, 6, 7), 0.1, dtype=torch.float32)
    values = harmonic(start, fixed, torch.tensor(CUBES), 1e-30)
    torch.testing.assert_close(values.double(), dense(start.double(), fixed, CUBES), atol=1e-5, rtol=0)
