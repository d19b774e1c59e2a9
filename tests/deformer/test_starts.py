"""Broyden searches from starts of one's own, on every backend."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from cuda_emulation import EmulatedGpu, host_compiler
from skinning_scenes import posed_queries, random_transforms, scene, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, blend_transforms, find_correspondences
from snarfcli.deformer.ops import broyden_search
from snarfcli.native import cuda_launches

SHAPE = (6, 7, 8)
BACKENDS = ["native", "reference"]


def search(backend="auto", **settings):
    return SearchConfig("broyden", backend=backend, **({"tolerance": 1e-9, "max_steps": 40} | settings))


def images_under_bones(points, transforms):
    """Return B_i^-1 x', [B, N, J, 3], the starts that the papers take."""
    inverse = torch.linalg.inv(transforms)
    return torch.einsum("bjrc,bnc->bnjr", inverse[..., :3, :3], points) + inverse[:, None, :, :3, 3]


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_papers_starts_give_the_papers_roots(backend):
    points, transforms, weights = scene(torch.float64, count=60)
    wanted = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend))
    starts = images_under_bones(points, transforms)
    found = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend), starts=starts)
    assert len(found.query) > 90
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, atol=1e-7, rtol=0)
    turned = starts.permute(3, 2, 0, 1).contiguous().permute(2, 3, 1, 0)
    again = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend), starts=turned)
    assert torch.equal(again.canonical, found.canonical)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_start_beside_a_root_finds_this_root(backend):
    weights, transforms = smooth_weights(SHAPE, 4), random_transforms(2, 4, 0.3)
    pairs = [posed_queries(weights, pose, 50, seed) for seed, pose in enumerate(transforms)]
    points, canonical = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    starts = (canonical + 0.01)[:, :, None]
    found = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend), starts=starts)
    assert torch.equal(found.query, torch.arange(100))
    torch.testing.assert_close(found.canonical, canonical.reshape(-1, 3), atol=1e-7, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_that_are_not_finite_are_no_start(backend):
    points, transforms, weights = scene(torch.float64, count=30)
    starts = images_under_bones(points, transforms)
    some = starts.clone()
    some[:, :, 1, 2], some[:, :, 3, 0], some[0, 5] = torch.nan, -torch.inf, torch.nan
    found = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend), starts=some)
    wanted = find_correspondences(points, transforms, weights, unit_grid(), search=search(backend), starts=starts[:, :, ::2])
    rest = wanted.query != 5
    assert not bool(found.found[0, 5])
    assert torch.equal(found.query, wanted.query[rest])
    assert torch.equal(found.canonical, wanted.canonical[rest])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("batch", "count", "number"), [(2, 5, 0), (2, 0, 3), (0, 5, 3), (0, 0, 0)])
