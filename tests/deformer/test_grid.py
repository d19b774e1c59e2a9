"""The grid's geometry and trilinear interpolation against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from skinning_scenes import unit_grid

from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.grid import cell_corners, locate, trilinear_weights
from snarfcli.deformer.trilinear import forward_jacobian, interpolate

SHAPE = (3, 4, 6)


@pytest.mark.parametrize("channels", [3, 64, 65, 150])
def test_native_interpolation_takes_any_number_of_channels(channels):
    """A dragon has more bones than a person."""
    generator = torch.Generator().manual_seed(channels)
    values = torch.rand(4, 5, 6, channels, generator=generator)
    points = 1.7 * torch.rand(50, 3, generator=generator) - 0.85
    with torch.no_grad():
        native = interpolate(values, points, unit_grid(torch.float32))
    reference = interpolate(values.double(), points.double(), unit_grid())
    torch.testing.assert_close(native, reference.float(), atol=1e-5, rtol=1e-5)


def test_corners_of_a_cell_are_its_nodes():
    grid = unit_grid()
    nodes = grid.nodes(SHAPE).reshape(-1, 3)
    cells = torch.arange(2 * 3 * 5)
    corners = nodes[cell_corners(cells, SHAPE)]
    size = grid.cell_size(SHAPE)
    offsets = torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
    torch.testing.assert_close(corners, corners[:, :1] + offsets * size)
    centres = corners.mean(1)
    cell, local = locate(centres, grid, SHAPE)
    assert torch.equal(cell, cells)
    torch.testing.assert_close(local, torch.full_like(local, 0.5))


def test_interpolation_agrees_with_scipy():
    grid = unit_grid()
    values = torch.rand(*SHAPE, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = grid.lower + torch.rand(200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 2
    axes = [np.linspace(grid.lower[a].item(), grid.upper[a].item(), n) for a, n in ((2, 3), (1, 4), (0, 6))]
    wanted = RegularGridInterpolator(axes, values.numpy())(points.numpy()[:, ::-1])
    np.testing.assert_allclose(interpolate(values, points, grid).numpy(), wanted, atol=1e-12)


def test_interpolation_outside_takes_the_border():
    grid = unit_grid()
    values = torch.arange(SHAPE[2], dtype=torch.float64).expand(*SHAPE)[..., None]
    far = torch.tensor([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(interpolate(values, far, grid)[:, 0], torch.tensor([5.0, 0.0], dtype=torch.float64))


def test_forward_map_and_its_jacobian_against_autograd():
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(5, 8, 12, generator=generator, dtype=torch.float64)
    local = torch.rand(5, 3, generator=generator, dtype=torch.float64)
    origin = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    size = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)

    def posed(u):
        blended = (trilinear_weights(u)[:, :, None] * corners).sum(1).reshape(5, 3, 4)
        return torch.einsum("nrc,nc->nr", blended[..., :3], origin + u * size) + blended[..., 3]

    value, jacobian = forward_jacobian(corners, local, origin, size)
    wanted = torch.autograd.functional.jacobian(posed, local)
    torch.testing.assert_close(value, posed(local))
    torch.testing.assert_close(jacobian, torch.stack([wanted[n, :, n] for n in range(5)]))


def test_a_box_turned_inside_out_is_rejected():
    with pytest.raises(ValueError, match=r"grid\.upper: wanted more than grid\.lower"):
        CanonicalGrid(torch.zeros(3), torch.tensor([1.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match=r"grid\.lower: wanted shape \[3\], got \[2\]"):
        CanonicalGrid(torch.zeros(2), torch.ones(3))
