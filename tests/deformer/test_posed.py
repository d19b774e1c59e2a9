"""Poses that are prepared once: the same roots, gradients and points as without, for any chunks, threads and backend."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from skinning_scenes import random_transforms, scene, smooth_weights, unit_grid
from torch import nn

from snarfcli.deformer import (
    ForwardDeformer,
    NodeWeights,
    SearchConfig,
    SkinningConfig,
    find_correspondences,
)
from snarfcli.deformer.weights import GridWeights
from snarfcli.native import cpu

SHAPE = (6, 7, 8)


class Trained(GridWeights):
    """Weights at the nodes that are optimised as they are; they need not sum to 1 for a gradient check."""

    def __init__(self, weights: torch.Tensor) -> None:
        super().__init__(unit_grid(weights.dtype), tuple(weights.shape[:3]))
        self.values = nn.Parameter(weights.reshape(-1, weights.shape[-1]).clone())

    def at_nodes(self, nodes=None):
        return self.values if nodes is None else self.values[nodes]


def deformer_of(weights: torch.Tensor, search: SearchConfig | str = "complete", cells=None) -> ForwardDeformer:
    depth, height, width, bones = weights.shape
    skinning = SkinningConfig("voxel", resolution=[width, height, depth])
    return ForwardDeformer(unit_grid(weights.dtype), bones, skinning, search, cells, field=Trained(weights))


def field_deformer(dtype=torch.float64) -> ForwardDeformer:
    """Return a deformer whose field is searched directly."""
    torch.manual_seed(0)
    skinning = SkinningConfig("mlp", resolution=[8, 7, 6], width=16, depth=2)
    return ForwardDeformer(unit_grid(torch.float32), 3, skinning, SearchConfig("broyden", max_steps=50, divergence=5.0)).to(
        dtype
    )


def assert_same(found, wanted, atol: float = 0.0) -> None:
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, rtol=0, atol=atol)
    torch.testing.assert_close(found.jacobian_inverse, wanted.jacobian_inverse, rtol=1e-3 if atol else 0, atol=atol)


# ---------------------------------------------------------------- roots
@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("bones", "angle", "shape"),
    [(2, 1.5, (5, 7, 9)), (24, 1.0, (6, 9, 17)), (55, 1.2, (12, 9, 8)), (5, 2.5, (2, 2, 2)), (7, 2.0, (3, 4, 37))],
)
def test_roots_are_those_of_an_unprepared_search(backend, dtype, bones, angle, shape, monkeypatch):
    """Folds included, where cells are cut into parts; the search that is compared with is compared with an exhaustive one."""
    monkeypatch.setattr(cpu, "_MANY", math.inf)  # not for many queries, which are searched as without preparation
    count = 300 if backend == "native" else 60
    points, transforms, weights = scene(dtype, 2, count, bones, angle, shape, 3)
    deformer = deformer_of(weights, SearchConfig(backend=backend))
    wanted = deformer(points, transforms)
    assert len(wanted.query) > count
    posed = deformer.pose(transforms)
    tolerance = 2e-5 if dtype == torch.float32 else 1e-9
    assert_same(posed(points), wanted, tolerance)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    for chunk in order.split(37):
        assert_same(posed(points[:, chunk]), deformer(points[:, chunk], transforms), tolerance)


@pytest.mark.parametrize("threads", [1, 2, 5, 16])
def test_roots_do_not_depend_on_the_threads_that_prepare_and_search(threads):
    """One pose is sorted by several of them."""
    points, transforms, weights = scene(torch.float32, 1, 5000, 24, 1.5, (16, 17, 19), 3)
    deformer = deformer_of(weights)
    wanted, before = deformer(points, transforms), torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        assert_same(deformer.pose(transforms)(points), wanted, 2e-5)
    finally:
        torch.set_num_threads(before)


_COMPARE = """
import sys
sys.path[:0] = {paths!r}
import torch
from test_posed import assert_same, deformer_of, scene
from snarfcli.native.library import native_library
assert native_library() is not None
for dtype in (torch.float32, torch.float64):
    points, transforms, weights = scene(dtype, 2, 300, 24, 1.5, (6, 9, 17), 3)
    deformer = deformer_of(weights)
    assert_same(deformer.pose(transforms)(points), deformer(points, transforms), 2e-5)
