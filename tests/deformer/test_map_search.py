"""The search on a forward map that is more than blending: real roots, exact Jacobians and implicit gradients."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from skinning_scenes import random_transforms, unit_grid
from torch import nn

from snarfcli.deformer import (
    CanonicalGrid,
    SearchConfig,
    find_correspondences_on_field,
    find_correspondences_on_map,
    skin,
)

BONES = 4
EXACT = SearchConfig("broyden", tolerance=1e-10, max_steps=50, divergence=1.0)


class OffsetMap(nn.Module):
    """Blending, plus an offset from a small network that takes a code of the pose, as in avatars with soft clothes."""

    def __init__(self, batch: int = 2, angle: float = 0.25, size: float = 0.05) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.centres = nn.Parameter(2 * torch.rand(BONES, 3, generator=generator, dtype=torch.float64) - 1)
        self.codes = nn.Parameter(torch.randn(batch, 3, generator=generator, dtype=torch.float64))
        self.transforms = nn.Parameter(random_transforms(batch, BONES, angle)[:, :, :3])
        self.size = nn.Parameter(torch.tensor(size, dtype=torch.float64))
        self.largest_call = 0

    def weights(self, x):
        return torch.softmax(-4 * ((x[:, None] - self.centres.to(x)).square().sum(-1) + 1e-3).sqrt(), -1)

    def forward(self, x, pose_index):
        self.largest_call = max(self.largest_call, len(x))
        moved = x + self.size.to(x) * torch.sin(3 * x.roll(1, 1) + self.codes.to(x)[pose_index])
        blended = torch.einsum("kj,kjrc->krc", self.weights(x), self.transforms.to(x)[pose_index])
        return torch.einsum("krc,kc->kr", blended[..., :3], moved) + blended[..., 3]


@pytest.fixture
def scene():
    """Return a map, points [2, 30, 3] that have a root, and starts [2, 30, 2, 3] near it."""
    forward, generator = OffsetMap(), torch.Generator().manual_seed(1)
    canonical = 1.4 * torch.rand(2, 30, 3, generator=generator, dtype=torch.float64) - 0.7
    with torch.no_grad():
        points = forward(canonical.reshape(-1, 3), torch.arange(2).repeat_interleave(30)).reshape(2, 30, 3)
    noise = 0.1 * torch.randn(2, 30, 2, 3, generator=generator, dtype=torch.float64)
    return forward, points, canonical[:, :, None] + noise


def test_every_result_is_a_root_once_with_the_exact_jacobian(scene):
    forward, points, starts = scene
    found = find_correspondences_on_map(points, forward, starts, search=EXACT)
    assert found.query.tolist() == list(range(60))
    residual = forward(found.canonical, found.pose) - points.reshape(-1, 3)[found.query]
    assert float(residual.detach().norm(dim=1).max()) < 1e-9
    one = torch.func.jacrev(lambda x, pose: forward(x[None], pose[None])[0])
    jacobian = torch.stack([one(x, pose) for x, pose in zip(found.canonical.detach(), found.pose, strict=True)])
    torch.testing.assert_close(jacobian.detach() @ found.jacobian_inverse, torch.eye(3).double().expand(60, 3, 3))
    assert not found.jacobian_inverse.requires_grad


def test_blending_alone_is_the_search_on_a_field(scene):
    forward, points, starts = scene
    transforms = torch.eye(4, dtype=torch.float64).repeat(2, BONES, 1, 1)
    transforms[:, :, :3] = forward.transforms.detach()
    wanted = find_correspondences_on_field(
        points, transforms, forward.weights, unit_grid(), starts=starts, search=SearchConfig("broyden", tolerance=1e-9)
    )

    def blending(x, pose_index):
        return skin(x, forward.weights(x), transforms[int(pose_index[0])]) if len(x) else x

    found = find_correspondences_on_map(points, blending, starts, unit_grid(), search=SearchConfig("broyden", tolerance=1e-9))
    assert len(found.query) > 50
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.jacobian_inverse, wanted.jacobian_inverse)


def test_several_roots_come_in_the_order_of_the_starts():
    """x becomes x^2 axis by axis: eight roots, one in each octant."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    point = torch.tensor([0.04, 0.09, 0.16], dtype=torch.float64)
    starts = 0.3 * torch.cat([signs, signs.flip(0)])[None, None]
    found = find_correspondences_on_map(point[None, None], torch.square, starts, search=EXACT)
    torch.testing.assert_close(found.canonical, signs * torch.tensor([0.2, 0.3, 0.4]).double(), atol=1e-7, rtol=0)
    upright = SearchConfig("broyden", tolerance=1e-10, max_steps=50, divergence=1.0, orientation_preserving=True)
    half = find_correspondences_on_map(point[None, None], torch.square, starts, search=upright)
    assert torch.equal(half.canonical, found.canonical[signs.prod(1) > 0])


