"""The search on a callable weight field: real roots, those of a finely sampled grid, and exact implicit gradients."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import random_transforms, unit_grid
from torch import nn

from snarfcli.deformer import CanonicalGrid, SearchConfig, find_correspondences, find_correspondences_on_field, skin

BONES = 4
METRE = CanonicalGrid(torch.zeros(3), torch.ones(3))


def find(points, transforms, field, *, starts=None, box=None, start_jacobian="exact", points_at_once=32_768, **settings):
    """Search with the paper's settings, changed by `settings`, lengths in metres; without bounds unless a box is given."""
    grid = box or METRE
    settings = {"tolerance": 1e-5, "max_steps": 50, "divergence": 1.0} | settings
    for name in ("tolerance", "divergence"):
        settings[name] /= grid.longest_side
    return find_correspondences_on_field(
        points,
        transforms,
        field,
        grid,
        starts=starts,
        search=SearchConfig("broyden", **settings),
        bounded=box is not None,
        start_jacobian=start_jacobian,
        points_at_once=points_at_once,
    )


class DistanceField(nn.Module):
    """A softmax of distances to bone centres, which are its parameters."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.centres = nn.Parameter(2 * torch.rand(BONES, 3, generator=generator, dtype=torch.float64) - 1)
        self.largest_call = 0

    def forward(self, x):
        self.largest_call = max(self.largest_call, len(x))
        distance = ((x[:, None] - self.centres.to(x)).square().sum(-1) + 1e-3).sqrt()
        return torch.softmax(-4 * distance, -1)


@pytest.fixture
def scene():
    """Return a field, transforms [2, J, 4, 4] of mild poses and queries [2, 40, 3] that have a root."""
    field, transforms = DistanceField(), random_transforms(2, BONES, 0.25)
    generator = torch.Generator().manual_seed(1)
    canonical = 1.6 * torch.rand(2, 40, 3, generator=generator, dtype=torch.float64) - 0.8
    with torch.no_grad():
        points = torch.stack([skin(x, field(x), pose) for x, pose in zip(canonical, transforms, strict=True)])
    return field, transforms, points


def posed(found, field, transforms):
    """Return the roots moved back to the posed frame, [M, 3]."""
    with torch.no_grad():
        rows = [skin(x[None], field(x[None]), transforms[int(b)]) for x, b in zip(found.canonical, found.pose, strict=True)]
    return torch.cat(rows)


@pytest.mark.parametrize("start_jacobian", ["exact", "blended"])
@pytest.mark.parametrize("angle", [0.3, 1.0])
def test_every_result_is_a_root_once_and_in_order(angle, start_jacobian):
    field, transforms = DistanceField(), random_transforms(3, BONES, angle)
    points = 2 * torch.rand(3, 150, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 1
    found = find(points, transforms, field, tolerance=1e-9, start_jacobian=start_jacobian)
    assert len(found.query) > 300
    assert int(found.total) == len(found.query)
    assert bool((found.query[1:] >= found.query[:-1]).all())
    residual = posed(found, field, transforms) - points.reshape(-1, 3)[found.query]
    assert float(residual.norm(dim=1).max()) < 1e-9
    same = found.query[1:] == found.query[:-1]
    assert bool(((found.canonical[1:] - found.canonical[:-1])[same].norm(dim=1) > 1e-6).all())
    assert found.padded()[0].shape[:2] == (3, 150)


def test_roots_are_those_of_a_fine_grid(scene):
    field, transforms, points = scene
    grid = unit_grid()
    with torch.no_grad():
        weights = field(grid.nodes((81, 81, 81)).reshape(-1, 3)).reshape(81, 81, 81, BONES)
    wanted = find_correspondences(points, transforms, weights, grid)
    found = find(points, transforms, field, box=grid, tolerance=1e-9)
    assert torch.equal(found.query, wanted.query)
    assert len(found.query) >= 80
    # Cells of 2.5 cm: what the trilinear field leaves out
    torch.testing.assert_close(found.canonical, wanted.canonical, atol=2e-3, rtol=0)
    difference = (found.jacobian_inverse - wanted.jacobian_inverse).flatten(1).norm(dim=1)
    error = difference / wanted.jacobian_inverse.flatten(1).norm(dim=1)
    assert float(error.median()) < 1e-2
    assert float(error.max()) < 0.1


def test_single_precision_is_as_good(scene):
    field, transforms, points = scene
    wanted = find(points, transforms, field, tolerance=1e-9)
    found = find(points.float(), transforms.float(), field)
    assert found.canonical.dtype == torch.float32
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical.double(), wanted.canonical, atol=5e-6, rtol=0)


def test_chunks_change_nothing(scene):
    field, transforms, points = scene
    kept = {}
    for at_once in (7, 100_000):
        field.zero_grad()
        field.largest_call = 0
        queries = points.clone().requires_grad_()
        found = find(queries, transforms, field, tolerance=1e-9, points_at_once=at_once)
        assert field.largest_call <= max(at_once, BONES)
        found.canonical.sin().sum().backward()
        kept[at_once] = found.canonical.detach(), queries.grad, field.centres.grad.clone()
    for few, many in zip(*kept.values(), strict=True):
        torch.testing.assert_close(few, many, atol=1e-9, rtol=1e-9)


def test_gradcheck():
    """To points, transforms and parameters of the field, by differences of the whole search along random directions."""
    field, transforms = DistanceField(), random_transforms(2, BONES, 0.15)
    points = 0.6 * torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.3

    def roots(points, upper, centres):
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(2, BONES, 1, 4)

        def with_centres(x):
            return torch.func.functional_call(field, {"centres": centres}, x)

        whole = torch.cat([upper, bottom], 2)
        return find(points, whole, with_centres, tolerance=1e-12).canonical

    inputs = points, transforms[:, :, :3].clone(), field.centres.detach().clone()
    assert roots(*inputs).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, tuple(x.requires_grad_() for x in inputs), eps=1e-6, atol=1e-5, fast_mode=True)


def test_gradient_of_a_network_equals_differences(scene):
    """A small network as the field; its parameters moved along a random direction."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 16), nn.Softplus(beta=10), nn.Linear(16, BONES), nn.Softmax(-1)).double()
    _, transforms, points = scene

    def loss():
        return find(points, transforms, network, tolerance=1e-12).canonical.sin().sum()

    for parameter in network.parameters():
        (gradient,) = torch.autograd.grad(loss(), parameter)
        direction = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        values = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                parameter += step * direction
                values.append(float(loss()))
                parameter -= step * direction
        assert float((gradient * direction).sum()) == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-5, abs=1e-7)


