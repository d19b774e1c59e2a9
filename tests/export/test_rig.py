from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_character import BONE, JOINTS, ToyCharacter, stretched, wave

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.rig import bind_frames, decompose, local_frames, recompose

TOY = ToyCharacter()
PARENTS = TOY.skeleton.parents


def test_bind_frames_stand_at_the_canonical_joints():
    frames = bind_frames(TOY.skeleton)
    np.testing.assert_allclose(frames[:, :3, 3], TOY.skeleton.canonical_joints, atol=1e-6)
    local = decompose(local_frames(frames[None], PARENTS))
    turns = Rotation.from_quat(local.rotation[0]).as_rotvec()
    np.testing.assert_allclose(turns, TOY.skeleton.canonical_pose, atol=1e-7)
    np.testing.assert_allclose(local.translation[0, 1:], np.tile([BONE, 0, 0], (JOINTS - 1, 1)), atol=1e-7)
    assert (local.scale == 1).all()


def test_local_turns_are_the_poses():
    motion = wave(9)
    transforms = clip_transforms(TOY.skeleton, Clip(motion))
    local = decompose(local_frames(transforms @ bind_frames(TOY.skeleton), PARENTS))
    turns = Rotation.from_quat(local.rotation.reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(turns, Rotation.from_rotvec(motion.poses.reshape(-1, 3)).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(local.translation[:, 0], motion.translation, atol=1e-9)
    np.testing.assert_allclose(recompose(local, PARENTS), transforms @ bind_frames(TOY.skeleton), atol=1e-9)


def test_quaternions_take_the_short_way():
    angles = np.linspace(0, 4 * np.pi, 50)
    local = np.tile(np.eye(4), (50, 1, 1, 1))
    local[:, 0, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0, 1, 0]).as_matrix()
    rotation = decompose(local).rotation
    assert (np.sum(rotation[1:] * rotation[:-1], axis=-1) > 0.9).all()
    assert rotation[0, 0, 3] == pytest.approx(1)


@pytest.mark.parametrize("scale", [1.0, 0.6, 1.4])
def test_scale_and_stretch_survive(scale):
    clip = stretched(wave(5), TOY, scale)
    wanted = clip_transforms(TOY.skeleton, clip) @ bind_frames(TOY.skeleton)
    local = decompose(local_frames(wanted, PARENTS))
    np.testing.assert_allclose(recompose(local, PARENTS), wanted, atol=1e-6)
    assert local.scale[-1, 3] == pytest.approx([scale] * 3)
    assert local.scale[-1, 4] == pytest.approx([1] * 3)


def test_rounding_of_float32_is_no_scale():
    transforms = clip_transforms(TOY.skeleton, Clip(wave(5))).astype(np.float32)
    frames = clip_transforms(TOY.skeleton, Clip(wave(5), transforms)) @ bind_frames(TOY.skeleton)
    local = decompose(local_frames(frames, PARENTS))
    assert (local.scale == 1).all()


def test_shear_is_left_out():
    local = np.eye(4)[None, None].copy()
    local[0, 0, 0, 1] = 0.2
    again = recompose(decompose(local), (-1,))
    columns = again[0, 0, :3, :3]
    assert abs(columns[:, 0] @ columns[:, 1]) < 1e-9
    assert np.abs(again - local).max() < 0.2


def test_skinning_is_the_avatars():
    motion = wave(3)
    vertices = TOY.skinned_surface(24).mesh.vertices
    points = torch.from_numpy(vertices)
    transforms = clip_transforms(TOY.skeleton, Clip(motion))[2]
    wanted = TOY.skin(points, torch.from_numpy(transforms).float())
    found = skin_vertices(vertices, TOY.skinning_weights(points).numpy(), transforms)
    np.testing.assert_allclose(found, wanted, atol=2e-6)