def test_gradcheck(scene):
    """To the points and to all that the map depends on: weights, transforms, codes of the poses, and the offset's size."""
    forward, points, starts = scene
    names = [name for name, _ in forward.named_parameters()]

    def roots(points, *parameters):
        def with_parameters(x, pose_index):
            return torch.func.functional_call(forward, dict(zip(names, parameters, strict=True)), (x, pose_index))

        search = SearchConfig("broyden", tolerance=1e-13, max_steps=60)
        return find_correspondences_on_map(points, with_parameters, starts[:, :2], search=search).canonical

    inputs = points[:, :2].clone(), *(parameter.detach().clone() for parameter in forward.parameters())
    assert roots(*inputs).shape == (4, 3)
    assert torch.autograd.gradcheck(roots, tuple(x.requires_grad_() for x in inputs), eps=1e-6, atol=1e-5, fast_mode=True)


def test_second_derivative_is_rejected(scene):
    forward, points, starts = scene
    points.requires_grad_()
    found = find_correspondences_on_map(points, forward, starts).canonical
    for loss in (found.square().sum(), found.sum()):
        (first,) = torch.autograd.grad(loss, points, create_graph=True)
        with pytest.raises(RuntimeError, match="second derivative of a correspondence search is not available"):
            first.sum().backward(retain_graph=True)


def test_starts_get_no_gradient_and_a_map_without_parameters_gives_points_theirs(scene):
    _, points, starts = scene
    points.requires_grad_()
    starts.requires_grad_()
    found = find_correspondences_on_map(points, lambda x: 2 * x, starts, search=EXACT)
    found.canonical.sum().backward()
    assert starts.grad is None
    torch.testing.assert_close(points.grad, torch.full_like(points, 0.5))


def test_chunks_change_nothing_and_bound_the_calls(scene):
    forward, points, starts = scene
    kept = []
    for at_once in (7, 100_000):
        forward.zero_grad()
        forward.largest_call = 0
        queries = points.clone().requires_grad_()
        found = find_correspondences_on_map(queries, forward, starts, search=EXACT, points_at_once=at_once)
        assert 0 < forward.largest_call <= at_once
        found.canonical.sin().sum().backward()
        kept.append((found.canonical.detach(), queries.grad, forward.codes.grad.clone(), forward.centres.grad.clone()))
    for few, many in zip(*kept, strict=True):
        torch.testing.assert_close(few, many, atol=1e-9, rtol=1e-9)


def test_works_wherever_autograd_is_off_and_under_autocast(scene):
    forward, points, starts = scene
    wanted = find_correspondences_on_map(points, forward, starts, search=EXACT).canonical
    assert wanted.requires_grad
    with torch.no_grad():
        plain = find_correspondences_on_map(points, forward, starts, search=EXACT).canonical
    with torch.inference_mode():
        inference = find_correspondences_on_map(points + 0, forward, starts + 0, search=EXACT).canonical
    for other in (plain, inference):
        assert not other.requires_grad
        assert torch.equal(other, wanted)
    single = points.float(), forward, starts.float()
    with torch.autocast("cpu", torch.bfloat16):
        cast = find_correspondences_on_map(*single).canonical
    assert torch.equal(cast, find_correspondences_on_map(*single).canonical)
    torch.testing.assert_close(cast.double(), wanted, atol=1e-5, rtol=0)


def test_a_map_that_holds_inference_tensors(scene):
    """As a loop of evaluation has them, where the poses are computed too."""
    forward, points, starts = scene
    with torch.inference_mode():
        transforms = forward.transforms * 1.0
        offset = torch.zeros(3, dtype=torch.float64)

        def moved(x, pose_index):
            blended = torch.einsum("kj,kjrc->krc", forward.weights(x), transforms[pose_index])
            return torch.einsum("krc,kc->kr", blended[..., :3], x + offset) + blended[..., 3]

        assert transforms.is_inference()
        inside = find_correspondences_on_map(points, moved, starts, search=EXACT)
    with torch.no_grad():
        transforms, offset = transforms.clone(), offset.clone()
        outside = find_correspondences_on_map(points, moved, starts, search=EXACT)
    assert len(inside.query) > 50
    assert torch.equal(inside.canonical, outside.canonical)
    assert torch.equal(inside.jacobian_inverse, outside.jacobian_inverse)