def test_approximate_jacobian_is_near_but_not_equal(scene):
    field, transforms, points = scene
    exact = find(points, transforms, field)
    rough = find(points, transforms, field, jacobian="broyden")
    torch.testing.assert_close(exact.canonical, rough.canonical, atol=1e-4, rtol=0)
    error = (exact.jacobian_inverse - rough.jacobian_inverse).norm() / exact.jacobian_inverse.norm()
    assert 1e-6 < error < 0.3


def test_second_derivative_is_rejected(scene):
    field, transforms, points = scene
    points = points.clone().requires_grad_()
    found = find(points, transforms, field).canonical
    for loss in (found.square().sum(), found.sum()):
        (first,) = torch.autograd.grad(loss, points, create_graph=True)
        with pytest.raises(RuntimeError, match="second derivative of a correspondence search is not available"):
            first.sum().backward(retain_graph=True)


def test_works_wherever_autograd_is_off_and_under_autocast(scene):
    field, transforms, points = scene
    wanted = find(points, transforms, field).canonical
    assert wanted.requires_grad
    with torch.no_grad():
        plain = find(points, transforms, field).canonical
    with torch.inference_mode():
        inference = find(points + 0, transforms + 0, field).canonical
    with torch.autocast("cpu", torch.bfloat16):
        cast = find(points.float(), transforms.float(), field).canonical
    for other in (plain, inference):
        assert not other.requires_grad
        assert torch.equal(other, wanted)
    assert cast.dtype == torch.float32
    torch.testing.assert_close(cast.double(), wanted, atol=5e-6, rtol=0)


