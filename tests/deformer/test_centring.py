"""Bodies far from the origin of the posed or of the canonical space have the roots and gradients of bodies at the origin."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import CanonicalGrid, SearchConfig, find_correspondences, find_correspondences_on_field
from snarfcli.deformer.centring import centre

SHAPE, BONES = (6, 7, 8), 5
DIRECTION = torch.tensor([1.0, -0.5, 0.25])
SEARCHES = ["complete", "broyden", "field"]


def scene(dtype=torch.float32, angle=0.4, count=400):
    """Return points [2, N, 3], transforms and weights; lengths are multiples of 2^-10 m, so that 10 km more are exact."""
    weights = smooth_weights(SHAPE, BONES, dtype=dtype)
    transforms = random_transforms(2, BONES, angle, dtype=dtype)
    points = torch.stack([posed_queries(weights, pose, count, 1)[0] for pose in transforms])
    transforms[..., :3, 3] = coarse(transforms[..., :3, 3])
    return coarse(points), transforms, weights


def coarse(metres):
    return (1024 * metres).round() / 1024


def moved_by(offset, points, transforms):
    """Return points and transforms of bodies that stand elsewhere in posed space."""
    transforms = transforms.clone()
    transforms[..., :3, 3] += offset
    return points + offset, transforms


def distance_field(x):
    centres = torch.linspace(-0.8, 0.8, 3 * BONES).reshape(3, BONES).T.to(x)
    return torch.softmax(-4 * ((x[:, None] - centres).square().sum(-1) + 1e-3).sqrt(), -1)


def find(name, points, transforms, weights, grid=None, **options):
    grid = unit_grid(points.dtype) if grid is None else grid
    if name == "field":
        return find_correspondences_on_field(points, transforms, distance_field, grid, **options)
    return find_correspondences(points, transforms, weights, grid, search=name, **options)


def usual(found):
    """Return the queries [B N] without a root beside a fold, where J^-1 is large and the number of roots changes."""
    size = found.jacobian_inverse.flatten(1).norm(dim=1)
    ordinary = torch.ones(found.batch * found.count, dtype=torch.bool)
    ordinary[found.query[size > 100]] = False
    return ordinary


def check_same(found, wanted, distance):
    """Compare the roots of queries that are not beside a fold."""
    ordinary = usual(found) & usual(wanted)
    assert float(ordinary.float().mean()) > 0.98
    counts = [one.counts.reshape(-1)[ordinary] for one in (found, wanted)]
    assert int(counts[1].sum()) > 500
    assert torch.equal(*counts)
    mine, theirs = (one.canonical[ordinary[one.query]] for one in (found, wanted))
    assert float((mine - theirs).norm(dim=1).max()) < distance


@pytest.mark.parametrize("kilometres", [1, 10])
@pytest.mark.parametrize("name", SEARCHES)
def test_bodies_far_away_have_the_same_roots(name, kilometres):
    """The same digits, as lengths are chosen: without centring 1 to 20 % of the queries have other roots at 1 km."""
    points, transforms, weights = scene()
    wanted = find(name, points, transforms, weights)
    far = moved_by(1000 * kilometres * DIRECTION, points, transforms)
    # measured worst 5e-6 m (complete) and 7e-5 m (broyden, where J^-1 stretches the tolerance of 1e-5 m)
    check_same(find(name, *far, weights), wanted, {"complete": 2e-5}.get(name, 5e-4))


@pytest.mark.parametrize(("kilometres", "distance"), [(1, 2e-3), (10, 2e-2)])
@pytest.mark.parametrize("name", SEARCHES)
def test_coordinates_that_are_rounded_there(name, kilometres, distance):
    """float32 has 0.06 mm at 1 km and 1 mm at 10 km: points and each bone lie somewhat elsewhere."""
    points, transforms, weights = scene(torch.float64, angle=0.1)
    wanted = find(name, points, transforms, weights)
    shift = 1000 * kilometres * (DIRECTION.double() + 1 / 3)
    far_points, far = (tensor.float() for tensor in moved_by(shift, points, transforms))
    found = find(name, far_points, far, weights.float())
    inside = ((wanted.canonical.abs() - 0.9) < -distance).all(1)  # a root may be moved across the border of the box
    both = usual(wanted) & torch.zeros(800, dtype=torch.bool).index_fill(0, wanted.query[inside], True)
    assert torch.equal(found.counts.reshape(-1)[both], wanted.counts.reshape(-1)[both])
    mine, theirs = (one.canonical[both[one.query]].double() for one in (found, wanted))
    assert len(mine) > 400
    assert float((mine - theirs).norm(dim=1).max()) < distance


@pytest.mark.parametrize("name", SEARCHES)
def test_gradients_far_away_are_those_of_the_origin(name):
    points, transforms, weights = scene(torch.float64, angle=0.2, count=40)
    results = []
    for offset in (0.0, 1024.0):
        scores = weights.log().requires_grad_()
        given = [tensor.requires_grad_() for tensor in moved_by(offset * DIRECTION.double(), points, transforms)]
        found = find(name, *given, scores.softmax(-1))
        wanted = [*given, scores] if name != "field" else given
        results.append(torch.autograd.grad(found.canonical.sin().sum(), wanted))
    for far, near in zip(*reversed(results), strict=True):
        assert float(near.norm()) > 0.5
        torch.testing.assert_close(far, near, rtol=0, atol=1e-4 * float(near.abs().max()))  # Broyden's tolerance


@pytest.mark.parametrize("name", SEARCHES)
def test_a_canonical_box_far_from_the_origin(name):
    """All that is canonical is moved, the posed space too: x' = x + c, T' = T(x' - c) + o."""
    points, transforms, weights = scene(torch.float64, angle=0.1, count=60)
    starts = torch.zeros(2, 60, 1, 3, dtype=torch.float64)
    c, o = (scale * DIRECTION.double() for scale in (700.0, 3000.0))
    far_points, far = moved_by(o, points, transforms)
    far[..., :3, 3] -= (far[..., :3, :3] * c).sum(-1)
    near_grid = unit_grid()
    grid = CanonicalGrid(near_grid.lower + c, near_grid.upper + c)
    if name == "field":
        settings = SearchConfig("broyden", tolerance=1e-9, max_steps=40)
        wanted = find_correspondences_on_field(points, transforms, distance_field, near_grid, search=settings)
        found = find_correspondences_on_field(
            far_points, far, lambda x: distance_field(x - c), grid, starts=starts + c, search=settings
        )
    else:
        given = {} if name == "complete" else {"starts": starts + c}
        settings = SearchConfig(name, tolerance=1e-9, max_steps=40)
        wanted = find_correspondences(points, transforms, weights, near_grid, search=settings)
        found = find_correspondences(far_points, far, weights, grid, search=settings, capacity=300, **given)
        assert not bool(found.canonical[found.query == 120].any())
        assert not bool(found.jacobian_inverse[found.query == 120].any())
        single = find_correspondences(*(x.float() for x in (far_points, far, weights)), grid, search=name)
        assert float((single.counts == wanted.counts).float().mean()) > 0.95  # some lie at the border
    real = found.query < 120
    assert torch.equal(found.query[real], wanted.query)
    torch.testing.assert_close(found.canonical[real] - c, wanted.canonical, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["complete", "broyden"])
def test_gradcheck_with_both_spaces_far_away(name):
    points, transforms, weights = scene(torch.float64, angle=0.1, count=3)
    c, o = (scale * DIRECTION.double() for scale in (100.0, 300.0))
    near = unit_grid()
    grid = CanonicalGrid(near.lower + c, near.upper + c)

    def roots(points, turns, shifts, scores):
        rows = torch.cat([turns, (shifts + o - (turns * c).sum(-1))[..., None]], -1)
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(2, BONES, 1, 4)
        search = SearchConfig(name, tolerance=1e-12, max_steps=60)
        whole = torch.cat([rows, bottom], 2)
        return find_correspondences(points + o, whole, scores.softmax(-1), grid, search=search).canonical

    inputs = points, transforms[..., :3, :3].clone(), transforms[..., :3, 3].clone(), weights.log()
    assert roots(*inputs).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, tuple(x.requires_grad_() for x in inputs), eps=1e-5, atol=1e-4, fast_mode=True)


