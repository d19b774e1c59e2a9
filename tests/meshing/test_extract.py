from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from analytic_avatar import capsule
from scipy.ndimage import gaussian_filter, map_coordinates

from snarfcli.meshing.extract import EmptySurface, FullSurface, extract_surface
from snarfcli.meshing.mesh import Mesh

BOX = ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])


def sphere(points: torch.Tensor) -> torch.Tensor:
    return 0.8 - points.norm(dim=1)


def torus(points: torch.Tensor) -> torch.Tensor:
    ring = points[:, :2].norm(dim=1) - 0.6
    return 0.2 - torch.stack([ring, points[:, 2]]).norm(dim=0)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def assert_closed(mesh: Mesh) -> trimesh.Trimesh:
    solid = as_trimesh(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.area_faces.min() > 0
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert set(np.unique(mesh.faces)) == set(range(len(mesh.vertices)))
    return solid


@pytest.mark.parametrize(
    ("field", "volume", "area", "euler"),
    [
        (sphere, 4 / 3 * np.pi * 0.8**3, 4 * np.pi * 0.8**2, 2),
        (torus, 2 * np.pi**2 * 0.6 * 0.2**2, 4 * np.pi**2 * 0.6 * 0.2, 0),
    ],
    ids=["sphere", "torus"],
)
def test_volume_and_area_converge(field, volume, area, euler):
    errors = []
    for resolution in (32, 64, 128):
        solid = assert_closed(extract_surface(field, *BOX, resolution))
        assert solid.euler_number == euler
        errors.append((abs(solid.volume / volume - 1), abs(solid.area / area - 1)))
    errors = np.array(errors)
    # second order: a quarter of the error at half the voxel, 0.35 leaves room for where the lattice falls
    assert (errors[1:] < 0.35 * errors[:-1]).all()
    assert solid.volume > 0
    assert errors[-1].max() < 2e-3


def test_coarse_to_fine_equals_the_full_lattice():
    coarse = extract_surface(torus, *BOX, 96, coarse=12)
    full = extract_surface(torus, *BOX, 96, coarse=96)
    assert coarse.stats.points < full.stats.points / 5

    # the coarser lattice is padded by more, and so numbered differently: compare the sets of vertices, 1e-6 m for float32
    def ordered(mesh):
        return np.unique(np.round(mesh.vertices.astype(np.float64), 5), axis=0)

    assert len(coarse.faces) == len(full.faces)
    np.testing.assert_allclose(ordered(coarse).mean(0), ordered(full).mean(0), atol=1e-6)
    assert as_trimesh(coarse).volume == pytest.approx(as_trimesh(full).volume, rel=1e-5)


def test_few_points_are_evaluated_and_counted():
    asked = []

    def counted(points):
        asked.append(len(points))
        return sphere(points)

    mesh = extract_surface(counted, *BOX, 256, chunk=100_000)
    assert mesh.stats.points == sum(asked) < 257**3 / 12
    assert mesh.stats.calls == len(asked)
    assert max(asked) <= 100_000
    assert mesh.stats.voxel == pytest.approx(2 / 256)


def test_the_chunk_size_changes_nothing():
    one = extract_surface(torus, *BOX, 64, coarse=16, chunk=10**9)
    other = extract_surface(torus, *BOX, 64, coarse=16, chunk=777)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def test_smooth_noise_is_closed_at_every_level():
    rng = np.random.default_rng(1)
    noise = gaussian_filter(rng.standard_normal((40, 40, 40)), 2.0).astype(np.float32)

    def field(points):
        index = (points.numpy().T + 1) * 19.5
        return torch.from_numpy(map_coordinates(noise, index, order=1, mode="constant", cval=-1.0))

    mesh = extract_surface(field, *BOX, 80, coarse=10, keep_share=0)
    assert_closed(mesh)
    assert mesh.stats.components == mesh.stats.kept > 3


def test_two_touching_capsules_are_one_body():
    def field(points):
        left = capsule(points, (-0.2, -0.5, 0), (-0.2, 0.5, 0), 0.2)
        right = capsule(points, (0.2, -0.5, 0), (0.2, 0.5, 0), 0.2)
        return torch.maximum(left, right)

    mesh = extract_surface(field, [-0.5, -0.8, -0.3], [0.5, 0.8, 0.3], 128)
    solid = assert_closed(mesh)
    each = np.pi * 0.2**2 * 1.0 + 4 / 3 * np.pi * 0.2**3
    assert solid.volume == pytest.approx(2 * each, rel=2e-3)


@pytest.mark.parametrize("end", [(0.9, 0.0, 0.0), (0.5, 0.4, 0.3)], ids=["along an axis", "askew"])
def test_a_thin_cylinder_is_not_lost(end):
    radius = 3 * 2 / 256  # three final cells

    def field(points):
        return capsule(points, tuple(-x for x in end), end, radius)

    mesh = extract_surface(field, *BOX, 256)
    solid = assert_closed(mesh)
    length = 2 * np.linalg.norm(end)
    assert mesh.stats.components == 1
    assert solid.volume == pytest.approx(
        np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3, rel=0.03
    )  # chords of a circle of 6 voxels


def test_a_finger_thinner_than_a_coarse_cell_is_followed_from_the_hand():
    radius = 1.5 * 2 / 256  # diameter 3 final cells, three quarters of a coarse one

    def field(points):
        hand = 0.3 - points.norm(dim=1)
        return torch.maximum(hand, capsule(points, (0.011, 0.007, 0.0), (0.9, 0.007, 0.0), radius))

    solid = assert_closed(extract_surface(field, *BOX, 256))
    assert solid.bounds[1, 0] == pytest.approx(0.9 + radius, abs=2e-3)


def test_small_pieces_go_and_are_counted():
    def field(points):
        large = 0.5 - (points + 0.3).norm(dim=1)
        small = 0.06 - (points - 0.7).norm(dim=1)
        return torch.maximum(large, small)

    everything = extract_surface(field, *BOX, 96, keep_share=0)
    largest = extract_surface(field, *BOX, 96, keep_share=0.05)
    assert (everything.stats.components, everything.stats.kept) == (2, 2)
    assert (largest.stats.components, largest.stats.kept) == (2, 1)
    assert assert_closed(largest).body_count == 1
    assert len(largest.faces) < len(everything.faces)


def test_infinite_values_and_a_level():
    def field(points):
        inside = points.norm(dim=1) < 0.5
        return torch.where(inside, torch.inf, -torch.inf)

    solid = assert_closed(extract_surface(field, *BOX, 64, level=3.0))
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.02)
    shifted = extract_surface(lambda p: sphere(p) + 3.0, *BOX, 64, level=3.0)
    assert as_trimesh(shifted).volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=2e-3)