def test_rigid_fields_have_one_root_each():
    """One bone everywhere, weights are constants: the root B^-1 x' is one step away from starts that are not judged."""
    transforms = random_transforms(1, BONES, 1.0)
    points = torch.rand(1, 20, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    only = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    found = find(points, transforms, lambda x: only.expand(len(x), -1), divergence=1e-6)
    inverse = torch.linalg.inv(transforms[0, 1])
    assert found.query.tolist() == list(range(20))
    torch.testing.assert_close(found.canonical, points[0] @ inverse[:3, :3].T + inverse[:3, 3])


def test_points_without_a_root_and_points_that_are_none(scene):
    field, transforms, points = scene
    points = points.clone()
    points[0, 3], points[1, 0, 2] = torch.nan, torch.inf
    points[1, 5] = 1e6
    box = CanonicalGrid(torch.full((3,), -1.0), torch.full((3,), 1.0))
    found = find(points, transforms, field, box=box)
    assert not bool(found.found[0, 3])
    assert not bool(found.found[1, 0])
    assert not bool(found.found[1, 5])
    assert int(found.found.sum()) == 77
    assert bool((found.canonical.abs() <= 1).all())


def test_a_box_keeps_roots_outside_away(scene):
    field, transforms, points = scene
    half = CanonicalGrid(torch.full((3,), -2.0), torch.tensor([0.0, 2.0, 2.0]))
    everywhere = find(points, transforms, field)
    inside = find(points, transforms, field, box=half)
    assert 0 < len(inside.query) < len(everywhere.query)
    assert bool((inside.canonical[:, 0] <= 0).all())
    assert set(inside.query.tolist()) == set(everywhere.query[everywhere.canonical[:, 0] < 0].tolist())


def test_start_bones_and_orientation():
    field, transforms = DistanceField(), random_transforms(1, BONES, 1.2)
    points = 2 * torch.rand(1, 300, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 1
    every = find(points, transforms, field)
    one = find(points, transforms, field, init_bones=[2])
    upright = find(points, transforms, field, orientation_preserving=True)
    assert len(one.query) < len(every.query)
    assert bool((torch.bincount(one.query) <= 1).all())
    positive = torch.linalg.det(every.jacobian_inverse) > 0
    assert 0 < int(positive.sum()) < len(positive)
    assert torch.equal(upright.query, every.query[positive])


def test_given_starts_replace_those_of_the_bones(scene):
    field, transforms, points = scene
    inverse = torch.linalg.inv(transforms)
    starts = torch.einsum("bjrc,bnc->bnjr", inverse[..., :3, :3], points) + inverse[:, None, :, :3, 3]
    wanted = find(points, transforms, field, tolerance=1e-9)
    found = find(points, transforms, field, tolerance=1e-9, starts=starts)
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, atol=1e-9, rtol=0)
    warm = wanted.padded()[0].detach()[:, :, :1] + 1e-3
    again = find(points, transforms, field, tolerance=1e-9, starts=warm, max_steps=4)
    assert again.query.tolist() == list(range(80))
    none = starts.clone()
    none[..., 0] = torch.nan
    assert not len(find(points, transforms, field, starts=none).query)
    assert not len(find(points, transforms, field, starts=starts[:, :, :0]).query)


class PosedField(nn.Module):
    """A distance field whose bone centres are moved by an offset of each pose."""

    def __init__(self, batch: int = 2) -> None:
        super().__init__()
        self.shared = DistanceField()
        generator = torch.Generator().manual_seed(2)
        self.offsets = nn.Parameter(0.3 * torch.randn(batch, 3, generator=generator, dtype=torch.float64))

    def forward(self, x, pose_index):
        return self.shared(x - self.offsets.to(x)[pose_index])


def test_a_field_of_each_pose(scene):
    _, transforms, points = scene
    field = PosedField()
    together = find(points, transforms, field, tolerance=1e-9)
    for b in range(2):
        alone = find(
            points[b : b + 1], transforms[b : b + 1], lambda x, b=b: field(x, torch.full((len(x),), b)), tolerance=1e-9
        )
        assert len(alone.query) > 30
        assert torch.equal(together.query[together.pose == b] - 40 * b, alone.query)
        assert torch.equal(together.canonical[together.pose == b], alone.canonical)


def test_gradcheck_of_a_field_of_each_pose():
    field, transforms = PosedField(), random_transforms(2, BONES, 0.15)
    points = 0.6 * torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.3

    def roots(points, offsets):
        def with_offsets(x, pose_index):
            return torch.func.functional_call(field, {"offsets": offsets}, (x, pose_index))

        return find(points, transforms, with_offsets, tolerance=1e-12).canonical

    inputs = points, field.offsets.detach().clone()
    assert roots(*inputs).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, tuple(x.requires_grad_() for x in inputs), eps=1e-6, atol=1e-5, fast_mode=True)


