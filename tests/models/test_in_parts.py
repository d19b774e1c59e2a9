"""Any number of points is evaluated in parts of bounded size, with the result of one evaluation."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from snarfcli import Avatar
from snarfcli.models import in_parts
from snarfcli.models.in_parts import queries_in_parts

POINTS, POSES = 50, 3  # the bounds in these tests


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return Avatar.load(Path(__file__).parents[1] / "golden" / "avatar.pt")


@pytest.fixture
def small_parts(monkeypatch):
    monkeypatch.setattr(in_parts, "_POINTS_AT_ONCE", POINTS)
    monkeypatch.setattr(in_parts, "_POSES_AT_ONCE", POSES)


def question(avatar: Avatar, batch: int, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return points near the body [B, N, 3], and the transforms and poses of `batch` poses."""
    generator = torch.Generator().manual_seed(0)
    pose = 0.3 * torch.randn(batch, avatar.skeleton.num_joints, 3, generator=generator)
    transforms = avatar.bone_transforms(pose)
    chosen = torch.randint(avatar.skeleton.num_joints, (count,), generator=generator)
    points = 0.15 * torch.randn(batch, count, 3, generator=generator)
    for one, moved in zip(points, transforms, strict=True):
        one += avatar.skin(avatar.skeleton.canonical_joints, moved)[chosen]
    return points, transforms, pose


SIZES = [(0, 5), (2, 0), (1, 1), (1, POINTS - 1), (1, POINTS), (1, POINTS + 1), (1, 3 * POINTS + 7), (4, 120)]
SIZES += [(POSES, 4), (POSES + 1, 4), (8, POINTS // 2 + 1)]


@pytest.mark.parametrize(("batch", "count"), SIZES)
def test_parts_give_the_same_bits(avatar, batch, count, monkeypatch):
    asked = question(avatar, batch, count)
    points, _, pose = asked
    at_once, occupancy = avatar.query(*asked), avatar.occupancy(points, pose)
    monkeypatch.setattr(in_parts, "_POINTS_AT_ONCE", POINTS)
    monkeypatch.setattr(in_parts, "_POSES_AT_ONCE", POSES)
    sizes = []
    find = avatar.find
    monkeypatch.setattr(avatar, "find", lambda *part: sizes.append(part[0].shape[:2]) or find(*part))
    in_small_parts = avatar.query(*asked)
    for name in ("logits", "found", "counts"):
        whole, parts = getattr(at_once, name), getattr(in_small_parts, name)
        assert parts.dtype == whole.dtype
        assert torch.equal(parts, whole)
    assert all(poses <= POSES and poses * points <= POINTS for poses, points in sizes)
    sizes.clear()
    assert torch.equal(avatar.occupancy(points, pose), occupancy)
    assert all(poses <= POSES and poses * points <= POINTS for poses, points in sizes)


def test_the_points_are_a_test(avatar):
    found = avatar.query(*question(avatar, 1, 400))
    assert (found.logits > 0).any()
    assert set(found.counts.unique().tolist()) >= {0, 1, 2}


def test_canonical_points_are_evaluated_in_parts_too(avatar, monkeypatch):
    points = avatar.skeleton.canonical_joints.repeat(10, 1)
    points = points + 0.1 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    _, transforms, pose = question(avatar, 1, 1)
    calls = (
        lambda: avatar.canonical_logits(points, pose[0]),
        lambda: avatar.skinning_weights(points),
        lambda: avatar.skin(points, transforms[0]),
    )
    at_once = [call() for call in calls]
    monkeypatch.setattr(in_parts, "_POINTS_AT_ONCE", POINTS)
    sizes = []
    weights = avatar.model.skinning_weights
    monkeypatch.setattr(avatar.model, "skinning_weights", lambda part: sizes.append(len(part)) or weights(part))
    for call, wanted in zip(calls, at_once, strict=True):
        assert torch.equal(call(), wanted)
    assert len(points) > 2 * POINTS
    assert max(sizes) == POINTS


@pytest.mark.usefixtures("small_parts")
@pytest.mark.parametrize(("transforms", "pose"), [(1, 9), (9, 1), (12, 9), (9, 12)])
def test_different_numbers_of_poses_are_rejected(transforms, pose):
    with pytest.raises(
        ValueError, match=r"wanted points \[B, N, 3\], bone_transforms \[B, J, 4, 4\] and pose \[B, J, 3\], got"
    ):
        queries_in_parts(lambda *part: part, torch.zeros(9, 4, 3), torch.zeros(transforms, 2, 4, 4), torch.zeros(pose, 2, 3))
