"""Steps that fit poses: a capsule of two bones is bent, and found again from points on its surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_training import avatar_config, new_avatar, toy_store

from snarfcli.fitting import CanonicalPoints, Corrections, PoseFit, Surfaces
from snarfcli.meshing.surfaces import canonical_surface

BENT = torch.tensor([[[0.05, 0.1, -0.1], [0.0, 0.15, 0.2]]])  # a turn about the long axis changes nothing at the second bone
SHIFT = torch.tensor([[0.02, -0.01, 0.015]])


@pytest.fixture(scope="module")
def avatar(tmp_path_factory):
    """An untrained avatar: capsules around the bones."""
    config = avatar_config(capsules=True)
    config = replace(config, condition=replace(config.condition, name="none"))
    torch.manual_seed(0)
    return new_avatar(toy_store(tmp_path_factory.mktemp("samples")), config).to("cpu")


@pytest.fixture(scope="module")
def points(avatar):
    mesh = canonical_surface(avatar, torch.zeros(2, 3), 48)
    values = (mesh.vertices, mesh.unit_normals, mesh.skinning_weights)
    return CanonicalPoints(*(torch.as_tensor(np.array(value), dtype=torch.float32) for value in values))


def seen(avatar, points) -> Surfaces:
    """Return the avatar's surface in the pose to be found."""
    transforms = avatar.bone_transforms(BENT, SHIFT)
    blended = torch.einsum("sj,bjrc->bsrc", points.weights, transforms[:, :, :3])
    posed = (blended[..., :3] @ points.points[:, :, None])[..., 0] + blended[..., 3]
    # of a bent surface the inverse transpose moves the normals
    normals = torch.linalg.inv(jacobians(avatar, points, transforms)).transpose(-1, -2) @ points.normals[:, :, None]
    return Surfaces(posed, torch.nn.functional.normalize(normals[..., 0], dim=-1))


def jacobians(avatar, points, transforms):
    """Return the derivatives [1, S, 3, 3] of skinning at the points."""

    def skinned(x):
        return avatar.model.skin(x, transforms[0]).sum(0)

    return torch.autograd.functional.jacobian(skinned, points.points).permute(1, 0, 2)[None]


def error(avatar, points, corrections: Corrections) -> float:
    """Return the largest distance between the avatar's surface in the pose found and in the true one, metres."""
    fit = PoseFit(avatar.model, avatar.skeleton)
    given = avatar.bone_transforms(torch.zeros(1, 2, 3))
    found, _ = fit.corrector.correct(given, torch.zeros(1, 2, 3), corrections)
    true = avatar.bone_transforms(BENT, SHIFT)
    return float((avatar.skin(points.points, found[0]) - avatar.skin(points.points, true[0])).norm(dim=-1).max())


def test_closest_points_lead_near_the_pose(avatar, points):
    fit, surfaces = PoseFit(avatar.model, avatar.skeleton), seen(avatar, points)
    pose = torch.zeros(1, 2, 3)
    corrections = Corrections.none(1, 2, pose)
    start = error(avatar, points, corrections)
    for _ in range(8):
        fitted = fit.approach(points, surfaces, avatar.bone_transforms(pose), pose, corrections)
        corrections = fitted.corrections
    assert start > 0.07
    assert error(avatar, points, corrections) < 0.25 * start
    assert float(fitted.matched) > 0.9


def test_distances_in_the_field_find_the_pose(avatar, points):
    fit, surfaces = PoseFit(avatar.model, avatar.skeleton), seen(avatar, points)
    pose = torch.zeros(1, 2, 3)
    corrections = Corrections.none(1, 2, pose)
    for _ in range(4):
        corrections = fit.approach(points, surfaces, avatar.bone_transforms(pose), pose, corrections).corrections
    approached = error(avatar, points, corrections)
    for _ in range(8):
        fitted = fit.settle(points, surfaces, avatar.bone_transforms(pose), pose, corrections)
        corrections = fitted.corrections
    assert float(fitted.distance) < 5e-4
    assert error(avatar, points, corrections) < 0.6 * approached


def test_a_place_far_from_the_origin_makes_no_difference(avatar, points):
    fit, surfaces = PoseFit(avatar.model, avatar.skeleton), seen(avatar, points)
    pose, away = torch.zeros(1, 2, 3), torch.tensor([[80.0, 0.0, -60.0]])
    moved = Surfaces(surfaces.points + away, surfaces.normals)
    here = fit.approach(points, surfaces, avatar.bone_transforms(pose), pose, Corrections.none(1, 2, pose)).corrections
    there = fit.approach(points, moved, avatar.bone_transforms(pose, away), pose, Corrections.none(1, 2, pose)).corrections
    torch.testing.assert_close(there.turn, here.turn, atol=2e-3, rtol=0)
    torch.testing.assert_close(there.shift, here.shift, atol=2e-3, rtol=0)


def test_a_surface_far_away_has_no_match_and_changes_little(avatar, points):
    fit = PoseFit(avatar.model, avatar.skeleton)
    surfaces = Surfaces(seen(avatar, points).points + 10, seen(avatar, points).normals)
    pose = torch.zeros(1, 2, 3)
    fitted = fit.settle(points, surfaces, avatar.bone_transforms(pose), pose, Corrections.none(1, 2, pose))
    assert float(fitted.distance) == torch.inf
    assert float(fitted.matched) == 0
    assert float(fitted.corrections.turn.abs().max()) < 1e-6
    assert float(fitted.corrections.shift.abs().max()) < 1e-6


def test_poses_of_a_batch_do_not_influence_each_other(avatar, points):
    fit, surfaces = PoseFit(avatar.model, avatar.skeleton), seen(avatar, points)
    pose = torch.zeros(2, 2, 3)
    both = Surfaces(torch.cat([surfaces.points, surfaces.points + 0.03]), surfaces.normals.repeat(2, 1, 1))
    for step in (fit.approach, fit.settle):
        alone = step(points, surfaces, avatar.bone_transforms(pose[:1]), pose[:1], Corrections.none(1, 2, pose))
        together = step(points, both, avatar.bone_transforms(pose), pose, Corrections.none(2, 2, pose))
        torch.testing.assert_close(together.corrections.turn[:1], alone.corrections.turn, atol=1e-5, rtol=0)
        torch.testing.assert_close(together.corrections.shift[:1], alone.corrections.shift, atol=1e-5, rtol=0)
