"""The native search: against the readable reference and an exhaustive search, for any input, threads and instruction set."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from ground_truth import true_roots
from skinning_scenes import move, posed_queries, random_transforms, scene, smooth_weights, unit_grid

from snarfcli.deformer import CanonicalGrid, SearchConfig, find_correspondences

SHAPE = (6, 7, 8)


def test_the_native_library_is_loaded():
    """Nothing below may pass on the fallback unseen."""
    points, transforms, weights = scene()
    find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=SearchConfig(backend="native"))


@pytest.mark.parametrize("search", ["complete", "broyden"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_native_and_reference_agree(search, dtype):
    """Roots and gradients, in poses without folds, beside which gradients have no bound."""
    points, transforms, weights = scene(dtype, angle=0.1)
    weights.requires_grad_()
    points.requires_grad_()
    results, gradients = [], []
    for backend in ("native", "reference"):
        result = find_correspondences(
            points, transforms, weights, unit_grid(dtype), search=SearchConfig(search, backend=backend)
        )
        results.append(result)
        loss = (result.canonical * torch.tensor([1.0, -2.0, 0.5], dtype=dtype)).square().sum()
        gradients.append(torch.autograd.grad(loss, (points, weights)))
    native, reference = results
    assert torch.equal(native.query, reference.query)
    # Both stop when the residual is below 1e-5 m; Newton's last step leaves far less, Broyden's about that.
    atol = {"complete": 2e-6, "broyden": 4e-5}[search]
    assert torch.allclose(native.canonical, reference.canonical, atol=atol)
    assert torch.allclose(native.jacobian_inverse, reference.jacobian_inverse, atol=1e-3)
    for mine, theirs in zip(*gradients, strict=True):
        assert (mine - theirs).norm() <= 2e-3 * theirs.norm()


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("bones", "angle", "shape"), [(2, 1.5, (5, 7, 9)), (24, 1.0, (6, 9, 17)), (55, 1.2, (12, 9, 8)), (5, 2.5, (2, 2, 2))]
)
def test_every_root_is_found(backend, dtype, bones, angle, shape):
    """Folds included, where one cell holds several roots; only queries on the verge of a fold are left out."""
    weights = smooth_weights(shape, bones, 3, dtype)
    transforms = random_transforms(1, bones, angle, 5, dtype)
    points = posed_queries(weights, transforms[0], 400, 7)[0]
    grid = unit_grid(torch.float64)
    truth = true_roots(
        *(t.double().numpy() for t in (points, weights, transforms[0])), grid.lower.numpy(), grid.upper.numpy(), seam=2e-5
    )
    search = SearchConfig(backend=backend)
    found = find_correspondences(points[None], transforms, weights, unit_grid(dtype), search=search, check=False)
    query, canonical = found.query.numpy(), found.canonical.double().numpy()
    settled = np.flatnonzero(~truth.seam)
    assert len(settled) > 300
    most = 0
    for q in settled:
        mine, true = canonical[query == q], truth.of(q)
        most = max(most, len(true))
        assert len(mine) == len(true), f"query {q}"
        distances = np.linalg.norm(mine[:, None] - true[None], axis=-1)
        # A posed point is right to 1e-7 m in float32; the root, divided by the smallest stretch beside a fold.
        assert (distances.min(0) < 2e-3).all()
    assert most > 1


def test_jacobian_inverse_is_that_of_the_map():
    points, transforms, weights = scene(torch.float64, batch=1, angle=1.0)
    grid = unit_grid()
    found = find_correspondences(points, transforms, weights, grid)
    canonical = found.canonical.detach().requires_grad_()
    posed = move(canonical, weights, transforms[0], grid)
    rows = [torch.autograd.grad(posed[:, i].sum(), canonical, retain_graph=True)[0] for i in range(3)]
    product = torch.stack(rows, 1) @ found.jacobian_inverse
    assert torch.allclose(product, torch.eye(3).double().expand_as(product), atol=1e-6)


def test_roots_on_faces_appear_once():
    """Queries made from canonical points on faces, edges and nodes of the cells."""
    weights = smooth_weights(SHAPE, 3, 0, torch.float32)
    transforms = random_transforms(1, 3, 0.2, 0, torch.float32)
    grid = unit_grid(torch.float32)
    nodes = grid.nodes(SHAPE)[1:-1, 1:-1, 1:-1].reshape(-1, 3)
    middles = nodes + torch.tensor([0.5, 0.0, 0.0]) * grid.cell_size(SHAPE)
    points = move(torch.cat([nodes, middles]), weights, transforms[0], grid)
    found = find_correspondences(points[None], transforms, weights, grid)
    assert torch.equal(found.query, torch.arange(len(points)))


def test_orientation_preserving_drops_roots_that_are_inside_out():
    points, transforms, weights = scene(batch=1, count=400, angle=1.8)
    grid = unit_grid(torch.float32)
    every = find_correspondences(points, transforms, weights, grid)
    upright = find_correspondences(points, transforms, weights, grid, search=SearchConfig(orientation_preserving=True))
    positive = torch.linalg.det(every.jacobian_inverse) > 0
    assert 0 < positive.sum() < len(positive)
    assert torch.equal(every.canonical[positive], upright.canonical)


@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_result_does_not_depend_on_threads_or_batch(search):
    points, transforms, weights = scene(batch=3, count=3000, angle=1.0)
    grid = unit_grid(torch.float32)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 7):
            torch.set_num_threads(threads)
            results.append(find_correspondences(points, transforms, weights, grid, search=search))
    finally:
        torch.set_num_threads(before)
    poses = zip(points, transforms, strict=True)
    parts = [find_correspondences(p[None], t[None], weights, grid, search=search) for p, t in poses]
    for other in results[1:]:
        assert torch.equal(results[0].canonical, other.canonical)
        assert torch.equal(results[0].query, other.query)
    assert torch.equal(results[0].canonical, torch.cat([part.canonical for part in parts]))
    half = find_correspondences(points[:, :1500], transforms, weights, grid, search=search)
    first = results[0].query % 3000 < 1500
    assert torch.equal(results[0].canonical[first], half.canonical)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 255, 257])
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_any_number_of_queries(search, count):
    weights = smooth_weights(SHAPE, 3, 0, torch.float32)
    transforms = random_transforms(2, 3, 0.1, 0, torch.float32)
    points = torch.stack([posed_queries(weights, pose, 300, 1)[0] for pose in transforms])[:, :count]
    found = find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=search)
    assert found.query.unique().tolist() == list(range(2 * count))


def test_strided_input_is_handled():
    points, transforms, weights = scene()
    grid = unit_grid(torch.float32)
    straight = find_correspondences(points, transforms, weights, grid)
    strided = find_correspondences(
        points.transpose(0, 1).contiguous().transpose(0, 1),
        transforms.transpose(-1, -2).contiguous().transpose(-1, -2),
        weights.transpose(0, 2).contiguous().transpose(0, 2),
        grid,
    )
    assert torch.equal(straight.canonical, strided.canonical)


def test_points_that_are_no_numbers_and_points_far_away_have_no_root():
    points, transforms, weights = scene(count=20)
    clean = find_correspondences(points, transforms, weights, unit_grid(torch.float32))
    odd = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30, -1e30])
    junk = torch.tensor(list(itertools.product(odd.tolist(), [0.1, float("nan")], [float("inf"), 0.2])))
    mixed = torch.cat([points, junk[None].expand(2, -1, -1)], 1)
    for search in ("complete", "broyden"):
        found = find_correspondences(mixed, transforms, weights, unit_grid(torch.float32), search=search)
        assert not found.found[:, 20:].any()
        if search == "complete":
            assert torch.equal(found.canonical, clean.canonical)


def test_inactive_cells_hold_no_root():
    points, transforms, weights = scene(count=200)
    none = torch.zeros([n - 1 for n in SHAPE], dtype=torch.bool)
    grid = unit_grid(torch.float32)
    assert len(find_correspondences(points, transforms, weights, grid, active_cells=none).query) == 0
    half = none.clone()
    half[:, :, :3] = True
    everything = find_correspondences(points, transforms, weights, grid)
    some = find_correspondences(points, transforms, weights, grid, active_cells=half)
    border = grid.lower[0] + 3 * grid.cell_size(SHAPE)[0]
    assert torch.equal(everything.canonical[everything.canonical[:, 0] < border], some.canonical)


_SAVE = """
import sys, torch
sys.path[:0] = {paths!r}
from skinning_scenes import scene, unit_grid
from snarfcli.deformer import SearchConfig, find_correspondences
from snarfcli.native.library import native_library
points, transforms, weights = scene(count=500, angle=1.2)
search = SearchConfig(backend="native")
found = find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=search)
import ctypes
name = native_library().snarf_instruction_set
name.restype = ctypes.c_char_p
torch.save((name().decode(), found.query, found.canonical), sys.argv[1])
"""


@pytest.mark.parametrize("name", ["baseline", "avx2"])
def test_lower_instruction_sets_find_the_same(name, tmp_path):
    """Each is chosen by name in a separate process; without fused multiplications roots differ in the last bits."""
    here = os.path.dirname(__file__)
    program = _SAVE.format(paths=[here, os.path.dirname(here)])
    subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "roots.pt")],
        env=os.environ | {"SNARF_INSTRUCTION_SET": name},
        check=True,
    )
    used, query, canonical = torch.load(tmp_path / "roots.pt")
    if used != name:
        pytest.skip(f"this processor has no {name}")
    points, transforms, weights = scene(count=500, angle=1.2)
    mine = find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=SearchConfig(backend="native"))
    # A query on the verge of a fold may have a root in one and none in the other.
    counts = [torch.bincount(q, minlength=1000) for q in (mine.query, query)]
    same = counts[0] == counts[1]
    assert (~same).sum() <= 2
    distance = (mine.canonical[same[mine.query]] - canonical[same[query]]).norm(dim=1)
    assert distance.max() < 1e-3
    assert distance.median() < 1e-6


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_any_unit_of_length(scale):
    """A body in millimetres or kilometres has the same roots, in these units."""
    points, transforms, weights = scene(count=300, angle=0.8)
    metres = find_correspondences(points, transforms, weights, unit_grid(torch.float32))
    scaled = transforms.clone()
    scaled[..., :3, 3] *= scale
    box = unit_grid(torch.float32)
    other = find_correspondences(points * scale, scaled, weights, CanonicalGrid(box.lower * scale, box.upper * scale))
    assert abs(len(metres.query) - len(other.query)) <= 1
    if torch.equal(metres.query, other.query):
        assert (metres.canonical - other.canonical / scale).norm(dim=1).median() < 1e-6


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_a_cell_that_the_pose_collapses_gives_no_infinite_inverse(search, backend):
    """Two bones, one on either side, the second moved by just the side of a cell onto the first."""
    weights = torch.zeros(3, 3, 4, 2, dtype=torch.float64)
    weights[:, :, :2, 0], weights[:, :, 2:, 1] = 1.0, 1.0
    grid = CanonicalGrid(torch.zeros(3, dtype=torch.float64), torch.tensor([3.0, 2.0, 2.0], dtype=torch.float64))
    transforms = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    transforms[0, 1, 0, 3] = -1.0
    points = torch.tensor([[[1.0, 0.7, 0.6], [0.4, 0.7, 0.6], [1.5, 0.2, 0.6]]], dtype=torch.float64)
    weights.requires_grad_()
    found = find_correspondences(points, transforms, weights, grid, search=SearchConfig(search, backend=backend))
    assert found.jacobian_inverse.isfinite().all()
    assert found.found[0, 1:].all()
    (gradient,) = torch.autograd.grad(found.canonical.sum(), weights)
    assert gradient.isfinite().all()
