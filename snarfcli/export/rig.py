"""The skeleton of an avatar as a rig of nodes: joint frames, and their transforms relative to the parents'.

A rig moves a vertex by sum_k w_k G_k(pose) inv(G_k(bind)), where G_k takes the frame of joint k to the world. The bind pose is
the canonical one, and G_k(pose) = B_k G_k(bind) with the bone transform B_k, canonical to posed: so the rig is the avatar's own
skinning (SNARF Eq. 4), for all weights exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.bodies.skinning import skin_vertices
from snarfcli.meshing.mesh import Mesh
from snarfcli.motions import Motion

__all__ = [
    "HEIGHTS",
    "Clip",
    "LocalTransforms",
    "bind_frames",
    "clip_transforms",
    "decompose",
    "local_frames",
    "lowest_point",
    "on_ground",
    "recompose",
]

HEIGHTS = ("auto", "ground", "file")
"""How high a clip is: `ground`, its lowest point at y = 0; `file`, as its motion has it; `auto`, only built-in ones there."""

_MOST_FRAMES = 200  # of a clip, evenly spread: a foot is on the ground for longer

_IS_RIGID = 1e-5
"""How far a scale may be from 1, and axes from a right angle, to be taken for rounding of float32."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion to be exported."""

    motion: Motion
    """Poses [T, J, 3], root translation [T, 3], name and frame rate."""
    bone_transforms: NDArray | None = None
    """[T, J, 4, 4] canonical to posed, metres, where joints stretch so that the poses do not say it all; else None."""


@dataclass(frozen=True, eq=False)
class LocalTransforms:
    """Transforms of joints relative to their parents, as glTF's nodes have them: scaled first, then turned, then moved."""

    translation: NDArray[np.float64]
    """[T, J, 3] metres."""
    rotation: NDArray[np.float64]
    """[T, J, 4] unit quaternions x, y, z, w; from frame to frame the nearer of the two signs."""
    scale: NDArray[np.float64]
    """[T, J, 3]."""


def bind_frames(skeleton: Skeleton) -> NDArray[np.float64]:
    """Return where the joints are in the canonical pose, [J, 4, 4] from a joint's own frame to the canonical one, metres.

    In the rest pose all axes are the world's.
    """
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0].numpy()
    frames = canonical_from_rest.copy()
    frames[:, :3, 3] = skeleton.canonical_joints.numpy()
    return frames


def clip_transforms(skeleton: Skeleton, clip: Clip) -> NDArray[np.float64]:
    """Return the bone transforms [T, J, 4, 4] of a clip, canonical to posed, metres, in float64."""
    if clip.bone_transforms is not None:
        return np.asarray(clip.bone_transforms, dtype=np.float64)
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    poses, translation = (torch.from_numpy(np.asarray(a, np.float64)) for a in (clip.motion.poses, clip.motion.translation))
    return skeleton.posed_from_canonical(poses, translation).numpy()


def local_frames(world_from_joint: NDArray[np.float64], parents: Sequence[int]) -> NDArray[np.float64]:
    """Return frames [..., J, 4, 4] relative to the parents' frames; those of roots stay as they are."""
    local = world_from_joint.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[..., joint, :, :] = np.linalg.solve(world_from_joint[..., parent, :, :], world_from_joint[..., joint, :, :])
    return local


def decompose(local: NDArray[np.float64]) -> LocalTransforms:
    """Take transforms [T, J, 4, 4] apart. Shear, which nodes cannot have, is left out; `recompose` shows what is left."""
    linear = local[..., :3, :3]
    rotation = nearest_rotation(torch.from_numpy(linear / _lengths(linear)[..., None, :])).numpy()
    scale = np.einsum("...ab,...ab->...b", rotation, linear)
    scale = np.where(np.abs(scale - 1) < _IS_RIGID, 1.0, scale)
    quaternions = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat().reshape(*local.shape[:-2], 4)
    # A quaternion and its negative are the same turn, but the way from one to the next must be the short one.
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=-1) < 0
    signs = np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)
    first = np.where(quaternions[:1, ..., 3:] < 0, -1.0, 1.0)
    quaternions[1:] *= signs[..., None]
    return LocalTransforms(local[..., :3, 3].copy(), quaternions * first, scale)


def recompose(transforms: LocalTransforms, parents: Sequence[int]) -> NDArray[np.float64]:
    """Return where the joints are, [T, J, 4, 4], as a reader of the nodes would find them."""
    local = np.zeros((*transforms.rotation.shape[:-1], 4, 4))
    turns = Rotation.from_quat(transforms.rotation.reshape(-1, 4)).as_matrix().reshape(*local.shape[:-2], 3, 3)
    local[..., :3, :3] = turns * transforms.scale[..., None, :]
    local[..., :3, 3] = transforms.translation
    local[..., 3, 3] = 1
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[..., joint, :, :] = local[..., parent, :, :] @ local[..., joint, :, :]
    return local


def lowest_point(mesh: Mesh, skeleton: Skeleton, clip: Clip) -> float:
    """Return the height of the lowest vertex of a canonical mesh with weights in a clip, metres."""
    frames = np.unique(np.linspace(0, clip.motion.num_frames - 1, _MOST_FRAMES).astype(int))
    transforms = clip_transforms(skeleton, clip)[frames]
    return min(float(skin_vertices(mesh.vertices, mesh.weights, one)[:, 1].min()) for one in transforms)


def on_ground(mesh: Mesh, skeleton: Skeleton, clip: Clip) -> tuple[Clip, float]:
    """Return a clip moved up or down so that its lowest point is at y = 0, and by how much, metres.

    Args:
        mesh: canonical, with weights.
        skeleton: the avatar's.
        clip: what is moved, as a whole.
    """
    up = -lowest_point(mesh, skeleton, clip)
    motion = replace(clip.motion, translation=np.add(clip.motion.translation, (0.0, up, 0.0)))
    transforms: NDArray | None = clip.bone_transforms
    if transforms is not None:
        transforms = np.array(transforms)
        transforms[:, :, 1, 3] += up
    return replace(clip, motion=motion, bone_transforms=transforms), up


def _lengths(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths [..., 3] of columns, 1 where there is none."""
    lengths = np.linalg.norm(linear, axis=-2)
    return np.where(lengths > 1e-12, lengths, 1.0)
