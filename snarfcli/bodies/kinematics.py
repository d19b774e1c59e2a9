"""Rotations as axis-angle vectors, and forward kinematics of a joint tree."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.precision import without_autocast

__all__ = [
    "axis_angle_to_matrix",
    "forward_kinematics",
    "invert_rigid",
    "matrix_to_axis_angle",
    "nearest_rotation",
    "pose_from_transforms",
]

# Distance from a joint at which frames are compared, metres: about the size of a hand; expresses rotation and scale as lengths.
_REACH_M = 0.1

# Matrices with M^T M this close to the identity are projected to rotations by iteration.
_NEARLY_A_ROTATION = 0.05

# Below this squared angle the series to t^8 is used; its first omitted term, t^10 / 11!, is under 3e-18.
_SMALL_ANGLE_SQUARED = 1e-2


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Convert axis-angle vectors to rotation matrices (Rodrigues' formula), smoothly through zero.

    Args:
        axis_angle: [..., 3], rotation axis times angle, radians, float32 or float64.

    Returns:
        [..., 3, 3], rotation matrices, same dtype and device; differentiable everywhere, also at zero.

    Raises:
        ValueError: the last dimension is not 3.
    """
    if axis_angle.shape[-1:] != (3,):
        raise ValueError(f"axis_angle: wanted shape [..., 3], got {list(axis_angle.shape)}")
    squared = axis_angle.square().sum(-1)
    is_small = squared < _SMALL_ANGLE_SQUARED
    # The branch that is not selected must stay finite too, or its gradient would be NaN times zero.
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    s = squared
    sin_over = torch.where(is_small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72))), torch.sin(angle) / angle)
    # (1 - cos t) / t^2 by the half angle, which avoids cancellation
    half = torch.sin(angle / 2) / angle
    cos_over = torch.where(is_small, 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90)))), 2 * half * half)
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    outer = axis_angle[..., :, None] * axis_angle[..., None, :]
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    # K^2 = v v^T - |v|^2 I
    sin_over, cos_over, s = (factor[..., None, None] for factor in (sin_over, cos_over, s))
    return (1 - cos_over * s) * eye + sin_over * cross + cos_over * outer


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Convert rotation matrices to axis-angle vectors of length at most pi.

    Args:
        matrix: [..., 3, 3], rotation matrices, float32 or float64.

    Returns:
        [..., 3], axis times angle, radians. Accurate at 0 and at pi, since the quaternion is computed from its largest
        component.

    Raises:
        ValueError: the last two dimensions are not 3 x 3.
    """
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(f"matrix: wanted shape [..., 3, 3], got {list(matrix.shape)}")
    m = matrix.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    # Row k is 4 q_k times the quaternion (w, x, y, z).
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20], -1),
            torch.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12], -1),
            torch.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    quaternion = torch.take_along_dim(rows, largest[..., None, None], -2).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, v = quaternion[..., 0], quaternion[..., 1:]
    squared = v.square().sum(-1)
    is_small = squared < 1e-12
    sine = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    # 2 atan(s / w) / s = 2 / w + O(s^2) near the identity
    scale = torch.where(is_small, 2 / torch.where(is_small, w, torch.ones_like(w)), 2 * torch.atan2(sine, w) / sine)
    return scale[..., None] * v


@without_autocast
def invert_rigid(transform: Tensor) -> Tensor:
    """Invert rigid transforms [..., 4, 4] exactly, with the transposed rotation."""
    rotation_t = transform[..., :3, :3].transpose(-1, -2)
    translation = -(rotation_t @ transform[..., :3, 3:])
    return torch.cat([torch.cat([rotation_t, translation], -1), transform[..., 3:, :]], -2)


@without_autocast
def forward_kinematics(
    pose: Tensor, joints_rest: Tensor, parents: Sequence[int], translation: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Pose a joint tree.

    Dtype and device of the result are those of `pose`.

    Args:
        pose: [B, J, 3], rotation of each joint relative to its parent, axis-angle, radians; joint 0 is the global orientation.
        joints_rest: [J, 3] or [B, J, 3], joint positions in the rest pose, metres.
        parents: J parents, -1 for the root; a parent comes before its children.
        translation: [B, 3], added to every joint, metres; none by default. The root joint is at joints_rest[0] + translation.

    Returns:
        joints_posed: [B, J, 3], posed joints, metres.
        posed_from_rest: [B, J, 4, 4], transforms that move points of the rest pose with each bone, metres.

    Raises:
        ValueError: a shape does not match, or a parent does not come before its child.
    """
    joints = len(parents)
    if pose.ndim != 3 or pose.shape[1:] != (joints, 3):
        raise ValueError(f"pose: wanted shape [B, {joints}, 3], got {list(pose.shape)}")
    batch = pose.shape[0]
    if joints_rest.shape not in ((joints, 3), (batch, joints, 3)):
        raise ValueError(f"joints_rest: wanted shape [{joints}, 3] or [{batch}, {joints}, 3], got {list(joints_rest.shape)}")
    if translation is not None and translation.shape != (batch, 3):
        raise ValueError(f"translation: wanted shape [{batch}, 3], got {list(translation.shape)}")
    _check_parents(parents)
    rest = joints_rest.to(pose).expand(batch, joints, 3)
    translation = None if translation is None else translation.to(pose)
    local = axis_angle_to_matrix(pose)
    rotations: list[Tensor] = []
    positions: list[Tensor] = []
    for joint, parent in enumerate(parents):
        if parent < 0:
            rotations.append(local[:, joint])
            positions.append(rest[:, joint] if translation is None else rest[:, joint] + translation)
        else:
            offset = rest[:, joint] - rest[:, parent]
            rotations.append(rotations[parent] @ local[:, joint])
            positions.append(positions[parent] + (rotations[parent] @ offset[..., None]).squeeze(-1))
    rotation = torch.stack(rotations, 1)
    joints_posed = torch.stack(positions, 1)
    offset = joints_posed - (rotation @ rest[..., None]).squeeze(-1)
    top = torch.cat([rotation, offset[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(batch, joints, 1, 4)
    return joints_posed, torch.cat([top, bottom], -2)


def nearest_rotation(matrix: Tensor) -> Tensor:
    """Return the nearest rotation matrices (least squares): scale, shear and reflection are removed.

    Args:
        matrix: [..., 3, 3], float32 or float64, finite. Rotations are returned unchanged, up to rounding.

    Returns:
        [..., 3, 3], rotation matrices; arbitrary where the nearest one is not unique, as for zero.
    """
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    error = (matrix.transpose(-1, -2) @ matrix - eye).abs().amax((-1, -2))
    is_proper = torch.linalg.det(matrix) > 0
    is_near = is_proper & (error < _NEARLY_A_ROTATION)
    rotation = matrix.clone()
    polished = matrix[is_near & (error > 64 * torch.finfo(matrix.dtype).eps)]
    if len(polished):
        # Newton's iteration for the polar factor: the error falls as 0.05, 2e-3, 3e-6, 5e-12, 0. It serves rotations stored as
        # float32, and is a hundred times faster than the decomposition.
        result = polished
        for _ in range(4):
            result = result @ (1.5 * eye - 0.5 * result.transpose(-1, -2) @ result)
        rotation[is_near & (error > 64 * torch.finfo(matrix.dtype).eps)] = result
    if not is_near.all():
        u, _, vh = torch.linalg.svd(matrix[~is_near])
        sign = torch.linalg.det(u @ vh)
        rotation[~is_near] = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1) @ vh
    return rotation


def pose_from_transforms(posed_from_rest: Tensor, parents: Sequence[int], joints_rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the poses that reproduce given bone transforms: the inverse of `forward_kinematics`.

    Args:
        posed_from_rest: [T, J, 4, 4], transforms that move a point of the rest pose with each bone, metres, float32 or float64.
            Poses cannot express scale, shear, reflection and joints that come apart: see the residual.
        parents: J parents, -1 for the root; a parent comes before its children.
        joints_rest: [J, 3], joint positions in the rest pose, metres.

    Returns:
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
        residual: [T], difference between the transforms and those of the poses, metres: the largest distance between their
            images of the joints and of the points 0.1 m from the joints along the axes. Rounding causes about 1e-6 in float32.

    Raises:
        ValueError: a shape does not match, a number is not finite, or a parent does not come before its child.
    """
    joints = len(parents)
    if posed_from_rest.ndim != 4 or posed_from_rest.shape[1:] != (joints, 4, 4):
        raise ValueError(f"posed_from_rest: wanted shape [T, {joints}, 4, 4], got {list(posed_from_rest.shape)}")
    if joints_rest.shape != (joints, 3):
        raise ValueError(f"joints_rest: wanted shape [{joints}, 3], got {list(joints_rest.shape)}")
    _check_parents(parents)
    if not posed_from_rest.isfinite().all():
        raise ValueError("posed_from_rest: wanted finite numbers, got NaN or infinity")
    rest = joints_rest.to(posed_from_rest)
    rotation = nearest_rotation(posed_from_rest[..., :3, :3])
    relative = [rotation[:, j] if p < 0 else rotation[:, p].transpose(-1, -2) @ rotation[:, j] for j, p in enumerate(parents)]
    poses = matrix_to_axis_angle(torch.stack(relative, 1))
    root = (posed_from_rest[:, 0, :3, :3] @ rest[0]) + posed_from_rest[:, 0, :3, 3]
    translation = root - rest[0]
    again = forward_kinematics(poses, rest, parents, translation)[1]
    reach = torch.cat([torch.zeros(1, 3), _REACH_M * torch.eye(3)]).to(rest)
    error = posed_from_rest - again
    # [T, J, 4, 3]: differences at the joint and at the three points beside it
    apart = (error[..., None, :3, :3] @ (rest[:, None] + reach)[..., None]).squeeze(-1) + error[..., None, :3, 3]
    return poses, translation, apart.norm(dim=-1).amax((1, 2))


def _check_parents(parents: Sequence[int]) -> None:
    if any(not -1 <= parent < joint for joint, parent in enumerate(parents)) or parents[0] != -1:
        raise ValueError("parents: wanted every parent before its child, and joint 0 as the root (-1)")
