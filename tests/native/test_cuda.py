"""The CUDA kernels, run through the same launches on a GPU, where there is one, and by an emulation."""

from __future__ import annotations

import ctypes
import inspect

import pytest
import torch
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from ground_truth import true_roots
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import (
    CanonicalGrid,
    ForwardDeformer,
    SearchConfig,
    SkinningConfig,
    cells_near,
    find_correspondences,
    implicit,
    ops,
)
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import start_transforms
from snarfcli.native import cpu, cuda, cuda_compile, cuda_driver, cuda_launches
from snarfcli.native.library import native_library

SHAPE = (6, 7, 8)
HAS_GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="needs a CUDA device")


class Runner:
    """Runs a search on the emulation or on a GPU; takes and returns CPU tensors."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device, self.block = device, block

    def launcher(self, dtype):
        if self.device == "emulated":
            return EmulatedGpu(dtype, self.block)
        return cuda_driver.gpu(torch.empty(0, dtype=dtype, device="cuda"))

    def __call__(self, function, *arguments):
        place = "cpu" if self.device == "emulated" else "cuda"
        moved = [value.to(place) if isinstance(value, torch.Tensor) else value for value in arguments]
        results = function(self.launcher(moved[0].dtype), *moved)
        return [value.cpu() for value in results]

    def complete(self, points, transforms, grid, shape, active=None, **changed):
        settings = {"tolerance": 5e-6, "max_steps": 10, "orientation_preserving": False, "capacity": None} | changed
        return self(cuda_launches.run_complete, points, transforms, grid.lower, grid.upper, shape, active, *settings.values())

    def broyden(self, points, transforms, starts, grid, shape, **changed):
        settings = {
            "tolerance": 5e-6,
            "divergence": 0.25,
            "max_steps": 10,
            "exact_jacobian": True,
            "orientation_preserving": False,
            "capacity": None,
        } | changed
        return self(cuda_launches.run_broyden, points, transforms, starts, grid.lower, grid.upper, shape, *settings.values())


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


@pytest.fixture
def emulated():
    require_compiler()
    return Runner("emulated")


def scene(bones, angle, dtype=torch.float64, batch=2, count=200, shape=SHAPE):
    """Return points [B, N, 3], bone transforms, weights, grid and blended transforms."""
    grid, weights = unit_grid(dtype), smooth_weights(shape, bones, dtype=dtype)
    poses = random_transforms(batch, bones, angle, dtype=dtype)
    points = torch.stack([posed_queries(weights, pose, count, seed)[0] for seed, pose in enumerate(poses)])
    return points, poses, weights, grid, blend_transforms(weights, poses)


def check_same_roots(found, wanted, distance, relative):
    """Compare (canonical, query, jacobian_inverse) root by root; roots beside a fold are less exact, so a few may be off."""
    assert torch.equal(found[1], wanted[1])
    off = (found[0] - wanted[0]).norm(dim=1)
    size = wanted[2].flatten(1).norm(dim=1)
    inverse_off = (found[2] - wanted[2]).flatten(1).norm(dim=1) / size
    usual = size < 30  # of J^-1, which grows without bound towards a fold
    assert float(usual.float().mean()) > 0.9
    assert off[usual].max() < distance
    assert inverse_off[usual].max() < relative


def check_against_truth(canonical, query, points, pose, weights, grid):
    """Compare the roots of one pose with an exhaustive search; return how many cells have a fold in them."""
    truth = true_roots(points.numpy(), weights.numpy(), pose.numpy(), grid.lower.numpy(), grid.upper.numpy())
    for q in range(len(points)):
        if truth.seam[q]:
            continue
        roots, mine = torch.from_numpy(truth.of(q)), canonical[query == q]
        assert len(mine) == len(roots), f"query {q}"
        assert not len(roots) or torch.cdist(roots, mine).amin(1).max() < 1e-5
    return truth.folded_cells


# ---------------------------------------------------------------- arguments
def test_constants_are_those_of_the_headers():
    shared = (cuda_compile.cuda_sources() / "include" / "snarf" / "search.h").read_text()
    assert f"kSameRoot = {cuda_launches._SAME_ROOT:.0e};".replace("e-0", "e-") in shared
    assert f"kSameBroydenRoot = {cuda_launches._SAME_BROYDEN_ROOT:.0e};".replace("e-0", "e-") in shared
    assert f"kLevels = {cuda_launches._LEVELS};" in shared
    cuda = cuda_compile.cuda_sources() / "cuda"
    assert f"kThreads = {cuda_launches._THREADS};" in (cuda / "search.cuh").read_text()
    assert f"kCellThreads = {cuda_launches._CELL_THREADS};" in (cuda / "candidates.cu").read_text()


def test_functions_take_what_the_operators_take():
    for room, name in ((ops, "complete_search"), (ops, "broyden_search"), (implicit, "implicit_backward")):
        schema = getattr(room, name)._opoverload._schema
        for function in (getattr(cuda, name), getattr(cpu, name), getattr(room, f"{name}_reference")):
            taken = [parameter for parameter in inspect.signature(function).parameters if parameter != "into"]
            assert [argument.name for argument in schema.arguments] == [*taken, "backend"]


# ---------------------------------------------------------------- searching
def test_structures_match_the_kernels(emulated):
    for dtype in (torch.float32, torch.float64):
        library = build_emulation(dtype)
        assert library.search_bytes() == ctypes.sizeof(cuda_launches._Search)
        assert library.backward_bytes() == ctypes.sizeof(cuda_launches._Backward)


@pytest.mark.parametrize(("bones", "angle"), [(2, 0.3), (24, 0.2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_complete_search_equals_the_reference(runner, bones, angle, dtype):
    points, poses, weights, grid, transforms = scene(bones, angle, dtype, batch=3)
    found = runner.complete(points, transforms, grid, SHAPE)
    wanted = find_correspondences(points, poses, weights, grid, search=SearchConfig(backend="reference", max_steps=20))
    assert int(found[3]) == len(found[1]) >= 600
    # float32: coordinates to 1.5 m, measured worst 2e-6 m and 2e-5. float64: the reference's nodes are rounded to float32.
    tolerance = (1e-5, 1e-3) if dtype == torch.float32 else (1e-9, 1e-5)
    check_same_roots(found, (wanted.canonical, wanted.query, wanted.jacobian_inverse), *tolerance)


@pytest.mark.skipif(native_library() is None, reason="needs the native CPU library")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_complete_search_equals_the_cpu_library(runner, dtype):
    points, poses, weights, grid, transforms = scene(24, 0.7, dtype, batch=3, count=1000)
    found = runner.complete(points, transforms, grid, SHAPE)
    wanted = find_correspondences(points, poses, weights, grid, search=SearchConfig(backend="native"))
    assert len(found[1]) > 3500
    # Whether a root exists at all is a matter of rounding where it lies on a fold, to which J^-1 grows without bound.
    size = wanted.jacobian_inverse.flatten(1).norm(dim=1)
    doubtful = set(wanted.query[size > 1e3].tolist()) | set(found[1][found[2].flatten(1).norm(dim=1) > 1e3].tolist())
    assert len(doubtful) < 10
    keep = [torch.tensor([q not in doubtful for q in query.tolist()]) for query in (found[1], wanted.query)]
    mine = tuple(part[keep[0]] for part in found[:3])
    theirs = tuple(part[keep[1]] for part in (wanted.canonical, wanted.query, wanted.jacobian_inverse))
    check_same_roots(mine, theirs, 1e-4, 1e-2)


@pytest.mark.parametrize("angle", [0.5, 1.2])
def test_complete_search_finds_every_root_beside_folds(runner, angle):
    points, poses, weights, grid, transforms = scene(24, angle, batch=1, count=150)
    canonical, query, inverse, _ = runner.complete(points, transforms, grid, SHAPE)
    assert check_against_truth(canonical, query, points[0], poses[0], weights, grid) > 0
    assert bool((torch.linalg.det(inverse) < 0).any())
    assert bool((query.diff() >= 0).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("exact", [True, False])
def test_broyden_search_equals_the_reference(runner, dtype, exact):
    points, poses, weights, grid, transforms = scene(6, 0.4, dtype, batch=3)
    search = SearchConfig("broyden", [0, 2, 5], "exact" if exact else "broyden", backend="reference")
    wanted = find_correspondences(points, poses, weights, grid, search=search)
    starts = start_transforms(poses, [0, 2, 5])
    found = runner.broyden(points, transforms, starts, grid, SHAPE, exact_jacobian=exact)
    assert int(found[3]) == len(found[1])
    # Roots are only as exact as the tolerance, 1e-5 m; a start near the limit of the steps may go either way.
    common = sorted(set(found[1].tolist()) & set(wanted.query.tolist()))
    assert len(common) > 0.99 * max(len(set(found[1].tolist())), len(set(wanted.query.tolist()))) > 300
    for q in common:
        mine, theirs = found[0][found[1] == q], wanted.canonical[wanted.query == q]
        assert torch.cdist(mine, theirs).amin() < 1e-4
    if exact:
        one = (torch.bincount(found[1], minlength=600) == 1) & (torch.bincount(wanted.query, minlength=600) == 1)
        mine, theirs = found[2][one[found[1]]], wanted.jacobian_inverse[one[wanted.query]]
        close = (mine - theirs).flatten(1).norm(dim=1) < 1e-2 * theirs.flatten(1).norm(dim=1)
        assert float(close.float().mean()) > 0.99


def test_orientation_preserving_roots_only(runner):
    points, poses, _weights, grid, transforms = scene(24, 1.0, batch=1)
    everything = runner.complete(points, transforms, grid, SHAPE)
    preserving = runner.complete(points, transforms, grid, SHAPE, orientation_preserving=True)
    keep = torch.linalg.det(everything[2]) > 0
    assert 0 < int(keep.sum()) < len(keep)
    for mine, theirs in zip(preserving[:3], everything[:3], strict=True):
        assert torch.equal(mine, theirs[keep])
    starts = start_transforms(poses, None)
    preserving = runner.broyden(points, transforms, starts, grid, SHAPE, orientation_preserving=True)
    assert len(preserving[1])
    assert bool((torch.linalg.det(preserving[2]) > 0).all())


def test_roots_on_faces_come_once(runner):
    grid = unit_grid()
    weights = torch.ones(3, 3, 3, 1, dtype=torch.float64)
    poses = random_transforms(1, 1, 1.5)
    nodes = grid.nodes((5, 5, 5)).reshape(-1, 3)  # on faces, edges and corners of the cells, and at the border
    points = (nodes @ poses[0, 0, :3, :3].T + poses[0, 0, :3, 3])[None]
    canonical, query, inverse, _ = runner.complete(points, blend_transforms(weights, poses), grid, (3, 3, 3))
    assert torch.equal(query, torch.arange(125))
    torch.testing.assert_close(canonical, nodes, atol=1e-12, rtol=0)
    torch.testing.assert_close(inverse, poses[0, 0, :3, :3].T.expand(125, 3, 3), atol=1e-12, rtol=0)


@pytest.mark.parametrize("block", [3, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_result_does_not_depend_on_the_size_of_a_block(emulated, block, dtype, monkeypatch):
    # A wrong share of the work would show, and a barrier that some threads miss. ThreadSanitizer reports races here
    # (build_emulation() tells how to use it).
    monkeypatch.setattr(cuda_launches, "_WARPS", 2)  # that take turns
    points, poses, _weights, grid, transforms = scene(24, 0.8, dtype, batch=2, count=150, shape=(3, 4, 4))
    one = emulated.complete(points, transforms, grid, (3, 4, 4))
    assert len(one[1]) > 300
    many = Runner("emulated", block).complete(points, transforms, grid, (3, 4, 4))
    assert all(torch.equal(a, b) for a, b in zip(one, many, strict=True))
    starts = start_transforms(poses, [0, 1, 2])
    one = emulated.broyden(points, transforms, starts, grid, (3, 4, 4))
    many = Runner("emulated", block).broyden(points, transforms, starts, grid, (3, 4, 4))
    assert all(torch.equal(a, b) for a, b in zip(one, many, strict=True))


@pytest.fixture
def filled_memory():
    """Fill memory that is allocated without a value: with NaN, or with the largest integers."""
    fills = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = True
    yield
    torch.utils.deterministic.fill_uninitialized_memory = fills
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("rooms", [None, [400, 40, 30, 3, 2]], ids=["usual", "full lists"])
def test_result_does_not_depend_on_the_order_of_blocks_or_on_what_memory_held(emulated, rooms, monkeypatch, request):
    monkeypatch.setattr(cuda_launches, "_WARPS", 40)
    points, poses, _weights, grid, transforms = scene(24, 0.8, torch.float32, batch=2, count=150, shape=(3, 4, 4))
    active = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(1)) < 0.7
    place, given = (grid.lower, grid.upper, (3, 4, 4)), (False, 900)
    wanted = emulated.complete(points, transforms, grid, (3, 4, 4), active, capacity=900)
    assert 200 < int(wanted[3]) < 900
    starts = start_transforms(poses, None)
    broyden = emulated.broyden(points, transforms, starts, grid, (3, 4, 4), capacity=900)
    if rooms:
        monkeypatch.setattr(cuda_launches, "_rooms", lambda queries, slots: rooms)
    request.getfixturevalue("filled_memory")
    for seed in (1, 2, 3):
        launcher = EmulatedGpu(torch.float32, seed=seed)
        found = cuda_launches.run_complete(launcher, points, transforms, *place, active, 5e-6, 10, *given)
        assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
        assert (launcher.work["search_rest"][0].sum() > 0) == (rooms is not None)
        found = cuda_launches.run_broyden(launcher, points, transforms, starts, *place, 5e-6, 0.25, 10, True, *given)
        assert all(torch.equal(a, b) for a, b in zip(found, broyden, strict=True))


def test_result_does_not_depend_on_batch_groups_or_guesses(runner, monkeypatch):
    points, _, _, grid, transforms = scene(24, 0.7, torch.float32, batch=3)
    whole = runner.complete(points, transforms, grid, SHAPE)
    for b in range(3):
        alone = runner.complete(points[b : b + 1], transforms[b : b + 1], grid, SHAPE)
        mine = whole[1] // 200 == b
        assert torch.equal(whole[0][mine], alone[0])
        assert torch.equal(whole[2][mine], alone[2])
        assert torch.equal(whole[1][mine] - 200 * b, alone[1])
    one_cell = 4 * cuda_launches._RECORD_NUMBERS
    for group_bytes in (one_cell * 50, one_cell * 210, one_cell * 450):  # parts of a pose's 210 cells, one pose, two poses
        monkeypatch.setattr(cuda_launches, "_GROUP_BYTES", group_bytes)
        assert all(torch.equal(a, b) for a, b in zip(whole, runner.complete(points, transforms, grid, SHAPE), strict=True))
    monkeypatch.setattr(cuda_launches, "_first_guess", lambda queries: 10)
    assert all(torch.equal(a, b) for a, b in zip(whole, runner.complete(points, transforms, grid, SHAPE), strict=True))


def test_capacity_pads_cuts_and_counts(runner):
    points, poses, _, grid, transforms = scene(24, 0.7, batch=2)
    starts = start_transforms(poses, None)
    for run, start in ((runner.complete, ()), (runner.broyden, (starts,))):
        whole = run(points, transforms, *start, grid, SHAPE)
        rows = len(whole[1])
        padded = run(points, transforms, *start, grid, SHAPE, capacity=rows + 7)
        assert int(padded[3]) == rows
        assert all(len(part) == rows + 7 for part in padded[:3])
        for mine, theirs, empty in zip(padded[:3], whole[:3], (0, 400, 0), strict=True):
            assert torch.equal(mine[:rows], theirs)
            assert bool((mine[rows:] == empty).all())
        exact = run(points, transforms, *start, grid, SHAPE, capacity=rows)
        assert all(torch.equal(a, b) for a, b in zip(exact, whole, strict=True))
        cut = run(points, transforms, *start, grid, SHAPE, capacity=100)
        assert int(cut[3]) == rows
        assert torch.equal(cut[1], whole[1][:100])
        assert torch.equal(cut[0], whole[0][:100])
        nothing = run(points, transforms, *start, grid, SHAPE, capacity=0)
        assert int(nothing[3]) == rows
        assert nothing[0].shape == (0, 3)


def test_slots_that_run_out_are_counted_and_not_overrun(emulated, monkeypatch):
    points, _, _, grid, transforms = scene(24, 0.7, batch=1)
    rows = len(emulated.complete(points, transforms, grid, SHAPE)[1])
    monkeypatch.setattr(cuda_launches, "_slots_for", lambda capacity: 20)
    _canonical, query, _, found = emulated.complete(points, transforms, grid, SHAPE, capacity=rows)
    assert int(found) >= rows  # more than were kept: the caller can tell
    assert int((query < 200).sum()) <= 20
    assert bool((query[20:] == 200).all())


@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0), (0, 0), (1, 1)])
def test_few_queries_and_poses(runner, batch, count):
    _, poses, _weights, grid, transforms = scene(3, 0.4, batch=2, count=1)
    points, transforms = torch.zeros(batch, count, 3).double(), transforms[:batch]
    starts = start_transforms(poses, None)[:batch]
    for found in (
        runner.complete(points, transforms, grid, SHAPE),
        runner.broyden(points, transforms, starts, grid, SHAPE),
    ):
        assert found[0].shape == (batch * count, 3)
        assert found[2].shape == (batch * count, 3, 3)
        assert int(found[3]) == len(found[1]) == batch * count
    padded = runner.complete(points, transforms, grid, SHAPE, capacity=4)
    assert int(padded[3]) == batch * count
    assert padded[1].tolist()[batch * count :] == [batch * count] * (4 - batch * count)


def test_active_cells(runner):
    points, _poses, _weights, grid, transforms = scene(24, 0.6, batch=2)
    none = torch.zeros(5, 6, 7, dtype=torch.bool)
    assert len(runner.complete(points, transforms, grid, SHAPE, none)[1]) == 0
    some = torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(0)) < 0.5
    found = runner.complete(points, transforms, grid, SHAPE, some)
    whole = runner.complete(points, transforms, grid, SHAPE)
    size = grid.cell_size(SHAPE)
    x, y, z = ((whole[0] - grid.lower) / size).long().minimum(torch.tensor([6, 5, 4])).unbind(1)
    assert torch.equal(found[0], whole[0][some[z, y, x]])  # no root of this scene lies on a face
    strided = some.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert torch.equal(found[0], runner.complete(points, transforms, grid, SHAPE, strided)[0])


@pytest.mark.parametrize("shape", [(2, 2, 2), (2, 3, 2), (2, 2, 40)])
def test_small_and_flat_grids(runner, shape):
    points, poses, weights, grid, transforms = scene(3, 0.4, batch=2, count=50, shape=shape)
    canonical, query, _, _ = runner.complete(points, transforms, grid, shape)
    for b in range(2):
        mine = query // 50 == b
        check_against_truth(canonical[mine], query[mine] - 50 * b, points[b], poses[b], weights, grid)


def test_queries_that_are_not_finite_or_far_away(runner):
    points, poses, _weights, grid, transforms = scene(6, 0.3, torch.float32, batch=2)
    whole = runner.complete(points, transforms, grid, SHAPE)
    strange = [torch.nan, torch.inf, -torch.inf, 1e38, -1e38, 1e6, 50.0]
    more = torch.tensor([[value, 0.1, 0.2] for value in strange] + [[0.0, 0.0, value] for value in strange])
    mixed = torch.cat([more.expand(2, -1, 3), points], 1)
    starts = start_transforms(poses, None)
    for found, wanted in (
        (runner.complete(mixed, transforms, grid, SHAPE), whole),
        (runner.broyden(mixed, transforms, starts, grid, SHAPE), runner.broyden(points, transforms, starts, grid, SHAPE)),
    ):
        assert torch.equal(found[0], wanted[0])
        assert torch.equal(found[1] % 214 - 14, wanted[1] % 200)
    only = runner.complete(more[None, :5], transforms[:1], grid, SHAPE)
    assert len(only[1]) == 0


@pytest.mark.parametrize("axes", [0, 1, 2])
def test_queries_on_a_point_a_line_and_a_plane(runner, axes):
    points, _, _, grid, transforms = scene(6, 0.3, torch.float32, batch=1)
    flat = points.clone()
    flat[..., axes:] = points[:, :1, axes:]
    flat[:, 0] = points[:, 0]
    found = runner.complete(flat, transforms, grid, SHAPE)
    alone = [runner.complete(flat[:, q : q + 1], transforms, grid, SHAPE) for q in range(0, 200, 20)]
    for q, mine in zip(range(0, 200, 20), alone, strict=True):
        assert torch.equal(found[0][found[1] == q], mine[0])
    assert len(alone[0][1]) == 1


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e30, 0.0])
def test_broken_transforms_give_no_root_and_spoil_no_other(runner, value):
    points, _, _, grid, transforms = scene(6, 0.3, torch.float32, batch=2)
    whole = runner.complete(points, transforms, grid, SHAPE)
    broken = transforms.clone()
    broken[0] = value
    found = runner.complete(points, broken, grid, SHAPE)
    second = whole[1] >= 200
    assert torch.equal(found[1], whole[1][second])
    assert torch.equal(found[0], whole[0][second])
    broken = transforms.clone()
    broken[0, 0] = value  # one node, of one cell
    found = runner.complete(points, broken, grid, SHAPE)
    elsewhere = ((whole[0] - grid.lower) > grid.cell_size(SHAPE) * 1.001).any(1) | second
    for a, b in zip(whole[0][elsewhere], whole[1][elsewhere], strict=True):
        assert bool((found[0][found[1] == b] == a).all(1).any())


def test_coordinates_far_from_the_origin(runner):
    points, poses, weights, grid, transforms = scene(5, 0.4)
    near = runner.complete(points, transforms, grid, SHAPE)
    shift = torch.tensor([1000.0, -2000.0, 500.0], dtype=torch.float64)
    moved = poses.clone()
    moved[..., :3, 3] += shift
    far = runner.complete(points + shift, blend_transforms(weights, moved), grid, SHAPE)
    check_same_roots(far, near, 1e-7, 1e-4)


def test_strides_and_addresses_do_not_matter(runner):
    points, _, _, grid, transforms = scene(5, 0.4, torch.float32)
    wanted = runner.complete(points, transforms, grid, SHAPE)
    strided = points.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    shifted = torch.empty(transforms.numel() + 1)[1:].view_as(transforms).copy_(transforms)
    found = runner.complete(strided, shifted, CanonicalGrid(*torch.stack([grid.lower, grid.upper], 1).unbind(1)), SHAPE)
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_too_many_queries_are_rejected():
    points = torch.empty(1, 1, 3).expand(2**16, 2**15, 3)
    with pytest.raises(ValueError, match="points: wanted fewer than 2"):
        cuda_launches._check_limits(points.shape[0] * points.shape[1], 1)
    with pytest.raises(ValueError, match=r"fewer than 2.31 grid cells"):
        cuda_launches._check_limits(1, 2**31)


# ---------------------------------------------------------------- gradient
@pytest.mark.parametrize("block", [1, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_gradient_equals_the_reference(runner, dtype, block):
    points, _, _, grid, transforms = scene(24, 0.5, dtype, batch=3, count=60)
    canonical, query, inverse, _ = runner.complete(points, transforms, grid, SHAPE, orientation_preserving=True, capacity=300)
    assert 180 < int((query < 180).sum()) < 300  # some with several roots, and padding
    gradient = torch.randn(300, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    roots = (gradient, canonical, query, inverse)
    if runner.device == "emulated":
        runner.block = block
    wanted = implicit.implicit_backward_reference(*roots, grid.lower, grid.upper, SHAPE, 3, 60, True, True)
    found = runner(cuda_launches.run_backward, *roots, grid.lower, grid.upper, SHAPE, 3, 60, True, True)
    for mine, theirs in zip(found, wanted, strict=True):
        rounding = 1e-5 if dtype == torch.float32 else 1e-13
        torch.testing.assert_close(mine, theirs, rtol=0, atol=rounding * float(theirs.abs().max()))
    for wants in ((True, False), (False, True), (False, False)):
        part = runner(cuda_launches.run_backward, *roots, grid.lower, grid.upper, SHAPE, 3, 60, *wants)
        for mine, theirs, wanted_it in zip(part, found, wants, strict=True):
            assert torch.allclose(mine, theirs) if wanted_it else mine.numel() == 0


def test_gradient_of_no_roots_is_zero(runner):
    grid = unit_grid()
    empty = torch.zeros(0, 3).double()
    roots = (empty, empty, torch.zeros(0, dtype=torch.long), torch.zeros(0, 3, 3).double())
    v_points, v_transforms = runner(cuda_launches.run_backward, *roots, grid.lower, grid.upper, SHAPE, 2, 5, True, True)
    assert v_points.shape == (2, 5, 3)
    assert v_transforms.shape == (2, 336, 12)
    assert not v_points.any()
    assert not v_transforms.any()


# ---------------------------------------------------------------- on a GPU
@needs_gpu
def test_a_search_with_a_capacity_fits_into_a_cuda_graph():
    points, _, _, grid, transforms = scene(24, 0.5, torch.float32)
    points, transforms, grid = points.cuda(), transforms.cuda(), grid.to(points.cuda())
    rest = (grid.lower, grid.upper, SHAPE, None, 5e-6, 10, False, 600)
    place = (grid.lower, grid.upper, SHAPE, 2, 200, True, True)
    wanted = cuda.complete_search(points, transforms, *rest)
    cuda.implicit_backward(wanted[0], *wanted[:3], *place)  # loads the kernel
    static = torch.zeros_like(points)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = cuda.complete_search(static, transforms, *rest)
        v_points, _ = cuda.implicit_backward(found[0], *found[:3], *place)
    static.copy_(points)
    graph.replay()
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
    assert bool(v_points.any())


@needs_gpu
@pytest.mark.parametrize("search", ["complete", SearchConfig("broyden", [0, 2])])
def test_a_deformer_with_a_capacity_fits_into_a_cuda_graph(search):
    """Nothing in the call waits for the device: PyTorch would raise."""
    grid = unit_grid(torch.float32)
    skinning = SkinningConfig(resolution=[8, 7, 6], width=16, depth=2)
    module = ForwardDeformer(grid, 3, skinning, search, cells_near(grid, SHAPE, [(torch.zeros(1, 2, 3), 0.8)])).cuda()
    transforms = random_transforms(2, 3, 0.3, dtype=torch.float32).cuda()
    points = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0)).cuda()
    with torch.no_grad():
        wanted = module(points, transforms, capacity=300)
        torch.cuda.set_sync_debug_mode("error")
        try:
            module(points, transforms, capacity=300)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            found = module(points, transforms, capacity=300)
    graph.replay()
    assert torch.equal(found.canonical, wanted.canonical)
    assert int(found.total) > 50


@needs_gpu
def test_the_current_stream_and_device_are_used():
    points, _, _, grid, transforms = scene(24, 0.5, torch.float32)
    for index in range(torch.cuda.device_count()):
        device = torch.device("cuda", index)
        with torch.cuda.device(device), torch.cuda.stream(torch.cuda.Stream()):
            torch.cuda._sleep(50_000_000)  # the inputs come late: another stream would find zeros
            moved = torch.zeros_like(points, device=device).copy_(points.to(device))
            box = grid.to(moved)
            found = cuda.complete_search(moved, transforms.to(device), box.lower, box.upper, SHAPE, None, 5e-6, 10, False, None)
        assert found[0].device == device
        assert len(found[1]) >= 400


@needs_gpu
@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_correspondences_and_their_gradients_are_those_of_the_cpu(search):
    points, poses, weights, grid, _ = scene(6, 0.3)
    results = []
    for device in ("cpu", "cuda"):
        given = [value.detach().to(device).requires_grad_() for value in (points, poses, weights)]
        found = find_correspondences(
            *given, grid.to(given[0]), search=SearchConfig(search, backend="native", tolerance=1e-9, max_steps=30)
        )
        (found.canonical**2).sum().backward()  # on another thread, which has no CUDA context yet
        results.append([found.query.cpu(), found.canonical.detach().cpu(), *(value.grad.cpu() for value in given)])
    assert torch.equal(results[0][0], results[1][0])
    for mine, theirs in zip(results[1][1:], results[0][1:], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-6 * max(1.0, float(theirs.abs().max())))
