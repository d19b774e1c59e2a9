"""The native operators against the readable reference, an exhaustive search, and PyTorch's own checks of operators."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from ground_truth import true_roots
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import CanonicalGrid, blend_transforms, find_correspondences
from snarfcli.deformer.blending import blend, blend_backward
from snarfcli.deformer.ops import broyden_search, complete_search, implicit_backward, implicit_backward_reference

SHAPE = (6, 7, 8)


def scene(dtype=torch.float32, batch=2, count=40, bones=4, angle=0.6, shape=SHAPE, seed=0):
    """Return points [B, N, 3] with roots and some without, transforms and weights."""
    weights = smooth_weights(shape, bones, seed, dtype)
    transforms = random_transforms(batch, bones, angle, seed, dtype)
    points = torch.stack([posed_queries(weights, pose, count, seed + 1)[0] for pose in transforms])
    points[:, ::7] += 5.0
    return points, transforms, weights


def operator_arguments(dtype=torch.float64, search="complete", requires_grad=False, **sizes):
    """Return what the operators take, for a small scene."""
    points, transforms, weights = scene(dtype, **sizes)
    grid = unit_grid(dtype)
    nodes = blend_transforms(weights, transforms)
    if requires_grad:
        points.requires_grad_()
        nodes.requires_grad_()
    box = (grid.lower, grid.upper, list(weights.shape[:3]))
    if search == "complete":
        active = torch.ones([n - 1 for n in weights.shape[:3]], dtype=torch.bool)
        return points, nodes, *box, active, 5e-6, 12, False, None, "native"
    starts = torch.linalg.inv(transforms)[:, :, :3].reshape(len(transforms), -1, 12)
    return points, nodes, starts, *box, 5e-6, 0.25, 15, True, False, None, "native"


def test_the_native_library_is_loaded():
    """Nothing below may pass on the fallback unseen."""
    points, transforms, weights = scene()
    find_correspondences(points, transforms, weights, unit_grid(torch.float32), backend="native")


@pytest.mark.parametrize("search", ["complete", "broyden"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_native_and_reference_agree(search, dtype):
    """In poses without folds, where the reference misses nothing."""
    points, transforms, weights = scene(dtype, angle=0.1)
    weights.requires_grad_()
    points.requires_grad_()
    results, gradients = [], []
    for backend in ("native", "reference"):
        result = find_correspondences(points, transforms, weights, unit_grid(dtype), search=search, backend=backend)
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("bones", "angle", "shape"), [(2, 1.5, (5, 7, 9)), (24, 1.0, (6, 9, 17)), (55, 1.2, (12, 9, 8)), (5, 2.5, (2, 2, 2))]
)
def test_every_root_is_found(dtype, bones, angle, shape):
    """Folds included, where one cell holds several roots; only queries on the verge of a fold are left out."""
    weights = smooth_weights(shape, bones, 3, dtype)
    transforms = random_transforms(1, bones, angle, 5, dtype)
    points = posed_queries(weights, transforms[0], 400, 7)[0]
    grid = unit_grid(torch.float64)
    truth = true_roots(
        *(t.double().numpy() for t in (points, weights, transforms[0])), grid.lower.numpy(), grid.upper.numpy(), seam=2e-5
    )
    found = find_correspondences(points[None], transforms, weights, unit_grid(dtype), check=False)
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
    from skinning_scenes import move

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
    from skinning_scenes import move

    points = move(torch.cat([nodes, middles]), weights, transforms[0], grid)
    found = find_correspondences(points[None], transforms, weights, grid)
    assert torch.equal(found.query, torch.arange(len(points)))


def test_orientation_preserving_drops_roots_that_are_inside_out():
    points, transforms, weights = scene(batch=1, count=400, angle=1.8)
    grid = unit_grid(torch.float32)
    every = find_correspondences(points, transforms, weights, grid)
    upright = find_correspondences(points, transforms, weights, grid, orientation_preserving=True)
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
        assert torch.equal(results[0].canonical, other.canonical) and torch.equal(results[0].query, other.query)
    assert torch.equal(results[0].canonical, torch.cat([part.canonical for part in parts]))
    half = find_correspondences(points[:, :1500], transforms, weights, grid, search=search)
    first = results[0].query % 3000 < 1500
    assert torch.equal(results[0].canonical[first], half.canonical)


def test_gradient_does_not_depend_on_threads():
    points, transforms, weights = scene(batch=1, count=9000)
    weights.requires_grad_()
    before = torch.get_num_threads()
    gradients = []
    try:
        for threads in (1, 4):
            torch.set_num_threads(threads)
            found = find_correspondences(points, transforms, weights, unit_grid(torch.float32))
            gradients.append(torch.autograd.grad(found.canonical.square().sum(), weights)[0])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*gradients)


def test_backward_against_its_reference():
    arguments = operator_arguments()
    canonical, query, inverse, _ = complete_search(*arguments)
    gradient = torch.randn(canonical.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grid, shape = unit_grid(), SHAPE
    mine = implicit_backward(gradient, canonical, query, inverse, grid.lower, grid.upper, shape, 2, 40, True, True, "native")
    theirs = implicit_backward_reference(gradient, canonical, query, inverse, grid, shape, 2, 40, (True, True))
    for a, b in zip(mine, theirs, strict=True):
        assert torch.allclose(a, b, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_operators_keep_pytorchs_rules(search, requires_grad):
    operator = {"complete": complete_search, "broyden": broyden_search}[search]
    torch.library.opcheck(operator, operator_arguments(search=search, requires_grad=requires_grad, count=6))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bones", [1, 3, 24, 55])
def test_native_blending_and_its_gradient(bones, dtype, masked):
    """Against the matrix product; nodes that no active cell touches get zeros and give no gradient."""
    weights = smooth_weights(SHAPE, bones, 0, dtype)
    rows = random_transforms(3, bones, 1.0, 0, dtype)[:, :, :3].reshape(3, bones, 12)
    active = None
    used = torch.ones(SHAPE, dtype=torch.bool)
    if masked:
        active = torch.rand([n - 1 for n in SHAPE], generator=torch.Generator().manual_seed(0)) < 0.1
        used = torch.nn.functional.max_pool3d(torch.nn.functional.pad(active[None].float(), [1] * 6), 2, 1)[0] > 0
    native = blend(weights, rows, active, "native")
    expected = torch.where(used.reshape(1, -1, 1), blend(weights, rows, active, "reference"), 0.0)
    tight = {"rtol": 1e-5, "atol": 1e-6} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-13}
    assert torch.allclose(native, expected, **tight)
    noise = torch.randn(native.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
    gradient = torch.where(used.reshape(1, -1, 1), noise, 0.0)
    mine = blend_backward(gradient, weights, rows, active, True, True, "native")
    theirs = blend_backward(gradient, weights, rows, active, True, True, "reference")
    for a, b in zip(mine, theirs, strict=True):
        assert torch.allclose(a, b, rtol=tight["rtol"], atol=50 * tight["atol"])  # sums of 336 terms


def test_blending_keeps_pytorchs_rules_and_full_precision():
    _, transforms, weights = scene(torch.float64)
    bones = transforms[:, :, :3].reshape(2, -1, 12).requires_grad_()
    weights.requires_grad_()
    active = torch.ones([n - 1 for n in SHAPE], dtype=torch.bool)
    torch.library.opcheck(blend, (weights, bones, active, "native"))
    gradient = torch.ones(2, weights[..., 0].numel(), 12, dtype=torch.float64)
    torch.library.opcheck(blend_backward, (gradient, weights.detach(), bones.detach(), active, True, False, "native"))
    small = weights[:2, :2, :2].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda w, b: blend(w, b, None, "native"), (small, bones.detach().requires_grad_()))
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        rough = blend(weights.float(), bones.float(), None, "reference")
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)
    assert torch.allclose(rough.double(), blend(weights, bones, None, "reference"), atol=1e-6)


def test_backward_operator_keeps_pytorchs_rules():
    canonical, query, inverse, _ = complete_search(*operator_arguments(count=6))
    grid = unit_grid()
    torch.library.opcheck(
        implicit_backward,
        (torch.ones_like(canonical), canonical, query, inverse, grid.lower, grid.upper, list(SHAPE), 2, 6, True, True, "auto"),
    )


@pytest.mark.parametrize("capacity", [None, 300])
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_compiles_without_a_graph_break(search, capacity):
    points, transforms, weights = scene(torch.float64, count=8)
    grid = unit_grid()
    weights.requires_grad_()

    def loss(points, transforms, weights):
        found = find_correspondences(points, transforms, weights, grid, search=search, capacity=capacity)
        return found.maximum(found.canonical.square().sum(1), 0.0).sum()

    # With a capacity the shapes are known; without, PyTorch must be told to trace a size that depends on the data.
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=capacity is None):
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        value = compiled(points, transforms, weights)
        (gradient,) = torch.autograd.grad(value, weights)
    expected = loss(points, transforms, weights)
    assert torch.allclose(value, expected)
    assert torch.allclose(gradient, torch.autograd.grad(expected, weights)[0])


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_capacity_pads_or_cuts(backend):
    points, transforms, weights = scene(torch.float64, count=30)
    grid = unit_grid()
    weights.requires_grad_()
    free = find_correspondences(points, transforms, weights, grid, backend=backend)
    roomy = find_correspondences(points, transforms, weights, grid, backend=backend, capacity=len(free.query) + 9)
    assert len(roomy.query) == len(free.query) + 9 and int(roomy.total) == len(free.query)
    assert torch.equal(roomy.canonical[:-9], free.canonical) and bool((roomy.query[-9:] == 60).all())
    assert torch.equal(roomy.found, free.found) and torch.equal(roomy.padded()[0], free.padded()[0])
    assert torch.equal(roomy.maximum(roomy.canonical[:, 0], -9.0), free.maximum(free.canonical[:, 0], -9.0))
    gradients = [torch.autograd.grad(f.canonical.square().sum(), weights)[0] for f in (free, roomy)]
    assert torch.allclose(*gradients)
    tight = find_correspondences(points, transforms, weights, grid, backend=backend, capacity=5)
    assert torch.equal(tight.canonical, free.canonical[:5]) and int(tight.total) == len(free.query)


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
from test_ops import scene
from skinning_scenes import unit_grid
from snarfcli.deformer import find_correspondences
from snarfcli.deformer.library import native_library
points, transforms, weights = scene(count=500, angle=1.2)
found = find_correspondences(points, transforms, weights, unit_grid(torch.float32), backend="native")
import ctypes
name = native_library().snarf_instruction_set
name.restype = ctypes.c_char_p
torch.save((name().decode(), found.query, found.canonical), sys.argv[1])
"""