"""


@pytest.mark.parametrize("name", ["avx2", "baseline"])
def test_lower_instruction_sets_find_the_same(name):
    """They have fewer lanes, so pairs of points and cells wait in other numbers."""
    here = Path(__file__).parent
    program = _COMPARE.format(paths=[str(here), str(here.parent)])
    subprocess.run([sys.executable, "-c", program], env=os.environ | {"SNARF_INSTRUCTION_SET": name}, check=True)


def test_broyden_searches_and_fields_are_posed_too():
    points, transforms, weights = scene(torch.float64, bones=3)
    starts = torch.stack([points, -points], 2)
    for deformer in (deformer_of(weights, SearchConfig("broyden", max_steps=30)), field_deformer()):
        posed = deformer.pose(transforms)
        assert_same(posed(points), deformer(points, transforms))
        assert_same(posed(points, starts=starts), deformer(points, transforms, starts=starts))


@pytest.mark.parametrize("many", [0, math.inf])
def test_points_anywhere_are_answered(many, monkeypatch):
    monkeypatch.setattr(cpu, "_MANY", many)
    points, transforms, weights = scene()
    points[0, 0, 1] = math.nan
    points[0, 1] = math.inf
    points[1, 2] = 1e30
    posed = deformer_of(weights).pose(transforms)
    assert_same(posed(points), deformer_of(weights)(points, transforms))
    for batch, count in ((2, 0), (0, 5), (0, 0)):
        found = deformer_of(weights).pose(transforms[:batch])(points[:batch, :count])
        assert found.counts.shape == (batch, count)
        assert len(found.query) == 0


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_settings_of_the_search_are_kept(backend):
    """Active cells, orientation and capacity; cells that are made active later do not change a pose."""
    points, transforms, weights = scene(angle=1.5, count=200)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[1:4, :, 2:] = True
    search = SearchConfig(orientation_preserving=True, backend=backend)
    deformer = deformer_of(weights, search, cells)
    posed, wanted = deformer.pose(transforms), deformer(points, transforms)
    assert len(wanted.query) < len(deformer_of(weights, SearchConfig(backend=backend))(points, transforms).query)
    deformer.set_active_cells(~cells)
    assert_same(posed(points), wanted, 2e-5)
    some = posed(points, capacity=20)
    assert len(some.query) == 20
    assert int(some.total) == len(wanted.query)


def test_a_body_that_is_far_away_is_found():
    points, transforms, weights = scene(torch.float64)
    transforms[1, :, :3, 3] += 8192.0
    points[1] += 8192.0
    deformer = deformer_of(weights.float())
    posed = deformer.pose(transforms.float())
    assert_same(posed(points.float()), deformer(points.float(), transforms.float()))
    lower, upper = posed.box
    assert bool((lower[1] > 8000).all())
    canonical = unit_grid(torch.float32).nodes(SHAPE).reshape(1, -1, 3).expand(2, -1, 3)
    moved = posed.skin(canonical)
    assert bool((moved >= lower[:, None]).all())
    assert bool((moved <= upper[:, None]).all())
    torch.testing.assert_close(moved, deformer.skin(canonical, transforms.float()), rtol=0, atol=4e-3)


def test_six_threads_share_a_pose():
    points, transforms, weights = scene(count=600)
    deformer = deformer_of(weights)
    posed, wanted = deformer.pose(transforms), deformer(points, transforms)
    loss = posed(points).canonical.square().sum()
    loss.backward()
    whole = deformer.field.values.grad.clone()
    deformer.field.values.grad = None
    results, gradients = [None] * 6, [None] * 6

    def work(number: int) -> None:
        mine = deformer.pose(transforms) if number % 2 else posed
        results[number] = [mine(chunk) for chunk in points.split(100, 1)]
        if number % 2:
            total = sum(found.canonical.square().sum() for found in results[number])
            gradients[number] = torch.autograd.grad(total, deformer.field.values)[0]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in range(6):
        assert sum(len(found.query) for found in results[number]) == len(wanted.query)
        assert_same(results[number][0], deformer(points[:, :100], transforms))
    for number in (1, 3, 5):
        torch.testing.assert_close(gradients[number], whole, rtol=1e-4, atol=1e-4)


# ---------------------------------------------------------------- gradients
@pytest.mark.parametrize("search", ["complete", "broyden"])
@pytest.mark.parametrize("backend", ["native", "reference"])
def test_gradients_of_chunks_add_up_to_those_of_one_call(search, backend):
    points, transforms, weights = scene(torch.float64, angle=0.2)
    points, transforms = points.requires_grad_(), transforms.requires_grad_()
    deformer = deformer_of(weights, SearchConfig(search, backend=backend))
    inputs = (points, transforms, deformer.field.values)

    def loss(found):
        return (found.canonical * torch.tensor([1.0, -2.0, 0.5])).square().sum()

    wanted = torch.autograd.grad(loss(deformer(points, transforms)), inputs)
    posed = deformer.pose(transforms)
    total = sum(loss(posed(chunk)) for chunk in points.split(7, 1))
    for mine, theirs in zip(torch.autograd.grad(total, inputs), wanted, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_gradcheck():
    points, transforms, weights = scene(torch.float64, batch=1, count=6, bones=2, angle=0.2, shape=(3, 3, 3))
    deformer = deformer_of(weights)
    x = 0.5 * points.clone()

    def roots(points, rotations, values):
        upper = torch.cat([rotations, transforms[:, :, 3:]], 2)
        grid = NodeWeights(values, unit_grid())
        posed = deformer.pose(upper, weights=grid)
        found = [posed(chunk) for chunk in points.split(2, 1)]
        skinned = posed.skin(x, directions=points, normals=points)
        return (*(one.canonical for one in found), *skinned, posed.transforms_at(0.3 * points))

    arguments = (points, transforms[:, :, :3], weights)
    torch.autograd.gradcheck(roots, tuple(value.requires_grad_() for value in arguments), atol=1e-4)


def test_passes_do_not_disturb_each_other():
    """One that is not asked for the weights, one that is repeated, one that fails on the way."""
    points, transforms, weights = scene(torch.float64, angle=0.2)
    points.requires_grad_()
    deformer = deformer_of(weights)
    values = deformer.field.values
    posed = deformer.pose(transforms)
    first, second = (posed(chunk).canonical.square().sum() for chunk in points.split(20, 1))
    wanted = torch.autograd.grad(first + second, values, retain_graph=True)[0]
    torch.autograd.grad(first, points, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(first + second, values, retain_graph=True)[0], wanted)

    def fail(gradient):
        raise KeyError("on the way")

    hook = values.register_hook(fail)
    with pytest.raises(KeyError):
        (first + second).backward(retain_graph=True)
    hook.remove()
    first.backward(retain_graph=True)
    second.backward()
    torch.testing.assert_close(values.grad, wanted)
    assert not posed._searched.gradients._sums._by_pass


def test_threads_go_back_through_one_pose_at_once():
    points, transforms, weights = scene(torch.float64, angle=0.2, count=200)
    deformer = deformer_of(weights)
    posed = deformer.pose(transforms)
    losses = [posed(chunk).canonical.square().sum() for chunk in points.split(50, 1)]
    wanted = [torch.autograd.grad(loss, deformer.field.values, retain_graph=True)[0] for loss in losses]
    passed: list[int] = []

    def work(number: int) -> None:
        for _ in range(20):
            mine = torch.autograd.grad(losses[number], deformer.field.values, retain_graph=True)[0]
            torch.testing.assert_close(mine, wanted[number])
            passed.append(number)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # so that threads meet
    try:
        threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert len(passed) == 80


def test_a_pass_that_fails_leaves_no_sum_behind():
    points, transforms, weights = scene()
    points.requires_grad_()
    posed = deformer_of(weights).pose(transforms)
    loss = posed(points).canonical.square().sum()

    def fail(gradient):
        raise KeyError("before the weights are reached")

    points.register_hook(fail)
    with pytest.raises(KeyError):
        loss.backward()
    gc.collect()
    assert not posed._searched.gradients._sums._by_pass


@pytest.mark.parametrize("first", [torch.no_grad, torch.inference_mode])
def test_who_asks_first_does_not_decide_on_gradients(first):
    """The transforms of cells that are not searched are blended when they are first needed."""
    points, transforms, weights = scene(torch.float64)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[2] = True
    deformer = deformer_of(weights, cells=cells)
    wanted = torch.autograd.grad(deformer.skin(points, transforms).square().sum(), deformer.field.values)[0]
    posed = deformer.pose(transforms)
    with first():
        assert not posed.skin(points).requires_grad
    mine = torch.autograd.grad(posed.skin(points).square().sum(), deformer.field.values)[0]
    torch.testing.assert_close(mine, wanted)
    with first():
        posed = deformer.pose(transforms)
    assert not posed.skin(points).requires_grad


@pytest.mark.parametrize("far", [0.0, 8192.0])
def test_a_pose_of_inference_mode_can_be_used_outside_of_it(far):
    points, transforms, weights = scene(angle=0.2)
    transforms[..., :3, 3] += far
    deformer = deformer_of(weights)
    with torch.inference_mode():
        posed = deformer.pose(transforms)
    points.requires_grad_()
    found = posed(points + far)
    (gradient,) = torch.autograd.grad(found.canonical.sum(), points)
    (wanted,) = torch.autograd.grad(deformer(points + far, transforms).canonical.sum(), points)
    torch.testing.assert_close(gradient, wanted)
    assert torch.autograd.grad(posed.skin(points, normals=points)[1].square().sum(), points)[0].isfinite().all()


def test_skinning_works_under_transforms_of_functions():
    points, transforms, weights = scene(torch.float64)
    deformer = deformer_of(weights)
    posed = deformer.pose(transforms)
    x = 0.5 * points
    wanted = torch.func.grad(lambda x: deformer.skin(x, transforms).square().sum())(x)
    torch.testing.assert_close(torch.func.grad(lambda x: posed.skin(x).square().sum())(x), wanted)
    torch.testing.assert_close(torch.func.vmap(posed.skin)(torch.stack([x, -x]))[1], posed.skin(-x))


@pytest.mark.parametrize("loss", [lambda roots: roots.square().sum(), lambda roots: roots.sum()])
def test_a_loss_that_needs_a_second_derivative_is_refused(loss):
    """Also where only the inverse Jacobian depends on the points and weights."""
    points, transforms, weights = scene(torch.float64, angle=0.2)
    points.requires_grad_()
    deformer = deformer_of(weights)
    inputs = (points, deformer.field.values)
    for found in (deformer(points, transforms), deformer.pose(transforms)(points)):
        for gradient in torch.autograd.grad(loss(found.canonical), inputs, create_graph=True):
            with pytest.raises(RuntimeError, match="second derivative of a correspondence search is not available"):
                gradient.sum().backward(retain_graph=True)


def test_gradients_of_skinning_can_be_differentiated():
    """Those by the points; a loss on them, as on a Jacobian, has the gradient by the weights."""
    points, transforms, weights = scene(torch.float64, angle=0.2)
    x = (0.5 * points).requires_grad_()
    deformer = deformer_of(weights)
    wanted, mine = (
        torch.autograd.grad(
            torch.autograd.grad(skin(x).square().sum(), x, create_graph=True)[0].square().sum(), (x, deformer.field.values)
        )
        for skin in (lambda x: deformer.skin(x, transforms), deformer.pose(transforms).skin)
    )
    for one, other in zip(mine, wanted, strict=True):
        torch.testing.assert_close(one, other)


def test_no_gradient_is_tracked_without_need():
    points, transforms, weights = scene()
    deformer = deformer_of(weights)
    with torch.no_grad():
        assert not deformer.pose(transforms)(points).canonical.requires_grad
    deformer.requires_grad_(False)
    assert not deformer.pose(transforms)(points).canonical.requires_grad
    with torch.inference_mode():
        assert len(deformer.pose(transforms)(points).query)


# ---------------------------------------------------------------- forward skinning
@pytest.mark.parametrize("make", [field_deformer, lambda: deformer_of(smooth_weights(SHAPE, 3))])
def test_no_points_and_no_poses_are_skinned(make):
    deformer, transforms = make(), random_transforms(2, 3, 0.5)
    for batch, count in ((2, 0), (0, 5), (0, 0)):
        x = torch.zeros(batch, count, 3, dtype=torch.float64)
        moves = transforms[:batch].clone().requires_grad_()
        for skin in (deformer.pose(moves).skin, lambda x, moves=moves, **more: deformer.skin(x, moves, **more)):
            moved, normals = skin(x, normals=x)
            assert moved.shape == normals.shape == x.shape
            assert not torch.autograd.grad(moved.sum() + normals.sum(), moves)[0].any()


def test_normals_of_a_field_are_moved_in_inference_mode():
    """They need a derivative of the field, which inference tensors have not."""
    deformer = field_deformer()
    x = torch.rand(2, 9, 3, dtype=torch.float64) - 0.5
    transforms = random_transforms(2, 3, 0.5)
    wanted = deformer.skin(x, transforms, normals=x)
    with torch.inference_mode():
        x, transforms = x.clone(), transforms.clone()
        for results in (deformer.skin(x, transforms, normals=x), deformer.pose(transforms).skin(x, normals=x)):
            for mine, one in zip(results, wanted, strict=True):
                torch.testing.assert_close(mine, one.detach())


@pytest.mark.parametrize("make", [field_deformer, lambda: deformer_of(smooth_weights(SHAPE, 3))])
def test_skinning_in_a_pose_is_exact(make):
    """Against plain blending, with directions and normals against differences."""
    deformer = make()
    transforms = random_transforms(2, 3, 0.5)
    generator = torch.Generator().manual_seed(0)
    x, along = (torch.rand(2, 50, 3, generator=generator, dtype=torch.float64) * 1.6 - 0.8 for _ in range(2))
    across = torch.linalg.cross(along, torch.ones_like(along))
    with torch.no_grad():
        weights = deformer.skinning_weights(x.reshape(-1, 3)).reshape(2, 50, 3)
        blended = torch.einsum("bnj,bjrc->bnrc", weights, transforms)
        wanted = torch.einsum("bnrc,bnc->bnr", blended[..., :3, :3], x) + blended[..., :3, 3]
        step = 1e-6
        moved = (deformer.skin(x + step * along, transforms) - deformer.skin(x - step * along, transforms)) / (2 * step)
        for skin, at in (
            (deformer.pose(transforms).skin, deformer.pose(transforms).transforms_at),
            (lambda x, **more: deformer.skin(x, transforms, **more), lambda x: deformer.transforms_at(x, transforms)),
        ):
            torch.testing.assert_close(skin(x), wanted)
            torch.testing.assert_close(at(x), blended)
            points, directions, normals = skin(x, directions=along, normals=across)
            torch.testing.assert_close(points, wanted)
            torch.testing.assert_close(directions, moved, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(normals.norm(dim=-1), torch.ones(2, 50, dtype=torch.float64))
            assert float((normals * directions).sum(-1).abs().max()) < 1e-9 * float(directions.norm(dim=-1).max()) + 1e-9
            assert len(skin(x, normals=across)) == 2


def test_skinning_knows_the_weights_of_all_cells():
    """Of those that are not searched as well, and beyond the grid."""
    _, transforms, weights = scene(torch.float64)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[2] = True
    deformer = deformer_of(weights, cells=cells)
    x = 3 * torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1.5
    posed = deformer.pose(transforms)
    with torch.no_grad():
        torch.testing.assert_close(posed.skin(x), deformer.skin(x, transforms))
        inside = deformer.skinning_weights(x[0].clamp(unit_grid().lower, unit_grid().upper))
        torch.testing.assert_close(deformer.skinning_weights(x[0]), inside)
        step, along = 1e-6, torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64).expand_as(x)
        difference = (posed.skin(x + step * along) - posed.skin(x - step * along)) / (2 * step)
        torch.testing.assert_close(posed.skin(x, directions=along)[1], difference, rtol=1e-5, atol=1e-5)


def test_given_weights_are_those_of_all_that_a_pose_does():
    _, transforms, weights = scene(torch.float64)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[2] = True
    deformer, other = deformer_of(weights, cells=cells), deformer_of(weights.flip(0), cells=cells)
    posed = deformer.pose(transforms, weights=other.node_weights(active_only=False))
    x = torch.rand(2, 40, 3, dtype=torch.float64) - 0.5
    torch.testing.assert_close(posed.skin(x), other.skin(x, transforms))


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_the_box_holds_all_that_is_searched(backend):
    points, transforms, weights = scene(count=500, angle=1.0)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[1:3, 2:5] = True
    deformer = deformer_of(weights, SearchConfig(backend=backend), cells)
    lower, upper = deformer.pose(transforms).box
    assert lower.shape == upper.shape == (2, 3)
    found = deformer(points, transforms)
    queries = points.reshape(-1, 3)[found.query]
    assert len(queries)
    assert bool((queries >= lower[found.pose]).all())
    assert bool((queries <= upper[found.pose]).all())
    for pose in range(2):
        box = deformer.posed_box(transforms[pose], cells)
        torch.testing.assert_close(torch.stack(box), torch.stack([lower[pose], upper[pose]]), rtol=1e-4, atol=1e-4)
    nodes = unit_grid(torch.float32).nodes(SHAPE)[1:4, 2:6].reshape(1, -1, 3).expand(2, -1, 3)
    with torch.no_grad():
        images = deformer.skin(nodes, transforms)
    assert bool((images.amin(1) >= lower).all())
    assert bool((images.amax(1) <= upper).all())


def test_autocast_changes_nothing():
    points, transforms, weights = scene()
    for deformer in (deformer_of(weights), field_deformer(torch.float32)):
        moves = transforms[:, : deformer.num_bones]
        wanted = deformer.pose(moves)(points), deformer.pose(moves).skin(points), deformer.skinning_weights(points[0])
        with torch.autocast("cpu", torch.bfloat16):
            posed = deformer.pose(moves)
            found, skinned, at_points = posed(points), posed.skin(points), deformer.skinning_weights(points[0])
            again = deformer.skin(points, moves)
        assert_same(found, wanted[0])
        assert torch.equal(skinned, wanted[1])
        assert torch.equal(at_points, wanted[2])
        torch.testing.assert_close(again, skinned, rtol=0, atol=1e-6)


def test_it_cannot_be_copied_or_pickled():
    _, transforms, weights = scene()
    for deformer in (deformer_of(weights), field_deformer(torch.float32)):
        posed = deformer.pose(transforms[:, : deformer.num_bones])
        for work in (copy.deepcopy, pickle.dumps):
            with pytest.raises(TypeError, match="send the transforms, and call"):
                work(posed)


def test_what_does_not_fit_is_named():
    """Weights as well: the native library would read beyond the end of arrays that are too small."""
    points, transforms, weights = scene()
    turned = transforms.transpose(2, 3).contiguous()

    def nodes(values):
        return NodeWeights(values, unit_grid(values.dtype))

    deformer = deformer_of(weights)
    posed = deformer.pose(transforms)
    for call, error, message in [
        (lambda: deformer.pose(transforms[0]), ValueError, r"bone_transforms: wanted shape \[B, 4, 4, 4\], got \[4, 4, 4\]"),
        (lambda: deformer.pose(transforms.double()), TypeError, "bone_transforms: wanted the dtype of the deformer"),
        (lambda: deformer.pose(transforms * math.nan), ValueError, "bone_transforms: wanted finite numbers"),
        (lambda: deformer.pose(turned), ValueError, "wanted 0, 0, 0, 1 as the last row, got .*; are they transposed"),
        (lambda: deformer(points, turned), ValueError, "wanted 0, 0, 0, 1 as the last row, got .*; are they transposed"),
        (lambda: deformer(points, {}, transforms, True), TypeError, r"bone_transforms: wanted a tensor in .*, got a dict"),
        (lambda: deformer(points, transforms, {}), TypeError, "capacity: wanted a number or None, got a dict"),
        (lambda: deformer(points.double(), transforms.double()), TypeError, "points: wanted the dtype of the deformer"),
        (lambda: posed(points[:1]), ValueError, r"points: wanted shape \[2, N, 3\] to fit the poses, got \[1, 40, 3\]"),
        (lambda: posed(points.double()), TypeError, "points: wanted the dtype of the poses"),
        (lambda: posed(points, capacity=-1), ValueError, "capacity: wanted 0 or more, got -1"),
        (lambda: posed(points, starts=points[:, :, None]), ValueError, "starts"),
        (lambda: posed.skin(points[0]), ValueError, r"canonical: wanted shape \[B, N, 3\], got \[40, 3\]"),
        (lambda: posed.skin(points, normals=points[:, :1]), ValueError, r"normals: wanted the shape of the points"),
        (lambda: posed.skin(points, normals=points.double()), TypeError, "normals: wanted the dtype of the points"),
        (lambda: deformer.skin(points.double(), transforms), TypeError, "canonical: wanted the dtype of the poses"),
        (lambda: deformer.pose(transforms, nodes(weights.double())), TypeError, "weights: wanted the dtype of the deformer"),
        (lambda: deformer.pose(transforms, nodes(weights[..., 1:])), ValueError, r"weights: wanted shape \[6, 7, 8, 4\], or"),
        (lambda: deformer.pose(transforms, nodes(weights[1:])), ValueError, r"for weights of each pose, got \[5, 7, 8, 4\]"),
        (lambda: deformer.skin(points, transforms[:, :3]), ValueError, r"bone_transforms: wanted shape \[B, 4, 4, 4\]"),
        (lambda: field_deformer().pose(transforms[:, :3].double())(points.double(), 5), ValueError, "capacity: wanted None"),
    ]:
        with pytest.raises(error, match=message):
            call()


# ---------------------------------------------------------------- weights that differ from pose to pose
class PerPose(nn.Module):
    """Weights that lean to one bone by the pose's own number."""

    def __init__(self) -> None:
        super().__init__()
        self.lean = nn.Parameter(torch.tensor([0.0, 1.0], dtype=torch.float64))

    def forward(self, x, pose_index):
        scores = torch.stack([x[:, 0], self.lean[pose_index] - x[:, 1], x[:, 2]], 1)
        return (3 * scores).softmax(1)


