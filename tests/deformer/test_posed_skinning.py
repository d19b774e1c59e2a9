"""Forward skinning by poses that are prepared once, and what else a pose answers."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from posed_scenes import SHAPE, assert_same, deformer_of, field_deformer
from skinning_scenes import random_transforms, scene, smooth_weights, unit_grid

from snarfcli.deformer import (
    NodeWeights,
    SearchConfig,
)


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