def test_without_starts_there_are_no_roots(backend, batch, count, number):
    points = torch.zeros(batch, count, 3, dtype=torch.float64, requires_grad=True)
    starts = torch.zeros(batch, count, number, 3, dtype=torch.float64)
    given = (points, random_transforms(batch, 3, 0.2), smooth_weights(SHAPE, 3), unit_grid())
    found = find_correspondences(*given, search=search(backend), starts=starts)
    assert found.found.shape == (batch, count)
    assert len(found.query) == 0
    found.canonical.sum().backward()
    assert not points.grad.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_starts_outside_are_moved_to_the_border(backend):
    points, transforms, weights = scene(torch.float64, count=30)
    grid = unit_grid()
    far = images_under_bones(points, transforms) * 4
    found, wanted = (
        find_correspondences(points, transforms, weights, grid, search=search(backend, divergence=2.0), starts=starts)
        for starts in (far, far.clamp(grid.lower, grid.upper))
    )
    assert len(found.query) > 30
    assert torch.equal(found.canonical, wanted.canonical)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_residual_of_a_start_is_not_judged(backend):
    """One bone: a single step leads from anywhere to the root, however small the divergence is."""
    weights, transforms = torch.ones(3, 3, 3, 1, dtype=torch.float64), random_transforms(1, 1, 1.0)
    points, canonical = posed_queries(weights, transforms[0], 20)
    starts = canonical.flip(0)[None, :, None]
    settings = search(backend, divergence=1e-6)
    found = find_correspondences(points[None], transforms, weights, unit_grid(), search=settings, starts=starts)
    assert torch.equal(found.query, torch.arange(20))
    torch.testing.assert_close(found.canonical, canonical, atol=1e-9, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_residual_after_a_step_is_judged(backend):
    """With a divergence below the tolerance only those starts are left that one step brings to a root."""
    points, transforms, weights = scene(torch.float64, count=60)
    given = (points, transforms, weights, unit_grid())
    at_first = find_correspondences(*given, search=search(backend, tolerance=1e-3, divergence=1e-6))
    one_step = find_correspondences(*given, search=search(backend, tolerance=1e-3, divergence=1e6, max_steps=1))
    everything = find_correspondences(*given, search=search(backend, tolerance=1e-3))
    assert 0 < len(at_first.query) < len(everything.query)
    assert torch.equal(at_first.query, one_step.query)
    assert torch.equal(at_first.canonical, one_step.canonical)


@pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_kernels_agree(dtype):
    """The CUDA source in the emulation, the CPU library and the reference, with starts that are none among them."""
    points, transforms, weights = scene(dtype, batch=3, count=70, angle=0.3)
    starts = images_under_bones(points, transforms)
    starts[:, ::3, 1] = torch.nan
    starts[:, 1::5, 2] = 0.9  # far from the root, with a residual beyond the divergence
    grid, tolerance = unit_grid(dtype), 5e-6 if dtype == torch.float32 else 1e-9
    nodes = blend_transforms(weights, transforms)
    given = (points, nodes, starts, grid.lower, grid.upper, list(SHAPE), tolerance, 0.25, 40, True, False, None)
    emulated = cuda_launches.run_broyden(EmulatedGpu(dtype), *given)
    native, reference = (broyden_search(*given, backend) for backend in BACKENDS)
    assert int(emulated[3]) == len(emulated[1]) > 150
    for other in (native, reference):
        assert torch.equal(emulated[1], other[1])
        # Broyden's roots are only as exact as the tolerance
        torch.testing.assert_close(emulated[0], other[0], atol=20 * tolerance, rtol=0)


def test_gradients_are_those_of_the_roots():
    weights, transforms = smooth_weights((3, 4, 5), 3), random_transforms(2, 3, 0.15)
    pairs = [posed_queries(weights, pose, 3, seed) for seed, pose in enumerate(transforms)]
    points, canonical = (torch.stack(parts) for parts in zip(*pairs, strict=True))
    starts = (canonical + 0.02)[:, :, None].requires_grad_()
    scores = weights.log()

    def roots(points, scores):
        settings = search(tolerance=1e-13, max_steps=60)
        found = find_correspondences(points, transforms, scores.softmax(-1), unit_grid(), search=settings, starts=starts)
        return found.canonical

    inputs = points.requires_grad_(), scores.requires_grad_()
    assert roots(*inputs).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, inputs, eps=1e-6, atol=1e-5)
    roots(*inputs).sum().backward()
    assert starts.grad is None


def test_the_operator_keeps_pytorchs_rules_and_compiles():
    points, transforms, weights = scene(torch.float64, count=6)
    starts, grid = images_under_bones(points, transforms), unit_grid()
    nodes = blend_transforms(weights, transforms).requires_grad_()
    given = (points, nodes, starts, grid.lower, grid.upper, list(SHAPE), 5e-6, 0.25, 15, True, False, None, "native")
    torch.library.opcheck(broyden_search, given)

    def run(points, transforms, weights, starts):
        found = find_correspondences(points, transforms, weights, grid, search="broyden", starts=starts, capacity=60)
        return found.canonical

    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(points, transforms, weights, starts), run(points, transforms, weights, starts))


def test_six_threads_at_once():
    points, transforms, weights = scene(count=500)
    starts = images_under_bones(points, transforms)

    def roots(seed):
        moved = starts + 0.01 * seed
        return find_correspondences(points, transforms, weights, unit_grid(torch.float32), search="broyden", starts=moved)

    wanted = [roots(seed).canonical for seed in range(12)]
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(roots, range(12)))
    assert all(torch.equal(mine.canonical, theirs) for mine, theirs in zip(found, wanted, strict=True))


@pytest.mark.parametrize(
    ("starts", "settings", "error", "message"),
    [
        (torch.zeros(2, 40, 5, 3), {"name": "complete"}, ValueError, "starts needs search.name 'broyden'"),
        (torch.zeros(2, 40, 5, 3), {"init_bones": [0, 2]}, ValueError, r"init_bones: wanted None beside starts, got \[0, 2\]"),
        (torch.zeros(40, 5, 3), {}, ValueError, r"starts: wanted shape \[2, 40, I, 3\] to fit points, got \[40, 5, 3\]"),
        (torch.zeros(2, 40, 5, 4), {}, ValueError, r"starts: wanted shape \[2, 40, I, 3\] to fit points, got \[2, 40, 5, 4\]"),
        (
            torch.zeros(2, 40, 5, 3).double(),
            {},
            TypeError,
            "starts: wanted the dtype of points, torch.float32, got torch.float64",
        ),
        (torch.zeros(2, 40, 5, 3, device="meta"), {}, ValueError, "starts: wanted the device of points, cpu, got meta"),
    ],
)
def test_starts_that_do_not_fit_are_named(starts, settings, error, message):
    points, transforms, weights = scene()
    config = SearchConfig(**({"name": "broyden"} | settings))
    with pytest.raises(error, match=message):
        find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=config, starts=starts)
