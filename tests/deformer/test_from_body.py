"""A deformer for a body: box, cells and weights fit it, and its posed vertices are found back."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from smpl_files import smpl, write_npz

from snarfcli.bodies import Body, Skeleton, builtin_body
from snarfcli.deformer import ForwardDeformer, SearchConfig, skin
from snarfcli.deformer.canonical_body import canonical_body
from snarfcli.deformer.cells import cells_near
from snarfcli.deformer.weights import VoxelWeights

COARSE = (33, 33, 9)


@pytest.fixture(scope="module")
def deformer() -> ForwardDeformer:
    return ForwardDeformer.from_body(builtin_body(), resolution=COARSE)


def bent(joints: int, seed: int = 0) -> torch.Tensor:
    """Two poses, [2, J, 3]."""
    return 0.2 * torch.randn(2, joints, 3, generator=torch.Generator().manual_seed(seed))


def distances(deformer: ForwardDeformer, posed: torch.Tensor, transforms: torch.Tensor) -> torch.Tensor:
    """Return the distance of each posed vertex's nearest root to its canonical vertex, [B * V], metres; 9 without a root."""
    assert deformer.body is not None
    vertices = deformer.body.vertices
    with torch.no_grad():
        found = deformer(posed, transforms)
    apart = (found.canonical - vertices[found.query % len(vertices)]).norm(dim=1)
    return torch.full((len(transforms) * len(vertices),), 9.0).scatter_reduce(0, found.query, apart, "amin")


def test_posed_vertices_are_found_back(deformer):
    body, transforms = deformer.body, deformer.body.posed_from_canonical(bent(24))
    with torch.no_grad():
        own = torch.stack([skin(body.vertices, deformer.skinning_weights(body.vertices), one) for one in transforms])
    assert distances(deformer, own, transforms).max() < 1e-4
    given = torch.stack([skin(body.vertices, body.weights, one) for one in transforms])
    apart = distances(deformer, given, transforms)
    # cells of 6 cm: measured median 0.5 mm, 99 % within 7 mm. With as many nodes as usual 0.1 and 3 mm.
    assert apart.median() < 1e-3
    assert apart.quantile(0.99) < 1e-2
    assert (apart < 9).all()