def test_a_surface_that_leaves_the_box_is_closed():
    mesh = extract_surface(sphere, [-1, -1, -1], [0.3, 1, 1], 48)
    assert mesh.stats.capped
    assert_closed(mesh)
    assert not extract_surface(sphere, *BOX, 48).stats.capped


def test_a_box_that_is_too_small_widens_where_it_must():
    mesh = extract_surface(sphere, [-1, -1, -1], [0.3, 1, 1], 64, coarse=16, widen=True)
    assert not mesh.stats.capped
    assert assert_closed(mesh).volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=2e-3)
    exact = extract_surface(sphere, *BOX, 64, coarse=16, widen=True)
    np.testing.assert_array_equal(exact.vertices, extract_surface(sphere, *BOX, 64, coarse=16).vertices)
    endless = extract_surface(lambda p: 0.5 - p[:, 1:].norm(dim=1), *BOX, 32, widen=True)
    assert endless.stats.capped
    assert np.ptp(endless.vertices[:, 0]) < 5.2


def test_a_thin_part_that_leaves_the_box_between_coarse_nodes_is_followed():
    radius = 1.5 * 2 / 256

    def field(points):
        return torch.maximum(0.3 - points.norm(dim=1), capsule(points, (0.011, 0.007, 0.0), (0.9, 0.007, 0.0), radius))

    mesh = extract_surface(field, [-0.4, -1, -1], [0.6, 1, 1], 256, widen=True)
    assert not mesh.stats.capped
    assert assert_closed(mesh).bounds[1, 0] == pytest.approx(0.9 + radius, abs=2e-3)


def test_refinement_removes_terraces():
    def steep(points):  # far from linear within a cell
        return torch.expm1(12 * sphere(points))

    distance = [
        np.abs(np.linalg.norm(extract_surface(steep, *BOX, 32, refine=refine).vertices, axis=1) - 0.8).max()
        for refine in (0, 1, 3)
    ]
    assert distance[1] < 0.5 * distance[0]
    assert distance[2] < 0.1 * distance[0]


def test_no_surface_is_a_clear_error():
    with pytest.raises(EmptySurface, match="unoccupied at all"):
        extract_surface(lambda p: -torch.ones(len(p)), *BOX, 32)
    with pytest.raises(FullSurface, match="occupied at all"):
        extract_surface(lambda p: torch.ones(len(p)), *BOX, 32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"upper": [1, 1, -1]}, "upper: wanted more than lower"),
        ({"lower": [np.nan, 0, 0]}, "lower: wanted three finite numbers"),
        ({"resolution": 2}, "resolution: wanted at least 4"),
        ({"chunk": 0}, "chunk: wanted at least 1"),
        ({"coarse": 0}, "coarse: wanted at least 1"),
        ({"refine": -1}, "refine: wanted at least 0"),
        ({"dilate": -1}, "dilate: wanted at least 0"),
        ({"keep_share": 2.0}, "keep_share: wanted a share"),
        ({"field": lambda p: p}, "field: wanted shape .*one value per point"),
        ({"field": lambda p: p[:, 0] * torch.nan}, "got NaN at"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_arguments_are_named(change, message):
    arguments = {"field": sphere, "lower": BOX[0], "upper": BOX[1], "resolution": 16} | change
    with pytest.raises(ValueError, match=message):
        extract_surface(**arguments)