@pytest.mark.parametrize("name", ["distilled", "mlp"])
def test_a_field_may_depend_on_the_pose(name):
    """Each pose is that of a deformer with the weights of this pose, in roots, skinning and gradients."""
    field = PerPose()
    skinning = SkinningConfig(name, resolution=[8, 7, 6])
    search = SearchConfig("broyden", max_steps=50, divergence=5.0)
    made = {"grid": unit_grid(), "num_bones": 3, "skinning": skinning, "search": search}
    deformer = ForwardDeformer(**made, field=field)
    transforms = random_transforms(2, 3, 0.3)
    x = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    points = deformer.skin(x, transforms).detach()
    found, posed = deformer(points, transforms), deformer.pose(transforms)
    assert_same(posed(points), found)
    torch.testing.assert_close(posed.skin(x), deformer.skin(x, transforms))
    lower, upper = posed.box
    assert bool((points >= lower[:, None]).all() & (points <= upper[:, None]).all()) or name == "mlp"
    gradients = torch.autograd.grad(found.canonical.square().sum(), field.lean)[0]
    for pose in range(2):
        alone = ForwardDeformer(**made, field=lambda x, pose=pose: field(x, torch.full((len(x),), pose)))
        one = slice(pose, pose + 1)
        wanted = alone(points[one], transforms[one])
        torch.testing.assert_close(found.canonical[found.pose == pose], wanted.canonical)
        torch.testing.assert_close(
            deformer.skinning_weights(x[pose], pose_index=torch.full((30,), pose)), alone.skinning_weights(x[pose])
        )
        torch.testing.assert_close(deformer.skin(x, transforms)[pose], alone.skin(x[pose], transforms[pose]))
        gradient = torch.autograd.grad(wanted.canonical.square().sum(), field.lean)[0]
        torch.testing.assert_close(gradients[pose], gradient[pose])
    with pytest.raises(ValueError, match="pose_index: wanted the pose of each point"):
        deformer.skinning_weights(x[0])
    with pytest.raises(ValueError, match="freeze: wanted a field without a parameter pose_index"):
        deformer.freeze()
    if name == "distilled":
        nodes = deformer.node_weights(poses=2)
        assert nodes.values.shape == (2, *SHAPE, 3)
        assert_same(find_correspondences(points, transforms, nodes.values, unit_grid(), search=search), found)


def test_what_a_pose_does_can_be_compiled():
    """In one graph; preparing the pose is left to Python."""
    points, transforms, weights = scene(torch.float64, angle=0.2)
    points.requires_grad_()
    deformer = deformer_of(weights)

    def work(posed, points):
        found = posed(points, capacity=120)
        skinned, normals = posed.skin(points, normals=points)
        return found.canonical.square().sum() + (skinned * normals).sum() + posed.transforms_at(points).sin().sum()

    def whole(points):
        return work(deformer.pose(transforms), points)

    posed = deformer.pose(transforms)
    compiled = torch.compile(lambda points: work(posed, points), fullgraph=True, backend="aot_eager")
    inputs = (points, deformer.field.values)
    wanted, *gradients = [whole(points), *torch.autograd.grad(whole(points), inputs)]
    for function in (compiled, torch.compile(whole, backend="aot_eager")):
        value = function(points)
        torch.testing.assert_close(value, wanted)
        for mine, theirs in zip(torch.autograd.grad(value, inputs, retain_graph=True), gradients, strict=True):
            torch.testing.assert_close(mine, theirs)