def test_vertices_are_in_the_canonical_pose(deformer):
    source, body = builtin_body(), deformer.body
    flat = Body(**{**source.__dict__, "posedirs": torch.zeros(6890, 3, 0)})
    torch.testing.assert_close(body.vertices, flat.pose(source.skeleton().canonical_pose[None]).vertices[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(body.posed_from_canonical(body.skeleton.canonical_pose[None])[0], torch.eye(4).expand(24, 4, 4))
    posed = body.posed_from_canonical(torch.zeros(1, 24, 3), torch.tensor([[0.0, 1.0, 0.0]]))
    moved = skin(body.vertices, body.weights, posed[0])
    assert (moved - source.v_template - torch.tensor([0.0, 1, 0])).norm(dim=1).median() < 1e-5


def test_the_grid_fits_the_body(deformer):
    body = deformer.body
    assert deformer.shape == body.shape == (9, 33, 33)
    margin = torch.tensor([0.12, 0.12, 0.20])
    torch.testing.assert_close(deformer.lower, body.vertices.amin(0) - margin, atol=1e-2, rtol=0)
    torch.testing.assert_close(deformer.upper, body.vertices.amax(0) + margin, atol=1e-2, rtol=0)
    assert deformer.is_active(body.vertices).all()
    assert 0.1 < deformer.active_cells.float().mean() < 0.7
    error = (deformer.skinning_weights(body.vertices) - body.weights).abs().sum(1)
    assert error.median() < 0.08  # cells of 6 cm; measured 0.052


def test_the_usual_grid_is_that_of_the_settings():
    assert canonical_body(builtin_body()).shape == (16, 64, 64)
    animal = arrays(scale=torch.tensor([0.3, 0.8, 1.6]))
    long = canonical_body(animal)
    assert long.shape[0] > long.shape[1] > long.shape[2]
    assert 0.9 < np.prod(long.shape) / (64 * 64 * 16) < 1.1


def arrays(scale: torch.Tensor | float = 1.0) -> dict:
    """A bar of two bones along z, as a plain dictionary."""
    axis = torch.linspace(0, 1, 5)
    vertices = torch.cartesian_prod(axis, axis, torch.linspace(0, 1, 17)) * scale
    upper = (vertices[:, 2] > 0.5 * vertices[:, 2].max()).float()
    middle = vertices.mean(0)
    joints = torch.stack([middle * torch.tensor([1, 1, 0.0]), middle])
    return {"vertices": vertices.numpy(), "weights": torch.stack([1 - upper, upper], 1), "joints": joints, "parents": [-1, 0]}


def test_a_dictionary_and_other_units():
    """Margins and cells grow with the body: in millimetres the same roots are found."""
    pose = torch.tensor([[[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]])
    found = []
    for scale in (1.0, 1000.0):
        deformer = ForwardDeformer.from_body(arrays(scale), resolution=(9, 9, 17))
        transforms = deformer.body.posed_from_canonical(pose)
        posed = skin(deformer.body.vertices, deformer.body.weights, transforms[0])[None]
        with torch.no_grad():
            found.append(deformer(posed, transforms))
    assert torch.equal(found[0].query, found[1].query)
    assert set(found[0].query.tolist()) == set(range(425))
    torch.testing.assert_close(found[1].canonical / 1000, found[0].canonical, atol=2e-3, rtol=0)  # 5e-4 at the bend


def test_a_file_in_smpls_format(tmp_path):
    path = write_npz(tmp_path / "basicmodel_m_lbs_10_207_0_v1.1.0.npz", smpl())
    deformer = ForwardDeformer.from_body(path, betas=[1.0, 0.5], resolution=(17, 17, 5), search="broyden")
    assert deformer.search == SearchConfig("broyden")
    source = builtin_body()
    tall = source.skeleton(torch.tensor([1.0, 0.5]))
    torch.testing.assert_close(deformer.body.skeleton.joints_rest, tall.joints_rest)
    pose = bent(24)
    torch.testing.assert_close(deformer.body.posed_from_canonical(pose), tall.posed_from_canonical(pose))


def test_a_canonical_pose_of_ones_own():
    pose = torch.zeros(24, 3)
    body = canonical_body(builtin_body(), canonical_pose=pose, margin_m=(0.5, 0.4, 0.3))
    torch.testing.assert_close(body.vertices, builtin_body().v_template, atol=1e-6, rtol=0)
    torch.testing.assert_close(body.grid.lower, body.vertices.amin(0) - torch.tensor([0.5, 0.4, 0.3]))


def test_trainable_weights_start_at_those_of_the_body(deformer):
    trained = ForwardDeformer.from_body(builtin_body(), resolution=COARSE, trainable=True)
    assert isinstance(trained.field, VoxelWeights)
    torch.testing.assert_close(trained.weight_grid(), deformer.weight_grid(), atol=3e-4, rtol=0)
    assert [name for name, _ in trained.named_parameters()] == ["field.logits"]
    assert not list(deformer.parameters())
    transforms = trained.body.posed_from_canonical(bent(24))
    trained(trained.body.vertices[None, ::50].expand(2, -1, -1), transforms).canonical.sum().backward()
    assert (trained.field.logits.grad != 0).any()


def test_it_is_saved_like_any_module(deformer):
    other = ForwardDeformer.from_body(builtin_body(), resolution=COARSE, betas=[2.0])
    other.load_state_dict(deformer.state_dict())
    assert torch.equal(other.weight_grid(), deformer.weight_grid())
    assert torch.equal(other.lower, deformer.lower)
    again = pickle.loads(pickle.dumps(deformer))
    assert isinstance(again.body.skeleton, Skeleton)
    assert torch.equal(again.body.vertices, deformer.body.vertices)
    assert ForwardDeformer(deformer.grid, 24).body is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": (64, 64)}, r"resolution: wanted three numbers of at least 2, along x, y, z, got \[64, 64\]"),
        ({"resolution": (64, 64, 1)}, r"resolution: wanted three numbers of at least 2, along x, y, z, got \[64, 64, 1\]"),
        (
            {"margin_m": (0.1, -0.1, 0.1)},
            r"margin_m: wanted three numbers of at least 0, .* got \[0.1, -0.1, 0.1\]",
        ),
        ({"canonical_pose": torch.zeros(23, 3)}, r"canonical_pose: wanted shape \[24, 3\], got \[23, 3\]"),
    ],
)
def test_options_that_do_not_fit(options, message):
    with pytest.raises(ValueError, match=message):
        ForwardDeformer.from_body(builtin_body(), **options)


def test_a_body_without_size():
    with pytest.raises(ValueError, match="vertices: wanted a body, got vertices that are all in one place"):
        ForwardDeformer.from_body({**arrays(), "vertices": np.ones((425, 3))})


def test_points_and_segments_of_no_length_have_the_same_cells(deformer):
    points = deformer.body.vertices[::100]
    shape, grid = deformer.shape, deformer.grid
    as_segments = cells_near(grid, shape, [(points[:, None].expand(-1, 2, -1), 0.1)])
    assert torch.equal(cells_near(grid, shape, [(points, 0.1)]), as_segments)


def test_poses_and_bodies_are_exact_under_autocast():
    """Half precision would move a vertex by millimetres."""
    body, pose = builtin_body(), 0.3 * torch.randn(1, 24, 3, generator=torch.Generator().manual_seed(0))
    deformer = ForwardDeformer.from_body(body)
    assert deformer.body is not None
    transforms, posed = deformer.body.posed_from_canonical(pose), body.pose(pose)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(deformer.body.posed_from_canonical(pose), transforms)
        again = body.pose(pose)
        other = ForwardDeformer.from_body(body).body
    assert torch.equal(again.vertices, posed.vertices)
    assert torch.equal(again.posed_from_rest, posed.posed_from_rest)
    assert other is not None
    assert torch.equal(other.vertices, deformer.body.vertices)


def test_the_body_moves_with_the_deformer():
    deformer = ForwardDeformer.from_body(builtin_body()).double()
    body = deformer.body
    assert body is not None
    assert (
        body.vertices.dtype == body.weights.dtype == body.grid.lower.dtype == body.skeleton.joints_rest.dtype == torch.float64
    )
    assert body.active_cells.dtype == torch.bool
    transforms = body.posed_from_canonical(torch.zeros(1, 24, 3, dtype=torch.float64))
    assert bool(deformer(deformer.skin(body.vertices[None, ::100], transforms), transforms).found.all())
    assert "bones=24" in repr(deformer)
    assert deformer.to("meta").body.vertices.device.type == "meta"