@pytest.mark.parametrize("name", ["baseline", "avx2"])
def test_lower_instruction_sets_find_the_same(name, tmp_path):
    """Each is asked for by name in a process of its own; without fused multiplications roots differ in the last bits."""
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
    mine = find_correspondences(points, transforms, weights, unit_grid(torch.float32), backend="native")
    # A query on the verge of a fold may have a root in one and none in the other.
    counts = [torch.bincount(q, minlength=1000) for q in (mine.query, query)]
    same = counts[0] == counts[1]
    assert (~same).sum() <= 2
    distance = (mine.canonical[same[mine.query]] - canonical[same[query]]).norm(dim=1)
    assert distance.max() < 1e-3 and distance.median() < 1e-6


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_an_empty_batch_has_no_gradient_to_give(backend):
    _, _, weights = scene(torch.float64)
    weights.requires_grad_()
    for capacity in (None, 7):
        empty = torch.empty(0, 5, 3, dtype=torch.float64), torch.empty(0, 4, 4, 4, dtype=torch.float64, requires_grad=True)
        found = find_correspondences(*empty, weights, unit_grid(), backend=backend, capacity=capacity)
        assert int(found.total) == 0 and len(found.query) == (capacity or 0)
        (gradient,) = torch.autograd.grad(found.canonical.sum(), weights)
        assert not gradient.any()


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_autocast_changes_nothing(backend):
    points, transforms, weights = scene()
    plain = find_correspondences(points, transforms, weights, unit_grid(torch.float32), backend=backend)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = find_correspondences(points, transforms, weights, unit_grid(torch.float32), backend=backend)
    assert torch.equal(plain.query, mixed.query) and torch.allclose(plain.canonical, mixed.canonical, atol=1e-6)


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
    found = find_correspondences(points, transforms, weights, grid, search=search, backend=backend)
    assert found.jacobian_inverse.isfinite().all() and found.found[0, 1:].all()
    (gradient,) = torch.autograd.grad(found.canonical.sum(), weights)
    assert gradient.isfinite().all()


