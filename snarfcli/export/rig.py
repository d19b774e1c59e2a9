"""The skeleton of an avatar as a rig of nodes: joint frames, and their transforms relative to the parents.

A rig moves a vertex by sum_k w_k G_k(pose) inv(G_k(bind)), where G_k is the frame of joint k, from joint to world. The bind
pose is the canonical pose, and G_k(pose) = B_k G_k(bind) with the bone transform B_k, canonical to posed. So the rig is exactly
the skinning of the avatar (SNARF Eq. 4), for all weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import nearest_rotation

__all__ = ["LocalTransforms", "Stance", "bind_frames", "canonical_stance", "decompose", "local_frames", "recompose"]

_IS_RIGID = 1e-5
"""Largest deviation of a scale from 1 that counts as rounding of float32."""


@dataclass(frozen=True, eq=False)
class LocalTransforms:
    """Transforms of joints relative to their parents, as in glTF nodes: scale first, then rotation, then translation."""

    translation: NDArray[np.float64]
    """[T, J, 3] metres."""
    rotation: NDArray[np.float64]
    """[T, J, 4] unit quaternions x, y, z, w; the sign is the one nearer to the frame before."""
    scale: NDArray[np.float64]
    """[T, J, 3]."""


@dataclass(frozen=True, eq=False)
class Stance:
    """The pose in which a character is stored: its mesh, and its joints at rest."""

    from_canonical: NDArray[np.float64]
    """[J, 4, 4] bone transforms from the canonical pose, metres."""
    frames: NDArray[np.float64]
    """[J, 4, 4] joint frames in this pose, from joint to world, metres."""


def canonical_stance(skeleton: Skeleton) -> Stance:
    """Return the canonical pose as a stance."""
    return Stance(np.tile(np.eye(4), (skeleton.num_joints, 1, 1)), bind_frames(skeleton))


def bind_frames(skeleton: Skeleton) -> NDArray[np.float64]:
    """Return the joint frames in the canonical pose, [J, 4, 4], from joint to canonical coordinates, metres.

    In the rest pose all axes are parallel to those of the world.
    """
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0].numpy()
    frames = canonical_from_rest.copy()
    frames[:, :3, 3] = skeleton.canonical_joints.numpy()
    return frames


def local_frames(world_from_joint: NDArray[np.float64], parents: Sequence[int]) -> NDArray[np.float64]:
    """Return joint frames [..., J, 4, 4] relative to the frames of their parents; those of roots are unchanged."""
    local = world_from_joint.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[..., joint, :, :] = np.linalg.solve(world_from_joint[..., parent, :, :], world_from_joint[..., joint, :, :])
    return local


def decompose(local: NDArray[np.float64]) -> LocalTransforms:
    """Split transforms [T, J, 4, 4] into translation, rotation and scale. Shear, which nodes cannot have, is left out."""
    linear = local[..., :3, :3]
    rotation = nearest_rotation(torch.from_numpy(linear / _lengths(linear)[..., None, :])).numpy()
    scale = np.einsum("...ab,...ab->...b", rotation, linear)
    scale = np.where(np.abs(scale - 1) < _IS_RIGID, 1.0, scale)
    quaternions = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat().reshape(*local.shape[:-2], 4)
    # A quaternion and its negative are the same rotation, but programs interpolate: neighbours need the nearer sign.
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0
    signs = np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)
    first = np.where(quaternions[:1, ..., 3:] < 0, -1.0, 1.0)
    quaternions[1:] *= signs[..., None]
    return LocalTransforms(local[..., :3, 3].copy(), quaternions * first, scale)


def recompose(transforms: LocalTransforms, parents: Sequence[int]) -> NDArray[np.float64]:
    """Return the joint frames [T, J, 4, 4], joint to world, that a reader computes from the nodes."""
    local = np.zeros((*transforms.rotation.shape[:-1], 4, 4))
    turns = Rotation.from_quat(transforms.rotation.reshape(-1, 4)).as_matrix().reshape(*local.shape[:-2], 3, 3)
    local[..., :3, :3] = turns * transforms.scale[..., None, :]
    local[..., :3, 3] = transforms.translation
    local[..., 3, 3] = 1
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[..., joint, :, :] = local[..., parent, :, :] @ local[..., joint, :, :]
    return local


def _lengths(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths [..., 3] of the columns of matrices [..., 3, 3], 1 for columns of zeros."""
    lengths = np.linalg.norm(linear, axis=-2)
    return np.where(lengths > 1e-12, lengths, 1.0)