def test_a_box_bounds_the_roots_and_is_the_unit(scene):
    forward, points, starts = scene
    half = CanonicalGrid(torch.tensor([0.0, -2, -2]), torch.full((3,), 2.0))
    everywhere = find_correspondences_on_map(points, forward, starts, search=EXACT)
    inside = find_correspondences_on_map(points, forward, starts, half, search=EXACT)
    assert set(inside.query.tolist()) == set(everywhere.query[everywhere.canonical[:, 0] > 0].tolist())
    assert bool((inside.canonical >= half.lower).all())
    rough = SearchConfig("broyden", None, "broyden", tolerance=1e-2)
    large = CanonicalGrid(torch.full((3,), -50.0), torch.full((3,), 50.0))
    for grid, unit in ((None, 1.0), (large, 100.0)):
        found = find_correspondences_on_map(points, forward, starts, grid, search=rough)
        with torch.no_grad():
            residual = (forward(found.canonical, found.pose) - points.reshape(-1, 3)[found.query]).norm(dim=1)
        assert 0.05 * unit < float(residual.max()) / 1e-2 < unit


@pytest.mark.parametrize(("batch", "count", "number"), [(0, 5, 2), (2, 0, 2), (2, 5, 0), (2, 1, 1)])
def test_few_points_and_no_starts(batch, count, number):
    points = torch.zeros(batch, count, 3, dtype=torch.float64, requires_grad=True)
    starts = torch.full((batch, count, number, 3), 0.2, dtype=torch.float64)
    found = find_correspondences_on_map(points, OffsetMap(max(batch, 1)), starts)
    assert found.found.shape == (batch, count)
    assert len(found.query) == batch * count * number
    found.canonical.sum().backward()
    assert points.grad.shape == points.shape


def test_points_and_starts_that_are_none(scene):
    forward, points, starts = scene
    points[0, 3], starts[1, 4], starts[:, :, 1] = torch.nan, torch.inf, torch.nan
    found = find_correspondences_on_map(points, forward, starts, search=EXACT)
    assert found.counts.sum() == 58
    assert not bool(found.found[0, 3])
    assert not bool(found.found[1, 4])


def test_six_threads_at_once(scene):
    forward, points, starts = scene

    def roots(seed):
        return find_correspondences_on_map(points, forward, starts + 1e-3 * seed).canonical.detach()

    wanted = [roots(seed) for seed in range(12)]
    with ThreadPoolExecutor(6) as pool:
        assert all(torch.equal(a, b) for a, b in zip(pool.map(roots, range(12)), wanted, strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": torch.zeros(3, 3)}, r"points: wanted shape \[B, N, 3\], got \[3, 3\]"),
        ({"points": torch.zeros(1, 2, 3).half()}, "points: wanted float32 or float64, got torch.float16"),
        ({"starts": torch.zeros(1, 2, 3)}, r"starts: wanted shape \[1, 2, I, 3\] to fit points, got \[1, 2, 3\]"),
        ({"starts": torch.zeros(1, 2, 1, 3).double()}, "starts: wanted the dtype of points, torch.float32, got torch.float64"),
        ({"forward": lambda x: x[:, :2]}, r"forward: wanted posed points of shape \[2, 3\], got \[2, 2\]"),
        ({"forward": lambda x: (x, x)}, r"forward: wanted posed points of shape \[2, 3\], got tuple"),
        ({"forward": lambda x: x.double()}, "forward: wanted posed points of the dtype of points, torch.float32, got torch.f"),
        ({"forward": lambda x: x.detach()}, "forward: wanted a result that is differentiable by the canonical points"),
        ({"forward": lambda x: nn.Parameter(torch.ones(2, 3))}, "forward: wanted a result that is differentiable by the"),
        ({"search": "complete"}, "search.name: wanted broyden, got 'complete': a map has no cells to search"),
        ({"search": SearchConfig("broyden", [0])}, r"search.init_bones: wanted None beside starts, got \[0\]"),
        ({"search": SearchConfig("broyden", tolerance=0.0)}, "search.tolerance: wanted more than 0, got 0.0"),
        ({"points_at_once": 0}, "points_at_once: wanted at least 1, got 0"),
    ],
)  # fmt: skip
def test_arguments_that_do_not_fit_are_named(changes, message):
    arguments = {"points": torch.zeros(1, 2, 3), "forward": lambda x: 2 * x, "starts": torch.zeros(1, 2, 1, 3)}
    with pytest.raises((ValueError, TypeError), match=message):
        find_correspondences_on_map(**(arguments | changes))
