"""Interpret the arrays of a pose file: poses in any layout, translation, frame rate."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions.angles import angle_problem
from snarfcli.motions.layouts import BODY_JOINTS, FINGER_JOINTS, LAYOUTS, carry_over, layout_of
from snarfcli.motions.motion import Motion
from snarfcli.motions.up_axis import Up, up_axis, y_up_from_z_up

__all__ = ["DEFAULT_FRAME_RATE", "MAX_POSE_BYTES", "POSE_KEYS", "motion_from_arrays"]

log = logging.getLogger(__name__)

DEFAULT_FRAME_RATE = 60.0
"""Frames per second of files without a frame rate: that of DFaust, CAPE and AIST++."""
MAX_POSE_BYTES = 2**28
"""Maximum size of the arrays of a pose file, as stored."""
_MAX_VALUES = 2**24  # 35 minutes of SMPL-H at 50 frames per second
_POSES = ("poses", "pose", "smpl_poses")
_TRANSLATIONS = ("trans", "transl", "translation", "smpl_trans")
_FRAME_RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
# AMASS's SMPL-X files have these beside `poses`; files cut from them may have only these. pose_hand: left, then right.
_PARTS = {
    "root_orient": BODY_JOINTS[:1],
    "pose_body": BODY_JOINTS[1:],
    "pose_hand": FINGER_JOINTS,
    "pose_jaw": ("jaw",),
    "pose_eye": ("l_eye", "r_eye"),
}
POSE_KEYS = (*_POSES, *_TRANSLATIONS, "smpl_scaling", *_FRAME_RATES, *_PARTS, "up", "gender")
"""Names of all arrays that are read; gender is not used, but pickled objects in its place are rejected."""
_MAX_DISTANCE_M = 1e6


def motion_from_arrays(
    arrays: Mapping[str, NDArray], skeleton: Skeleton, path: Path, *, name: str, up: Up, hands: str
) -> Motion:
    """Return the motion that the arrays of a pose file describe.

    Args:
        arrays: `poses` as [T, 3 K], [T, K, 3] or rotation matrices [T, K, 3, 3], or AMASS's parts `root_orient`, `pose_body`
            etc. Optional, under their usual names: a translation; `smpl_scaling`, by which it is divided; a frame rate; `up`,
            the text y or z.
        skeleton: skeleton of the poses to return.
        path: the file, for messages.
        name: name of the motion.
        up: up axis of the file; `auto` uses `up` of the file if present.
        hands: pose of SMPL's hand joints if the file has fingers: `rest` or `released`.

    Raises:
        UserError: an array is missing, has a wrong shape or number of values, is not finite, or is in degrees.
    """
    values, names, is_amass = _values(arrays, path, _wanted(skeleton))
    frames = len(values)
    if frames == 0:
        raise UserError(f"pose file {path}: wanted at least 1 frame, got 0; give another file")
    poses = _of_skeleton(values, names, skeleton, path, hands)
    _check_angles(poses, path)
    key = next((key for key in _TRANSLATIONS if key in arrays), None)
    translation = np.zeros((frames, 3))
    if key is not None:
        translation = np.atleast_2d(_numbers(arrays[key], key, path))
        if translation.shape != (frames, 3):
            raise UserError(
                f"pose file {path}: {key}: wanted shape [{frames}, 3], got {list(translation.shape)}; repair the file"
            )
        translation = translation / _scaling(arrays, path)
        if np.abs(translation).max() > _MAX_DISTANCE_M:
            limit = f"at most {_MAX_DISTANCE_M / 1000:g} km"
            raise UserError(f"pose file {path}: {key}: wanted metres, {limit}, got more; repair the file")
    frame_rate = _frame_rate(arrays, path)
    if up == "auto":
        up = _declared_up(arrays)
        if up == "auto" and is_amass and layout_of(skeleton) is not None:
            up = "z"
        elif up == "auto" and "smpl_poses" in arrays:  # AIST++ has y up, also where dancers lie on the floor
            up = "y"
        elif up == "auto":
            up = "y" if key is None else up_axis(Rotation.from_rotvec(poses[:, 0]))
        if up == "z":
            log.info("%s: z is up in this file and was turned to y", path.name)
    if up == "z":
        root_rest = skeleton.joints_rest[0].detach().cpu().double().numpy()
        poses, translation = y_up_from_z_up(poses, translation, root_rest)
    return Motion(name, poses, translation, frame_rate)


def _declared_up(arrays: Mapping[str, NDArray]) -> Up:
    """Return the up axis that the file declares; `auto` if it does not."""
    declared = str(arrays.get("up", ""))
    return "y" if declared == "y" else "z" if declared == "z" else "auto"


def _values(arrays: Mapping[str, NDArray], path: Path, wanted: str) -> tuple[NDArray[np.float64], tuple[str, ...], bool]:
    """Return the poses [T, K, 3], the names of the K joints (empty if unknown), and whether the file is from AMASS."""
    key = next((key for key in _POSES if key in arrays), None)
    if key is None:
        return _from_parts(arrays, path), (*BODY_JOINTS, *FINGER_JOINTS, "jaw", "l_eye", "r_eye"), True
    values = _numbers(arrays[key], key, path)
    if values.ndim == 4 and values.shape[2:] == (3, 3):
        return _from_matrices(values, key, path), (), False
    if values.ndim == 2 and values.shape[1] == 3 and values.shape[0] in LAYOUTS:
        values = values[None]  # one pose, joint by joint
    if values.ndim == 3 and values.shape[2] == 3:
        values = values.reshape(len(values), 3 * values.shape[1])
    if values.ndim == 1 and len(values):
        values = values[None]
    if values.ndim != 2:
        raise UserError(f"pose file {path}: {key}: wanted shape [frames, values], got {list(values.shape)}; repair the file")
    if values.shape[1] % 3 or not values.shape[1]:
        raise UserError(f"pose file {path}: wanted {wanted} values per frame, got {values.shape[1]}; give another file")
    poses = values.reshape(len(values), values.shape[1] // 3, 3)
    return poses, (), values.shape[1] in (156, 165)


def _from_matrices(matrices: NDArray[np.float64], key: str, path: Path) -> NDArray[np.float64]:
    flat = matrices.reshape(-1, 3, 3)
    error = np.abs(flat @ flat.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > 1e-3 or (np.linalg.det(flat) < 0).any():
        shape = list(matrices.shape)
        raise UserError(f"pose file {path}: {key}: wanted rotation matrices, got others of shape {shape}; repair the file")
    turns = Rotation.from_matrix(flat).as_rotvec() if len(flat) else np.zeros((0, 3))
    return turns.reshape(*matrices.shape[:2], 3)


def _from_parts(arrays: Mapping[str, NDArray], path: Path) -> NDArray[np.float64]:
    """Return the poses [T, 55, 3] of body, fingers and face from AMASS's parts; missing parts are zero."""
    missing = [key for key in ("root_orient", "pose_body") if key not in arrays]
    if missing:
        found = ", ".join(sorted(arrays)) or "no pose arrays"
        raise UserError(f"pose file {path}: wanted 'poses', got {found}; give an AMASS-style file")
    frames = np.atleast_2d(arrays["root_orient"]).shape[0]
    parts = []
    for key, joints in _PARTS.items():
        values = np.zeros((frames, 3 * len(joints)))
        if key in arrays:
            values = np.atleast_2d(_numbers(arrays[key], key, path))
            if values.size != frames * 3 * len(joints):
                shape = list(arrays[key].shape)
                wanted = [frames, 3 * len(joints)]
                raise UserError(f"pose file {path}: {key}: wanted shape {wanted}, got {shape}; repair the file")
        parts.append(values.reshape(frames, -1, 3) if frames else np.zeros((0, len(joints), 3)))
    return np.concatenate(parts, 1)