def test_the_inverse_carries_no_gradient():
    points, transforms, weights = scene(torch.float64)
    found = find_correspondences(points, transforms, weights.requires_grad_(), unit_grid())
    assert found.canonical.requires_grad and not found.jacobian_inverse.requires_grad
    outputs = complete_search(*operator_arguments(requires_grad=True))
    assert [out.requires_grad for out in outputs] == [True, False, False, False]


def test_the_largest_value_is_that_of_a_root_however_low():
    points, transforms, weights = scene(torch.float64)
    found = find_correspondences(points, transforms, weights, unit_grid())
    lowest = found.maximum(torch.full((len(found.query),), -40.0, dtype=torch.float64), 0.0)
    assert torch.equal(lowest, torch.where(found.found, -40.0, 0.0).double())


CASES = {
    "nan transform": (lambda p, t, w: (p, t * torch.nan, w), {}, "bone_transforms must be finite"),
    "singular transform": (lambda p, t, w: (p, torch.zeros_like(t), w), {}, "singular one for bone 0 of pose 0"),
    "weights do not sum to 1": (lambda p, t, w: (p, t, w * 0.7), {}, "sum to 1 at every node .* got a sum of 0.7"),
    "no weights": (lambda p, t, w: (p, t, w * 0), {}, "sum to 1 at every node .* got a sum of 0"),
    "no bones": (lambda p, t, w: (p, t[:, :0], w[..., :0]), {}, r"skinning_weights must be \[D, H, W, J\]"),
    "tolerance": (lambda p, t, w: (p, t, w), {"tolerance": -1e-6}, "tolerance must be greater than 0, got -1e-06"),
    "no number": (lambda p, t, w: (p, t, w), {"tolerance": float("nan")}, "tolerance must be greater than 0, got nan"),
    "steps": (lambda p, t, w: (p, t, w), {"max_steps": 0}, "max_steps must be greater than 0, got 0"),
    "starts without need": (lambda p, t, w: (p, t, w), {"init_bones": [0]}, "init_bones needs search='broyden'"),
    "cells without need": (
        lambda p, t, w: (p, t, w),
        {"search": "broyden", "active_cells": torch.ones([n - 1 for n in SHAPE], dtype=torch.bool)},
        "active_cells needs search='complete'",
    ),
    "backend": (lambda p, t, w: (p, t, w), {"backend": "gpu"}, "backend must be 'auto', 'native' or 'reference', got 'gpu'"),
    "capacity": (lambda p, t, w: (p, t, w), {"capacity": -1}, "capacity must be 0 or more, got -1"),
}


@pytest.mark.parametrize("case", CASES)
def test_wrong_values_are_named(case):
    change, settings, message = CASES[case]
    with pytest.raises(ValueError, match=message):
        find_correspondences(*change(*scene()), unit_grid(torch.float32), **settings)
