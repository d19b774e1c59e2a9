"""Poses that are prepared once: the same roots as without, for any threads and backend, also where weights differ by pose."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from posed_scenes import SHAPE, assert_same, deformer_of, field_deformer
from skinning_scenes import random_transforms, scene, unit_grid
from torch import nn

from snarfcli.deformer import (
    ForwardDeformer,
    SearchConfig,
    SkinningConfig,
    find_correspondences,
)
from snarfcli.native import cpu


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
