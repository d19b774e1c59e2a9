"""Gradients through poses that are prepared once: in chunks, threads and modes of autograd."""

from __future__ import annotations

import gc
import sys
import threading

import pytest
import torch
from posed_scenes import deformer_of
from skinning_scenes import scene, unit_grid

from snarfcli.deformer import (
    NodeWeights,
    SearchConfig,
)


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
