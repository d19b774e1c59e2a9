"""The encoding of points: the native kernels against the readable version, and its gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from encoding_arrays import encoding_arrays

from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.trilinear import interpolate
from snarfcli.networks.encoding import encode, encode_backward, encode_reference


@pytest.mark.parametrize("features", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 700])
def test_native_values_and_gradients_are_those_of_the_reference(count, features):
    points, frequencies, table, *grids = encoding_arrays(count, features)
    points.requires_grad_(), table.requires_grad_()
    out = encode(points, frequencies, table, *grids)
    wide = [t.detach().double().requires_grad_() for t in (points, table)]
    wanted = encode_reference(wide[0], frequencies.double(), wide[1], *grids)
    assert out.shape == wanted.shape == (count, 3 + 12 + 2 * features)
    torch.testing.assert_close(out.double(), wanted, rtol=1e-5, atol=5e-5)  # places in cells to 1e-6, features up to 4
    gradient = torch.randn(out.shape)
    found = torch.autograd.grad(out, [points, table], gradient)
    right = torch.autograd.grad(wanted, wide, gradient.double())
    for one, other in zip(found, right, strict=True):
        assert (one - other).norm() <= 5e-5 * other.norm() + 1e-9


def test_one_gradient_alone():
    points, frequencies, table, *grids = encoding_arrays(50)
    both = encode_backward(
        torch.ones(50, 23), encode(points, frequencies, table, *grids), points, frequencies, table, *grids, True, True
    )
    for wants in ((True, False), (False, True)):
        one = encode_backward(
            torch.ones(50, 23), encode(points, frequencies, table, *grids), points, frequencies, table, *grids, *wants
        )
        assert torch.equal(one[wants.index(True)], both[wants.index(True)])
        assert one[wants.index(False)].numel() == 0


def test_the_result_does_not_depend_on_the_number_of_threads():
    points, frequencies, table, *grids = encoding_arrays(3000)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out = encode(points, frequencies, table, *grids)
            found.append([out, *encode_backward(out.sin(), out, points, frequencies, table, *grids, True, True)])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_gradients_are_those_of_finite_differences():
    points, frequencies, table, *grids = encoding_arrays(6, 2, (0.9, 0.5), dtype=torch.float64)
    given = [points.requires_grad_(), table.requires_grad_()]
    assert torch.autograd.gradcheck(lambda p, t: encode(p, frequencies, t, *grids), given)


def test_operator_contract():
    points, frequencies, table, *grids = encoding_arrays(5)
    torch.library.opcheck(encode, (points, frequencies, table, *grids))
    torch.library.opcheck(encode, (points.requires_grad_(), frequencies, table.requires_grad_(), *grids))


def test_without_grids_only_waves():
    points = torch.rand(4, 3)
    nothing = torch.empty(0, 1), torch.empty(0, dtype=torch.int32), [], []
    encoded = encode(points, torch.tensor([3.0]), *nothing)
    torch.testing.assert_close(encoded, torch.cat([points, (3 * points).sin(), (3 * points).cos()], 1), rtol=0, atol=1e-6)


def test_outside_of_the_box_there_are_no_features():
    _, frequencies, table, *grids = encoding_arrays(1)
    encoded = encode(torch.tensor([[5.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]]), frequencies, table, *grids)
    assert not encoded[0, 15:].any()
    assert encoded[0].isfinite().all()
    assert encoded[1, 0].isnan()


def test_values_of_the_border_hold_outside_of_the_box_with_and_without_gradients():
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        grid = CanonicalGrid(-torch.rand(3, generator=generator) - 0.1, torch.rand(3, generator=generator) + 0.1)
        values = torch.rand(5, 9, 7, 4, generator=generator)
        points = torch.cat([grid.lower[None], grid.upper[None], 2 * torch.randn(20, 3, generator=generator)])
        with torch.no_grad():
            native = interpolate(values, points, grid)
        readable = interpolate(values, points.requires_grad_(), grid).detach()
        torch.testing.assert_close(native, readable, rtol=0, atol=2e-4)  # three axes, 5e-5 of a cell each
