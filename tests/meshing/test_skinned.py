"""The skinned surface: made once, on the level set in every pose, moved by its weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from analytic_avatar import capsule
from torch import Tensor
from toy_avatar import LENGTH, RADIUS, ToyAvatar

from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import SkinnedSurface


class Breathing(ToyAvatar):
    """Its radius grows by 1 cm for each radian of the second joint about x, and its logits bend away from the surface."""

    def radius_in(self, pose: Tensor) -> Tensor:
        return self.radius + 0.01 * pose[1, 0]

    def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
        into = capsule(points_c, (0.0, 0, 0), (2 * LENGTH, 0, 0), 0.0) + self.radius_in(pose)
        return 20 * torch.tanh(60 * into)


def twisted(angle: float, bend: float = 0.0) -> torch.Tensor:
    return torch.tensor([[0.0, 0.0, 0.0], [angle, 0.0, bend]])


def radii(vertices: np.ndarray) -> np.ndarray:
    """Distance of points from the axis of the canonical capsules."""
    return -capsule(torch.from_numpy(vertices), (0.0, 0, 0), (2 * LENGTH, 0, 0), 0.0).numpy()


@pytest.mark.parametrize("resolution", [48, 128])  # followed at every vertex, and at those of a coarser mesh
def test_vertices_follow_the_level_set(resolution):
    surface = SkinnedSurface(Breathing(), resolution)
    np.testing.assert_allclose(radii(surface.mesh.vertices), RADIUS, atol=1e-4)
    for angle in (-1.0, 0.3, 1.5):
        vertices = surface.canonical_vertices(twisted(angle))
        # interpolated between control points 1 cm apart, on a curvature of 10 cm
        np.testing.assert_allclose(radii(vertices), RADIUS + 0.01 * angle, atol=1.5e-4)
        assert vertices.dtype == np.float32


def test_posed_vertices_move_by_the_weights_of_the_mesh():
    avatar = Breathing()
    surface = avatar.skinned_surface(40)
    pose, shift = twisted(0.5, 0.8), torch.tensor([0.1, -2.0, 0.3])
    mesh = surface.posed(pose, shift)
    transforms = avatar.bone_transforms(pose[None], shift[None])[0].double()
    weights = torch.from_numpy(surface.mesh.weights).double()
    homogeneous = torch.nn.functional.pad(torch.from_numpy(surface.canonical_vertices(pose)).double(), (0, 1), value=1.0)
    wanted = torch.einsum("vj,jrc,vc->vr", weights, transforms, homogeneous)[:, :3]
    np.testing.assert_allclose(mesh.vertices, wanted, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, surface.mesh.faces)
    np.testing.assert_array_equal(mesh.weights, surface.mesh.weights)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    given = surface.posed(pose, transforms=transforms.float())
    np.testing.assert_allclose(given.vertices, mesh.vertices, atol=1e-5)


def test_the_order_of_poses_does_not_matter():
    surface = SkinnedSurface(Breathing(), 40)
    first = surface.canonical_vertices(twisted(1.0))
    surface.canonical_vertices(twisted(-1.0))
    np.testing.assert_array_equal(surface.canonical_vertices(twisted(1.0)), first)


def test_another_mesh_is_moved_onto_the_level_set_first():
    avatar = Breathing()
    made = SkinnedSurface(avatar, 48).mesh
    moved = made.vertices + 0.004 * np.sin(40 * made.vertices[:, [0]]) * made.normals
    surface = SkinnedSurface(avatar, 48, mesh=Mesh(moved, made.faces))
    np.testing.assert_allclose(radii(surface.mesh.vertices), RADIUS, atol=1e-4)
    np.testing.assert_array_equal(surface.mesh.faces, made.faces)
    weights = avatar.skinning_weights(torch.from_numpy(surface.mesh.vertices))
    np.testing.assert_allclose(surface.mesh.weights, weights, atol=1e-6)
    np.testing.assert_allclose(radii(surface.canonical_vertices(twisted(1.0))), RADIUS + 0.01, atol=3e-4)


def test_where_the_shape_ends_vertices_follow_their_neighbours():
    """In one pose half of a band around the body has no surface near it; its vertices must not jump out."""

    class Torn(Breathing):
        def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
            logits = super().canonical_logits(points_c, pose)
            torn = (pose[1, 0] > 0.5) & ((points_c[:, 0] - LENGTH).abs() < 0.04) & (points_c[:, 1] > 0)
            return torch.where(torn, 20.0, logits)

    surface = SkinnedSurface(Torn(), 48)
    ways = radii(surface.canonical_vertices(twisted(1.0))) - RADIUS
    band = (np.abs(surface.mesh.vertices[:, 0] - LENGTH) < 0.04) & (surface.mesh.vertices[:, 1] > 0)
    assert band.sum() > 20
    np.testing.assert_allclose(ways[~band], 0.01, atol=3e-4)  # those next to the band lean towards it a little
    np.testing.assert_allclose(ways[band], 0.01, atol=2e-3)


def test_a_point_that_finds_another_surface_than_its_neighbours_does_not_jump():
    """In one pose a hair-thin spike stands on the body, like the surface that a normal meets across a crease."""

    class Spiked(Breathing):
        def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
            logits = super().canonical_logits(points_c, pose)
            spike = (pose[1, 0] > 0.5) & ((points_c[:, 0] - 0.3).abs() < 0.012) & (points_c[:, 2].abs() < 0.012)
            height = self.radius_in(pose) + 0.02 - points_c[:, 1]
            return torch.where(spike & (points_c[:, 1] > 0), 20 * torch.tanh(60 * height), logits)

    surface = SkinnedSurface(Spiked(), 48)
    pose = twisted(1.0)
    way, _ = surface.control.nearest_ways(pose)
    assert way.max() > 0.025  # found, and not believed
    ways = radii(surface.canonical_vertices(pose)) - RADIUS
    np.testing.assert_allclose(ways, 0.01, atol=1.5e-3)


def test_a_shape_that_vanishes_is_reported():
    class Mortal(Breathing):
        def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
            return super().canonical_logits(points_c, pose) if pose[1, 0] < 0.5 else torch.full((len(points_c),), -30.0)

    surface = SkinnedSurface(Mortal(), 40)
    surface.posed(twisted(0.4))
    with pytest.raises(EmptySurface, match="the shape of this pose has no surface within 3 cm of 100 % of the mesh"):
        surface.posed(twisted(0.6))


def test_bad_poses_are_rejected():
    surface = SkinnedSurface(ToyAvatar(), 32)
    with pytest.raises(ValueError, match=r"pose: wanted shape \[J, 3\], got \[1, 2, 3\]"):
        surface.posed(twisted(0.0)[None])
