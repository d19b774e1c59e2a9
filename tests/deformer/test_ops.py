"""The native operators: PyTorch's own checks of operators, compilation, gradients, and what wrong input gets."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import random_transforms, scene, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, blend_transforms, find_correspondences
from snarfcli.deformer.blending import blend, blend_backward
from snarfcli.deformer.implicit import implicit_backward, implicit_backward_reference
from snarfcli.deformer.ops import broyden_search, complete_search
from snarfcli.native import cpu

SHAPE = (6, 7, 8)


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
    theirs = implicit_backward_reference(gradient, canonical, query, inverse, grid.lower, grid.upper, shape, 2, 40, True, True)
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


OTHER_DEVICES = ["MPS", "XPU", "HPU", "PrivateUse1"]


@pytest.mark.parametrize("key", OTHER_DEVICES)
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_tensors_of_other_devices_run_the_reference(monkeypatch, search, key):
    """The dispatcher hands them to the default kernel, which never reaches the CPU library."""
    operator = {"complete": complete_search, "broyden": broyden_search}[search]
    *arguments, _ = operator_arguments(search=search, count=6)
    wanted = operator(*arguments, "reference")
    _, transforms, weights = scene(torch.float64, count=6)
    bones = transforms[:, :, :3].reshape(2, -1, 12)
    gradient = (torch.ones_like(wanted[0]), *wanted[:3], unit_grid().lower, unit_grid().upper, list(SHAPE), 2, 6, True, True)
    calls = [
        (operator, arguments),
        (implicit_backward, gradient),
        (blend, (weights, bones, None)),
        (blend_backward, (torch.ones(2, 336, 12, dtype=torch.float64), weights, bones, None, True, True)),
    ]
    results = [call(*given, "reference") for call, given in calls]

    def fail():
        raise AssertionError("the CPU library was called")

    monkeypatch.setattr(cpu, "_library", fail)
    keys = torch._C.DispatchKeySet(getattr(torch._C.DispatchKey, key))
    for (call, given), expected in zip(calls, results, strict=True):
        assert not torch._C._dispatch_has_kernel_for_dispatch_key(call._qualname, key)
        assert torch._C._dispatch_has_kernel_for_dispatch_key(call._qualname, "CPU")
        found = call._opoverload.redispatch(keys, *given, "auto")
        for mine, theirs in zip(*((x,) if isinstance(x, torch.Tensor) else x for x in (found, expected)), strict=True):
            assert torch.equal(mine, theirs)
    with pytest.raises(AssertionError, match="the CPU library was called"):
        operator(*arguments, "auto")


def test_meta_tensors_only_get_shapes():
    *arguments, _, _ = operator_arguments(count=6)
    meta = [value.to("meta") if isinstance(value, torch.Tensor) else value for value in arguments]
    found = complete_search(*meta, 30, "native")
    assert [list(part.shape) for part in found] == [[30, 3], [30], [30, 3, 3], [1]]
    assert {part.device.type for part in found} == {"meta"}


@pytest.mark.parametrize("capacity", [None, 300])
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_compiles_without_a_graph_break(search, capacity):
    points, transforms, weights = scene(torch.float64, count=8)
    grid = unit_grid()
    weights.requires_grad_()

    def loss(points, transforms, weights):
        found = find_correspondences(points, transforms, weights, grid, search=search, capacity=capacity)
        return found.maximum(found.canonical.square().sum(1), 0.0).sum()

    # With a capacity the shapes are known; without, PyTorch traces a size that depends on the data only with this option.
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
    free = find_correspondences(points, transforms, weights, grid, search=SearchConfig(backend=backend))
    roomy = find_correspondences(
        points, transforms, weights, grid, search=SearchConfig(backend=backend), capacity=len(free.query) + 9
    )
    assert len(roomy.query) == len(free.query) + 9
    assert int(roomy.total) == len(free.query)
    assert torch.equal(roomy.canonical[:-9], free.canonical)
    assert bool((roomy.query[-9:] == 60).all())
    assert torch.equal(roomy.found, free.found)
    assert torch.equal(roomy.padded()[0], free.padded()[0])
    assert torch.equal(roomy.maximum(roomy.canonical[:, 0], -9.0), free.maximum(free.canonical[:, 0], -9.0))
    gradients = [torch.autograd.grad(f.canonical.square().sum(), weights)[0] for f in (free, roomy)]
    assert torch.allclose(*gradients)
    tight = find_correspondences(points, transforms, weights, grid, search=SearchConfig(backend=backend), capacity=5)
    assert torch.equal(tight.canonical, free.canonical[:5])
    assert int(tight.total) == len(free.query)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_an_empty_batch_has_no_gradient_to_give(backend):
    _, _, weights = scene(torch.float64)
    weights.requires_grad_()
    for capacity in (None, 7):
        empty = torch.empty(0, 5, 3, dtype=torch.float64), torch.empty(0, 4, 4, 4, dtype=torch.float64, requires_grad=True)
        found = find_correspondences(*empty, weights, unit_grid(), search=SearchConfig(backend=backend), capacity=capacity)
        assert int(found.total) == 0
        assert len(found.query) == (capacity or 0)
        (gradient,) = torch.autograd.grad(found.canonical.sum(), weights)
        assert not gradient.any()


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_autocast_changes_nothing(backend):
    points, transforms, weights = scene()
    plain = find_correspondences(points, transforms, weights, unit_grid(torch.float32), search=SearchConfig(backend=backend))
    with torch.autocast("cpu", torch.bfloat16):
        mixed = find_correspondences(
            points, transforms, weights, unit_grid(torch.float32), search=SearchConfig(backend=backend)
        )
    assert torch.equal(plain.query, mixed.query)
    assert torch.allclose(plain.canonical, mixed.canonical, atol=1e-6)


def test_the_inverse_carries_no_gradient():
    points, transforms, weights = scene(torch.float64)
    found = find_correspondences(points, transforms, weights.requires_grad_(), unit_grid())
    assert found.canonical.requires_grad
    assert not found.jacobian_inverse.requires_grad
    outputs = complete_search(*operator_arguments(requires_grad=True))
    assert [out.requires_grad for out in outputs] == [True, False, False, False]


def test_the_largest_value_is_that_of_a_root_however_low():
    points, transforms, weights = scene(torch.float64)
    found = find_correspondences(points, transforms, weights, unit_grid())
    lowest = found.maximum(torch.full((len(found.query),), -40.0, dtype=torch.float64), 0.0)
    assert torch.equal(lowest, torch.where(found.found, -40.0, 0.0).double())


CASES = {
    "nan transform": (lambda p, t, w: (p, t * torch.nan, w), {}, "bone_transforms: wanted finite numbers"),
    "singular transform": (lambda p, t, w: (p, torch.zeros_like(t), w), {}, "singular one for bone 0 of pose 0"),
    "weights do not sum to 1": (lambda p, t, w: (p, t, w * 0.7), {}, "a sum of 1 at every node .* got 0.7"),
    "no weights": (lambda p, t, w: (p, t, w * 0), {}, "a sum of 1 at every node .* got 0"),
    "no bones": (lambda p, t, w: (p, t[:, :0], w[..., :0]), {}, r"skinning_weights: wanted shape \[D, H, W, J\]"),
    "tolerance": (lambda p, t, w: (p, t, w), {"tolerance": -1e-6}, "search.tolerance: wanted more than 0, got -1e-06"),
    "no number": (lambda p, t, w: (p, t, w), {"tolerance": float("nan")}, "search.tolerance: wanted more than 0, got nan"),
    "steps": (lambda p, t, w: (p, t, w), {"max_steps": 0}, "search.max_steps: wanted more than 0, got 0"),
    "starts without need": (lambda p, t, w: (p, t, w), {"init_bones": [0]}, "search.init_bones needs search.name 'broyden'"),
    "cells without need": (
        lambda p, t, w: (p, t, w),
        {"name": "broyden", "active_cells": torch.ones([n - 1 for n in SHAPE], dtype=torch.bool)},
        "active_cells needs search.name 'complete'",
    ),
    "backend": (lambda p, t, w: (p, t, w), {"backend": "gpu"}, "search.backend: wanted auto, native or reference, got 'gpu'"),
    "capacity": (lambda p, t, w: (p, t, w), {"capacity": -1}, "capacity: wanted 0 or more, got -1"),
}


@pytest.mark.parametrize("case", CASES)
def test_wrong_values_are_named(case):
    change, settings, message = CASES[case]
    others = {name: settings[name] for name in ("active_cells", "capacity") if name in settings}
    search = SearchConfig(**{name: value for name, value in settings.items() if name not in others})
    given = change(*scene())
    with pytest.raises(ValueError, match=message):
        find_correspondences(*given, unit_grid(torch.float32), search=search, **others)