def _of_skeleton(
    values: NDArray[np.float64], names: tuple[str, ...], skeleton: Skeleton, path: Path, hands: str
) -> NDArray[np.float64]:
    """Return the poses [T, J, 3] of the skeleton's joints."""
    wanted = layout_of(skeleton)
    if not names:
        if values.shape[1] == skeleton.num_joints:
            return values.copy()
        names = BODY_JOINTS if values.shape[1] == len(BODY_JOINTS) else LAYOUTS.get(values.shape[1], ())
    if wanted is None or not names:
        got = 3 * values.shape[1]
        raise UserError(f"pose file {path}: wanted {_wanted(skeleton)} values per frame, got {got}; give another file")
    return carry_over(values, names, wanted, hands)


def _wanted(skeleton: Skeleton) -> str:
    """Return the accepted numbers of values per frame, for messages."""
    if layout_of(skeleton) is None:
        return str(3 * skeleton.num_joints)
    return "72 (SMPL), 156 (SMPL-H) or 165 (SMPL-X)"


def _check_angles(poses: NDArray[np.float64], path: Path) -> None:
    problem = angle_problem(poses)
    if problem:
        raise UserError(f"pose file {path}: {problem}")


def _numbers(array: NDArray, name: str, path: Path) -> NDArray[np.float64]:
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


def _positive(array: NDArray, key: str, path: Path) -> float:
    if array.dtype.kind not in "fiu" or array.size != 1 or not np.isfinite(array).all() or not 1e-6 < array.item() < 1e6:
        raise UserError(f"pose file {path}: {key}: wanted one positive number, got other values; repair the file")
    return float(array.item())


def _scaling(arrays: Mapping[str, NDArray], path: Path) -> float:
    """Return the divisor of AIST++'s translation; 1 for other files."""
    return _positive(arrays["smpl_scaling"], "smpl_scaling", path) if "smpl_scaling" in arrays else 1.0


def _frame_rate(arrays: Mapping[str, NDArray], path: Path) -> float:
    key = next((key for key in _FRAME_RATES if key in arrays), None)
    if key is None:
        log.info("%s: no frame rate given, %g frames per second assumed", path.name, DEFAULT_FRAME_RATE)
        return DEFAULT_FRAME_RATE
    return _positive(arrays[key], key, path)