def test_a_field_that_holds_inference_tensors(scene):
    field, transforms, points = scene
    wanted = find(points, transforms, field)
    with torch.inference_mode():
        moved = transforms.clone()
        offset = torch.zeros(3, dtype=torch.float64)
        found = find(points.clone(), moved, lambda x: field(x + offset))
    assert torch.equal(found.canonical, wanted.canonical)


@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0), (1, 1)])
def test_few_points(batch, count):
    field, transforms = DistanceField(), random_transforms(batch, BONES, 0.2)
    points = torch.zeros(batch, count, 3, dtype=torch.float64, requires_grad=True)
    found = find(points, transforms, field)
    assert found.found.shape == (batch, count)
    assert int(found.found.sum()) == batch * count * (count == 1)
    found.canonical.sum().backward()
    assert points.grad.shape == points.shape


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": torch.zeros(3, 3)}, r"points: wanted shape \[B, N, 3\], got \[3, 3\]"),
        ({"bone_transforms": torch.zeros(2, 4, 4)}, r"bone_transforms: wanted shape \[1, J, 4, 4\] to fit points"),
        ({"bone_transforms": torch.zeros(1, 4, 4, 4)}, "finite and invertible"),
        ({"bone_transforms": torch.full((1, 4, 4, 4), torch.nan)}, "finite and invertible"),
        ({"bone_transforms": torch.zeros(1, 4, 4, 4).double()}, "dtype of points, torch.float32, got torch.float64"),
        ({"points": torch.zeros(1, 2, 3).half()}, "points: wanted float32 or float64"),
        ({"field": lambda x: x}, r"field: wanted weights of shape \[8, 4\], got \[8, 3\]"),
        ({"search": SearchConfig("broyden", [])}, "search.init_bones: wanted at least one bone"),
        ({"search": SearchConfig("broyden", [4])}, r"search.init_bones: wanted bones from 0 to 3, got \[4\]"),
        ({"search": SearchConfig("broyden", jacobian="rough")}, "search.jacobian: wanted exact or broyden, got 'rough'"),
        ({"start_jacobian": "rough"}, "start_jacobian: wanted exact or blended, got 'rough'"),
        ({"search": SearchConfig("broyden", tolerance=0.0)}, "search.tolerance: wanted more than 0, got 0.0"),
        ({"search": "complete"}, "search.name: wanted broyden, got 'complete': a field has no cells"),
        ({"starts": torch.zeros(2, 2, 1, 3)}, r"starts: wanted shape \[1, 2, I, 3\] to fit points, got \[2, 2, 1, 3\]"),
        ({"starts": torch.zeros(1, 2, 1, 3), "search": SearchConfig("broyden", [0])}, "search.init_bones: wanted None beside"),
        ({"points_at_once": 0}, "points_at_once: wanted at least 1, got 0"),
    ],
)
def test_arguments_that_do_not_fit_are_named(changes, message):
    arguments = {
        "points": torch.zeros(1, 2, 3), "bone_transforms": torch.eye(4).expand(1, 4, 4, 4), "field": DistanceField(),
        "grid": METRE,
    }  # fmt: skip
    with pytest.raises((ValueError, TypeError), match=message):
        find_correspondences_on_field(**(arguments | changes))
