"""Motions to be exported, as bone transforms, and placed on the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import skin_vertices
from snarfcli.field_docs import documented
from snarfcli.meshing.mesh import Mesh
from snarfcli.motions import Motion

__all__ = ["HEIGHTS", "Clip", "clip_transforms", "lowest_point", "on_ground"]

HEIGHTS = ("auto", "ground", "file")
"""Height of a clip. `ground`: lowest point at y = 0; `file`: as in the motion; `auto`: `ground` for built-in motions only."""

_MOST_FRAMES = 200  # evenly spread over a clip; a foot stays on the ground for longer than the gap between two of them


@documented
@dataclass(frozen=True, eq=False)
class Clip:
    """A motion to be exported."""

    motion: Motion
    """Poses [T, J, 3], root translation [T, 3], name and frame rate."""
    bone_transforms: NDArray | None = None
    """[T, J, 4, 4], canonical to posed, metres; needed where joints stretch, which poses cannot express."""


def clip_transforms(skeleton: Skeleton, clip: Clip) -> NDArray[np.float64]:
    """Return the bone transforms [T, J, 4, 4] of a clip, canonical to posed, metres, in float64."""
    if clip.bone_transforms is not None:
        return np.asarray(clip.bone_transforms, dtype=np.float64)
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    poses, translation = (torch.from_numpy(np.asarray(a, np.float64)) for a in (clip.motion.poses, clip.motion.translation))
    return skeleton.posed_from_canonical(poses, translation).numpy()


def lowest_point(mesh: Mesh, skeleton: Skeleton, clip: Clip) -> float:
    """Return the height of the lowest vertex in a clip, metres, found in at most 200 of its frames.

    Args:
        mesh: canonical, with weights.
        skeleton: skeleton of the avatar.
        clip: a motion.
    """
    assert mesh.weights is not None
    frames = np.unique(np.linspace(0, clip.motion.num_frames - 1, _MOST_FRAMES).astype(int))
    transforms = clip_transforms(skeleton, clip)[frames]
    return min(float(skin_vertices(mesh.vertices, mesh.weights, one)[:, 1].min()) for one in transforms)


def on_ground(mesh: Mesh, skeleton: Skeleton, clip: Clip) -> tuple[Clip, float]:
    """Move a clip vertically so that its lowest point is at y = 0.

    Args:
        mesh: canonical, with weights.
        skeleton: skeleton of the avatar.
        clip: the motion, which is moved as a whole.

    Returns:
        The moved clip, and how far it was moved up, metres.
    """
    up = -lowest_point(mesh, skeleton, clip)
    motion = replace(clip.motion, translation=np.add(clip.motion.translation, (0.0, up, 0.0)))
    transforms: NDArray | None = clip.bone_transforms
    if transforms is not None:
        transforms = np.array(transforms)
        transforms[:, :, 1, 3] += up
    return replace(clip, motion=motion, bone_transforms=transforms), up
