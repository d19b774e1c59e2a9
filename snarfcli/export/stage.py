"""The stage of a sequence: a camera that stands still and a floor, found before the first frame is drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from snarfcli.export.camera import Camera
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import AvatarLike

__all__ = ["Stage", "set_stage"]

# Points posed in all frames together, and in one frame: a body is covered to within 2 cm by 3000.
_POINTS_IN_ALL = 600_000
_POINTS_LEAST, _POINTS_MOST = 300, 3000


@dataclass(frozen=True)
class Stage:
    """What stays the same through a sequence."""

    camera: Camera
    """Sees the whole sequence."""
    floor_y: float
    """Height of the lowest point of the sequence, metres."""


@torch.no_grad()
def set_stage(
    avatar: AvatarLike,
    poses: np.ndarray,
    translation: np.ndarray,
    canonical_mesh: Mesh | None = None,
    *,
    aspect: float = 1.0,
    azimuth_rad: float = math.radians(28),
    elevation_rad: float = math.radians(9),
    bone_transforms: np.ndarray | None = None,
) -> Stage:
    """Find a camera that sees the body in all frames, from the side that it mostly faces, and the floor below it.

    Args:
        avatar: poses the body.
        poses: [T, J, 3] axis-angle, radians, y up, global orientation included.
        translation: [T, 3] metres.
        canonical_mesh: the body, moved by its skin to find its bounds; without it the wider posed boxes are used.
        aspect: width over height of the picture.
        azimuth_rad: direction of the camera seen from the body: 0 is straight ahead of it, a quarter turn its left.
        elevation_rad: how far the camera looks down.
        bone_transforms: [T, J, 4, 4] canonical to posed, metres, instead of those of the poses.
    """
    points_c = None
    if canonical_mesh is not None:
        count = int(np.clip(_POINTS_IN_ALL // len(poses), _POINTS_LEAST, _POINTS_MOST))
        some = np.linspace(0, len(canonical_mesh.vertices) - 1, min(count, len(canonical_mesh.vertices)))
        points_c = torch.from_numpy(canonical_mesh.vertices[some.astype(int)])
    points = []
    for frame, (pose, shift) in enumerate(zip(torch.from_numpy(poses), torch.from_numpy(translation), strict=True)):
        if bone_transforms is None:
            transforms = avatar.bone_transforms(pose[None].float(), shift[None].float())[0]
        else:
            transforms = torch.from_numpy(bone_transforms[frame])
        if points_c is not None:
            points.append(avatar.skin(points_c, transforms).cpu().numpy())
        else:
            lower, upper = (corner.cpu().numpy() for corner in avatar.posed_box(transforms))
            points.append(np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3))
    seen = np.concatenate(points)
    camera = Camera.framing(seen, aspect=aspect, azimuth_rad=_heading_rad(poses) + azimuth_rad, elevation_rad=elevation_rad)
    return Stage(camera, float(seen[:, 1].min()))


def _heading_rad(poses: np.ndarray) -> float:
    """Return the direction that the body faces on average, 0 for +z; 0 too if it faces all ways."""
    from scipy.spatial.transform import Rotation

    ahead = Rotation.from_rotvec(poses[:, 0]).apply((0.0, 0.0, 1.0)).mean(axis=0)
    return math.atan2(ahead[0], ahead[2]) if math.hypot(ahead[0], ahead[2]) > 0.2 else 0.0
