from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from toy_avatar import LENGTH, RADIUS, ToyAvatar

from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.posed import posed_mesh
from snarfcli.meshing.surfaces import canonical_surface, field_surface

VOLUME = np.pi * RADIUS**2 * 2 * LENGTH + 4 / 3 * np.pi * RADIUS**3


def bent(angle: float) -> torch.Tensor:
    return torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, angle]])


def solid_of(mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_straight_surfaces_agree_with_the_capsule():
    for surface in ("field", "skinned"):
        solid = solid_of(posed_mesh(ToyAvatar(), bent(0.0), resolution=96, surface=surface))
        assert solid.is_watertight
        assert solid.volume == pytest.approx(VOLUME, rel=0.01)


def test_given_transforms_take_the_place_of_the_poses():
    avatar = ToyAvatar()
    transforms = avatar.bone_transforms(bent(0.9)[None], torch.tensor([[0.3, 0.0, 0.0]]))[0]
    for surface in ("field", "skinned"):
        given = posed_mesh(avatar, bent(0.0), resolution=32, surface=surface, transforms=transforms)
        wanted = posed_mesh(avatar, bent(0.9), torch.tensor([0.3, 0.0, 0.0]), 32, surface=surface)
        np.testing.assert_allclose(given.vertices, wanted.vertices, atol=1e-5)
    with pytest.raises(ValueError, match=r"transforms: wanted shape \[2, 4, 4\], got \[3, 4, 4\]"):
        posed_mesh(avatar, bent(0.0), transforms=torch.eye(4).expand(3, 4, 4))


def test_field_and_skinned_surface_coincide_when_bent():
    avatar, shift = ToyAvatar(), torch.tensor([0.3, -2.0, 5.0])
    field = field_surface(avatar, bent(0.9), shift, 96)
    skinned = posed_mesh(avatar, bent(0.9), shift, 96, surface="skinned")
    assert solid_of(field).is_watertight
    assert solid_of(skinned).is_watertight
    # distance along the normal to the other surface's nearest vertex, at most a quarter of a voxel
    nearest = cKDTree(skinned.vertices).query(field.vertices)[1]
    offset = np.einsum("vk,vk->v", field.vertices - skinned.vertices[nearest], skinned.normals[nearest])
    assert np.abs(offset).max() < 0.25 * field.stats.voxel
    assert field.vertices[:, 2].mean() == pytest.approx(5.0, abs=0.01)


def test_skinned_surface_carries_exact_weights():
    avatar = ToyAvatar()
    mesh_c = canonical_surface(avatar, bent(0.0), 64)
    np.testing.assert_array_equal(mesh_c.weights, avatar.skinning_weights(torch.from_numpy(mesh_c.vertices)))
    skinned = posed_mesh(avatar, bent(1.0), None, 64, surface="skinned")
    np.testing.assert_allclose(skinned.weights.sum(1), 1, atol=1e-6)
    np.testing.assert_array_equal(skinned.faces, mesh_c.faces)
    np.testing.assert_allclose(skinned.weights, mesh_c.weights, atol=1e-4)  # its vertices were moved onto the level set


def test_field_surface_borrows_weights_of_the_right_bone():
    avatar = ToyAvatar()
    mesh_c = canonical_surface(avatar, bent(0.0), 96)
    mesh = field_surface(avatar, bent(1.2), None, 96, weights_from=mesh_c)
    assert mesh.weights.shape == (len(mesh.vertices), 2)
    # well along each bone one weight is nearly 1
    tip = torch.tensor([[2 * LENGTH, 0.0, 0.0], [0.0, 0.0, 0.0]])
    posed_tip = avatar.skin(tip, avatar.bone_transforms(bent(1.2)[None])[0]).numpy()
    for bone, end in ((1, posed_tip[0]), (0, posed_tip[1])):
        near = np.linalg.norm(mesh.vertices - end, axis=1) < 1.5 * RADIUS
        assert near.any()
        assert mesh.weights[near, bone].min() > 0.9


def test_a_point_without_correspondence_does_not_step_the_surface():
    avatar = ToyAvatar()
    mesh = field_surface(avatar, bent(0.4), None, 64)
    assert mesh.normals is not None
    assert np.isfinite(mesh.vertices).all()
    assert solid_of(mesh).body_count == 1


def test_a_box_that_is_too_small_grows(monkeypatch):
    avatar = ToyAvatar()
    tight = (torch.tensor([0.0, -0.2, -0.2]), torch.tensor([2 * LENGTH - 0.1, 0.2, 0.2]))
    monkeypatch.setattr(avatar, "posed_box", lambda transforms: tight)
    mesh = field_surface(avatar, bent(0.0), None, 64)
    assert not mesh.stats.capped
    assert solid_of(mesh).volume == pytest.approx(VOLUME, rel=0.02)


def test_an_empty_avatar_says_so():
    with pytest.raises(EmptySurface):
        field_surface(ToyAvatar(radius=-1.0), bent(0.0), None, 32)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"pose: wanted shape \[J, 3\], got \[1, 2, 3\]"):
        field_surface(ToyAvatar(), bent(0.0)[None], None, 32)
    with pytest.raises(ValueError, match=r"translation: wanted shape \[3\], got \[1, 3\]"):
        posed_mesh(ToyAvatar(), bent(0.0), torch.zeros(1, 3), 32, surface="skinned")
    with pytest.raises(ValueError, match="surface: wanted one of field, skinned, got 'hull'"):
        posed_mesh(ToyAvatar(), bent(0.0), surface="hull")
    with pytest.raises(ValueError, match="weights_from: wanted a mesh with weights"):
        field_surface(ToyAvatar(), bent(0.0), None, 32, weights_from=field_surface(ToyAvatar(), bent(0.0), None, 32))
