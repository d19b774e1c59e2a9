"""Turn the pose arrays of one person, in any of the usual shapes, into axis-angle vectors per joint."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.formats.pickle_tree import Unknown
from snarfcli.motions.layouts import BODY_JOINTS, FINGER_JOINTS, LAYOUTS

__all__ = ["lead_axes", "numbers", "poses_of"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_MAX_VALUES = 2**24  # 35 minutes of SMPL-H at 50 frames per second
# Left fingers, then right.
_HANDS = {"left_hand": FINGER_JOINTS[:15], "right_hand": FINGER_JOINTS[15:]}
_EXTRAS = {
    "hands": FINGER_JOINTS,
    **_HANDS,
    "jaw": ("jaw",),
    "eyes": ("l_eye", "r_eye"),
    "left_eye": ("l_eye",),
    "right_eye": ("r_eye",),
}
_MIN_WIDTH = 63  # values of the smallest body
_BODIES = (21, 23)  # joints of a body without the root: SMPL-H and SMPL-X, and SMPL with its two hands


def lead_axes(role: str, array: NDArray) -> int:
    """Return the number of axes of an array before those of joints and values: 0 for one pose, 1 with frames, 2 with persons.

    Args:
        role: `poses`, `body` or `mhr_rotations`; see `role_of`.
        array: axis-angle [..., 3 K] or [..., K, 3], or rotation matrices [..., K, 3, 3].
    """
    shape = array.shape
    if array.ndim >= 3 and shape[-2:] == (3, 3) and (array.ndim > 3 or shape[0] in (*LAYOUTS, len(BODY_JOINTS), *_BODIES, 127)):
        return array.ndim - 3
    joints = _BODIES if role == "body" else (*LAYOUTS, len(BODY_JOINTS))
    if array.ndim >= 2 and shape[-1] == 3 and (shape[-2] in joints or array.ndim > 2):
        return array.ndim - 2
    if array.ndim > 2 and (shape[-1] % 3 or shape[-1] < _MIN_WIDTH):
        return 1
    return max(array.ndim - 1, 0)


def poses_of(found: Mapping[str, tuple[str, Any]], path: Path, wanted: str) -> tuple[Array, tuple[str, ...]]:
    """Return the poses [T, K, 3], axis-angle, radians, and the names of the K joints, empty if their number tells.

    Args:
        found: name and array by role: `poses`, or `root` and `body` and optionally fingers and face.
        path: the file, for messages.
        wanted: the accepted numbers of values per frame, for messages.

    Raises:
        UserError: an array has a wrong shape or number of values, is not finite, or has matrices that do not rotate.
    """
    if "poses" not in found:
        return _from_parts(found, path)
    key, array = found["poses"]
    values = numbers(array, key, path)
    if values.ndim >= 3 and values.shape[-2:] == (3, 3) and (values.ndim == 4 or lead_axes("poses", values) == 0):
        return _from_matrices(values if values.ndim == 4 else values[None], key, path), ()
    if values.ndim == 2 and lead_axes("poses", values) == 0:
        values = values[None]  # one pose, joint by joint
    if values.ndim == 3 and values.shape[2] == 3:
        values = values.reshape(len(values), 3 * values.shape[1])
    if values.ndim == 1 and len(values):
        values = values[None]
    if values.ndim != 2:
        raise UserError(f"pose file {path}: {key}: wanted shape [frames, values], got {list(values.shape)}; repair the file")
    if values.shape[1] % 3 or not values.shape[1]:
        raise UserError(f"pose file {path}: wanted {wanted} values per frame, got {values.shape[1]}; give another file")
    return values.reshape(len(values), values.shape[1] // 3, 3), ()


def _from_parts(found: Mapping[str, tuple[str, Any]], path: Path) -> tuple[Array, tuple[str, ...]]:
    """Return the poses and joint names of root, body and the parts that are there."""
    key, array = found["body"]
    body = numbers(array, key, path)
    lead = lead_axes("body", body)
    frames = int(np.prod(body.shape[:lead])) if lead < 2 else -1
    joints = next((count for count in _BODIES if body.size in (3 * count * frames, 9 * count * frames)), _BODIES[0])
    root_key, root_array = found["root"]
    root = numbers(root_array, root_key, path)
    if key == "pose_body":  # AMASS: the root counts the frames, and the body has 21 joints
        frames, joints = (len(root) if root.ndim > 1 else 1), len(BODY_JOINTS) - 1
    names = SMPL_JOINT_NAMES[: joints + 1]
    parts = [_part(root, root_key, frames, 1, path), _part(body, key, frames, joints, path)]
    for role, extra in _EXTRAS.items():
        if role not in found:
            continue
        key, array = found[role]
        values = numbers(array, key, path)
        if role in _HANDS and values.size not in (45 * frames, 135 * frames):
            log.info("%s: %s: principal components of hands need a body model; hands stay at rest", path.name, key)
            continue
        parts.append(_part(values, key, frames, len(extra), path))
        names = (*names, *extra)
    return np.concatenate(parts, 1), names


def _part(values: Array, key: str, frames: int, joints: int, path: Path) -> Array:
    """Return the axis-angle vectors [T, joints, 3] of an array of them or of matrices, in any shape."""
    if frames >= 0 and values.size == 9 * joints * frames and frames and values.shape[-2:] == (3, 3):
        return _from_matrices(values.reshape(frames, joints, 3, 3), key, path)
    if frames < 0 or values.size != 3 * joints * frames:
        shape, wanted = list(values.shape), ["frames" if frames < 0 else frames, 3 * joints]
        raise UserError(f"pose file {path}: {key}: wanted shape [{wanted[0]}, {wanted[1]}], got {shape}; repair the file")
    return values.reshape(frames, joints, 3)


def _from_matrices(matrices: Array, key: str, path: Path) -> Array:
    flat = matrices.reshape(-1, 3, 3)
    error = np.abs(flat @ flat.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > 1e-3 or (np.linalg.det(flat) < 0).any():
        shape = list(matrices.shape)
        raise UserError(f"pose file {path}: {key}: wanted rotation matrices, got others of shape {shape}; repair the file")
    turns = Rotation.from_matrix(flat).as_rotvec() if len(flat) else np.zeros((0, 3))
    return turns.reshape(*matrices.shape[:2], 3)


def numbers(array: Any, name: str, path: Path) -> Array:
    """Return the finite numbers of an array.

    Raises:
        UserError: it is no array, too large, or has something else than finite numbers.
    """
    if isinstance(array, Unknown):
        raise UserError(f"pose file {path}: {name}: wanted an array, got an object of {array.path}; nothing was executed")
    if not isinstance(array, np.ndarray):
        raise UserError(f"pose file {path}: {name}: wanted an array, got {type(array).__name__}; repair the file")
    if array.dtype.kind not in "fiu":
        raise UserError(f"pose file {path}: {name}: wanted numbers, got {array.dtype}; repair the file")
    if array.size > _MAX_VALUES:
        raise UserError(f"pose file {path}: {name}: wanted at most {_MAX_VALUES} values, got {array.size}; cut it into parts")
    with np.errstate(over="ignore"):
        values = array.astype(np.float64)
    broken = ~np.isfinite(values)
    if broken.any():
        frame = int(np.argwhere(broken)[0][0]) if array.ndim > 1 else 0
        wanted = "wanted finite numbers, got NaN or infinity"
        raise UserError(f"pose file {path}: {name}: {wanted}, first in frame {frame}; repair or cut the file")
    return values
