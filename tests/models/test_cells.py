"""Which cells are searched: those of the learned shape, with room to grow in training, and none that is not needed after it."""

from __future__ import annotations

import pytest
import torch
from toy_training import avatar_config

from snarfcli.avatar import Avatar
from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.grid import locate
from snarfcli.models.occupied import SAMPLES_M

RADIUS = 0.07


def capsule_avatar(**changes) -> Avatar:
    """Return an avatar whose shape is its prior: a capsule of 7 cm from (0, 0, 0) to (0.5, 0, 0)."""
    torch.manual_seed(0)
    config = avatar_config(capsules=True)
    config.skinning.resolution = [22, 16, 16]
    for name, value in changes.items():
        setattr(config.skinning, name, value)
    joints = torch.tensor([[0.0, 0, 0], [0.5, 0, 0]])
    skeleton = Skeleton(("root", "tip"), (-1, 0), joints, torch.zeros(2, 3))
    avatar = Avatar(config, skeleton, CanonicalGrid(torch.tensor([-0.4, -0.4, -0.4]), torch.tensor([1.0, 0.6, 0.6])))
    with torch.no_grad():
        avatar.model.shape.layers[-1].weight.zero_()
        avatar.model.shape.layers[-1].bias.zero_()
    return avatar.to("cpu")


def cells_of(avatar: Avatar, points: torch.Tensor) -> torch.Tensor:
    """Return which cells hold one of the points [N, 3]."""
    deformer = avatar.model.deformer
    mask = torch.zeros_like(deformer.active_cells)
    mask.view(-1)[locate(points, deformer.grid, deformer.shape)[0]] = True
    return mask


def capsule_points(radius: float, count: int = 20_000) -> torch.Tensor:
    """Return points within `radius` of the bone."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([1.0, 0.6, 0.6]) - torch.tensor([0.25, 0.3, 0.3])
    nearest = points.clone()
    nearest[:, 0] = points[:, 0].clamp(0, 0.5)
    nearest[:, 1:] = 0
    return points[(points - nearest).norm(dim=1) < radius]


POSES = torch.zeros(2, 2, 3)


def test_occupied_cells_are_those_of_the_shape():
    avatar = capsule_avatar()
    occupied = avatar.model.occupied_cells(POSES)
    inner, outer = cells_of(avatar, capsule_points(RADIUS - 0.04)), cells_of(avatar, capsule_points(RADIUS + 0.07))
    assert bool(occupied[inner].all())
    assert not bool(occupied[~outer].any())
    wider = avatar.model.occupied_cells(POSES, reach_m=0.1)
    assert bool(wider[cells_of(avatar, capsule_points(RADIUS + 0.05))].all())
    assert int(wider.sum()) < wider.numel()
    assert bool((avatar.model.occupied_cells(POSES, threshold=-3.0) >= occupied).all())


def test_any_pose_counts():
    """A pose in which the shape is larger adds its cells."""
    avatar = capsule_avatar()
    logits = avatar.model.canonical_logits

    def swollen(canonical, condition, pose, *rest):
        return logits(canonical, condition, pose, *rest) + 3.0 * condition[pose].abs().amax(1)

    avatar.model.canonical_logits = swollen
    poses = POSES.clone()
    poses[1, 1, 2] = torch.pi  # conditions are in half turns: 3.0 more, 10 cm at 30 logits a metre
    each = [int(avatar.model.occupied_cells(pose[None]).sum()) for pose in poses]
    assert each[0] < each[1] == int(avatar.model.occupied_cells(poses).sum())


def test_what_is_not_searched_counts_as_empty_but_is_reached_into():
    avatar = capsule_avatar()
    deformer = avatar.model.deformer
    left = deformer.active_cells.clone()
    left[:, :, 10:] = False
    deformer.set_active_cells(left)
    occupied = avatar.model.occupied_cells(POSES)
    assert not bool(occupied[:, :, 11:].any())
    assert bool(occupied[:, :, 5:10].any())
    assert bool(avatar.model.occupied_cells(POSES, reach_m=0.1)[:, :, 11].any())


def test_a_refresh_leaves_room_to_grow_beyond_the_first_region():
    avatar = capsule_avatar(bone_radius_m=0.09, surface_radius_m=0.05)
    before = avatar.model.deformer.active_cells.clone()
    avatar.model.refresh_cells(POSES)
    after = avatar.model.deformer.active_cells
    assert bool(after[cells_of(avatar, capsule_points(RADIUS + 0.06))].all())
    assert bool((after & ~before).any())
    for _ in range(3):
        avatar.model.refresh_cells(POSES)
    assert torch.equal(avatar.model.deformer.active_cells, after)  # a shape that does not grow needs no more


def test_cells_at_the_bones_always_stay():
    avatar = capsule_avatar()
    bones = avatar.model._kept_cells.clone()
    with torch.no_grad():
        avatar.model.shape.layers[-1].bias.fill_(-1.8)  # all that is left is a thread of 1 cm
    avatar.model.refresh_cells(POSES)
    cells = avatar.model.deformer.active_cells
    assert bool(cells[bones].all())
    assert int(cells.sum()) < cells.numel()
    assert bool(bones[cells_of(avatar, capsule_points(0.05))].all())


def test_final_cells_are_fewer_and_answer_alike():
    avatar = capsule_avatar(bone_radius_m=0.35)
    points = torch.rand(1, 20_000, 3, generator=torch.Generator().manual_seed(1)) * 1.2 - 0.4
    pose = torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.0, 0.8]]])
    transforms = avatar.bone_transforms(pose)
    before = avatar.query(points, transforms, pose)
    cells = int(avatar.model.deformer.active_cells.sum())
    avatar.model.tighten_cells(POSES)
    after = avatar.query(points, transforms, pose)
    assert int(avatar.model.deformer.active_cells.sum()) < 0.7 * cells
    assert torch.equal(before.logits > 0, after.logits > 0)
    assert int((after.logits > 0).sum()) > 50
    assert after.correspondences < before.correspondences


def test_tightening_adds_no_cells():
    avatar = capsule_avatar()
    some = avatar.model.deformer.active_cells.clone()
    some[:, :, 10:] = False
    avatar.model.deformer.set_active_cells(some)
    avatar.model.tighten_cells(POSES)
    assert not bool((avatar.model.deformer.active_cells & ~some).any())


@pytest.mark.parametrize("act", ["refresh_cells", "tighten_cells"])
def test_nothing_changes_where_all_is_to_be_searched_or_nothing_is_there(act):
    everything = capsule_avatar(bone_radius_m=None)
    getattr(everything.model, act)(POSES)
    assert bool(everything.model.deformer.active_cells.all())
    empty = capsule_avatar()
    before = empty.model.deformer.active_cells.clone()
    with torch.no_grad():
        empty.model.shape.layers[-1].bias.fill_(-100.0)
    getattr(empty.model, act)(POSES)
    assert torch.equal(empty.model.deformer.active_cells, before)


def test_samples_lie_close_enough():
    """At any resolution, samples of a cell are closer together than a thin part of a body."""
    assert SAMPLES_M <= 0.04
    for resolution in ([6, 5, 4], [40, 30, 20]):
        avatar = capsule_avatar(resolution=resolution)
        inner = cells_of(avatar, capsule_points(0.03))
        assert bool(avatar.model.occupied_cells(POSES)[inner].all())