def test_nothing_changes_near_the_origin():
    points, transforms, _ = scene()
    grid = unit_grid(torch.float32)
    points, transforms = moved_by(torch.tensor([7.0, 0.0, 0.0]), points, transforms)
    centred = centre(transforms, grid)
    assert centred.transforms is transforms
    assert centred.grid is grid
    for same in (centred.points, centred.starts, centred.restored):
        assert same(points) is points
    far = centre(*moved_by(torch.tensor([9.0, 0.0, 0.0]), grid.lower, transforms)[1:], grid)
    assert far.transforms[..., :3, 3].norm(dim=-1).max() < 3
    assert torch.equal(far.transforms[..., :3, :3], transforms[..., :3, :3])


def test_a_pose_at_the_origin_does_not_mind_others_far_away():
    points, transforms, weights = scene()
    alone = find("complete", points[:1], transforms[:1], weights)
    points[1], transforms[1:] = moved_by(5000 * DIRECTION, points[1], transforms[1:])
    together = find("complete", points, transforms, weights)
    first = together.pose == 0
    assert torch.equal(together.canonical[first], alone.canonical)
    assert torch.equal(together.jacobian_inverse[first], alone.jacobian_inverse)


def test_one_stray_bone_and_broken_poses_do_not_count():
    _, transforms, _ = scene()
    grid = unit_grid(torch.float32)
    transforms[0, 2, :3, 3] = 1e6
    centred = centre(transforms, grid)
    assert not bool(centred.posed_origin.any())
    assert torch.equal(centred.transforms, transforms)
    transforms[0, 2, :3, 3] = 0
    transforms[1] = torch.nan
    assert centre(transforms, grid).posed_origin is None
    assert centre(transforms[:0], grid).posed_origin is None


def test_it_compiles():
    points, transforms, weights = scene(torch.float64, count=20)
    far, grid = moved_by(5000 * DIRECTION.double(), points, transforms), unit_grid()

    def run(points, transforms):
        return find_correspondences(points, transforms, weights, grid, capacity=60).canonical

    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    for given in (far, (points, transforms)):
        assert torch.equal(compiled(*given), run(*given))
