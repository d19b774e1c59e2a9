"""Clips that stand on the ground: y = 0, where other programs have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.export.rig import Clip, clip_transforms
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import skin_vertices

__all__ = ["HEIGHTS", "lowest_point", "on_ground"]

HEIGHTS = ("auto", "ground", "file")
"""How high a clip is: `ground`, its lowest point at y = 0; `file`, as its motion has it; `auto`, only built-in ones there."""

_MOST_FRAMES = 200  # of a clip, evenly spread: a foot is on the ground for longer


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
    motion = replace(clip.motion, translation=clip.motion.translation + (0.0, up, 0.0))
    transforms: NDArray | None = clip.bone_transforms
    if transforms is not None:
        transforms = np.array(transforms)
        transforms[:, :, 1, 3] += up
    return replace(clip, motion=motion, bone_transforms=transforms), up
