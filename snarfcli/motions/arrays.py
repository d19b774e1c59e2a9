"""What the arrays of a pose file mean: poses in any layout, translation, frame rate."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions.layouts import BODY_JOINTS, FINGER_JOINTS, LAYOUTS, carry_over, layout_of
from snarfcli.motions.motion import Motion
from snarfcli.motions.up_axis import Up, up_axis, y_up_from_z_up

__all__ = ["DEFAULT_FRAME_RATE", "MAX_POSE_BYTES", "POSE_KEYS", "motion_from_arrays"]

log = logging.getLogger(__name__)

DEFAULT_FRAME_RATE = 60.0
"""Of files that do not say: that of DFaust, CAPE and AIST++."""
MAX_POSE_BYTES = 2**28
"""What the arrays of a pose file may take, as stored."""
_MOST_VALUES = 2**24  # 35 minutes of SMPL-H at 50 frames a second
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
"""Names of all arrays that are looked at; gender is not used, but pickled objects in its place are refused."""
# Axis-angle of a joint stays below pi, and below twice that if somebody unrolled it. In degrees some joint of a body is
# further from straight than these 12.6 in nearly every frame. The root is left out: dancers turn and turn.
_DEGREES = 4 * np.pi
_LARGEST_ANGLE = 1e4
_LARGEST_WAY_M = 1e6


def motion_from_arrays(
    arrays: Mapping[str, NDArray], skeleton: Skeleton, path: Path, *, name: str, up: Up, hands: str
) -> Motion:
    """Make a motion of the arrays of a pose file.

    Args:
        arrays: `poses` (T, 3 K), (T, K, 3) or rotation matrices (T, K, 3, 3), or AMASS's parts `root_orient`, `pose_body`
            and so on; optional: a translation, `smpl_scaling` that divides it, a frame rate, all under the usual names; `up`,
            the text y or z.
        skeleton: whose poses are wanted.
        path: file they come from, for messages.
        name: what the motion is called.
        up: which way is up in the file; `auto` believes the file's own `up` where it has one.
        hands: what SMPL's hand joints do where the file has fingers: `rest` or `released`.

    Raises:
        UserError: something is missing, has the wrong shape or number of values, is not finite, or is in degrees.
    """
    values, names, is_amass = _values(arrays, path, _wanted(skeleton))
    frames = len(values)
    if frames == 0:
        raise UserError(f"pose file {path} has zero frames; give a file with at least one")
    poses = _of_skeleton(values, names, skeleton, path, hands)
    _check_angles(poses, path)
    key = next((key for key in _TRANSLATIONS if key in arrays), None)
    translation = np.zeros((frames, 3))
    if key is not None:
        translation = np.atleast_2d(_numbers(arrays[key], key, path))
        if translation.shape != (frames, 3):
            raise UserError(f"pose file {path}: {key} has shape {list(translation.shape)}, wanted [{frames}, 3]")
        translation = translation / _scaling(arrays, path)
        if np.abs(translation).max() > _LARGEST_WAY_M:
            raise UserError(f"pose file {path}: {key} leads over {_LARGEST_WAY_M / 1000:g} km away; wanted metres")
    frame_rate = _frame_rate(arrays, path)
    if up == "auto":
        said = str(arrays.get("up", ""))
        if said in ("y", "z"):
            up = said
        elif is_amass and layout_of(skeleton) is not None:
            up = "z"
        elif "smpl_poses" in arrays:  # AIST++'s world has y up, however its dancers lie
            up = "y"
        else:
            up = "y" if key is None else up_axis(Rotation.from_rotvec(poses[:, 0]))
        if up == "z":
            log.info("%s: z is up in this file and was turned to y", path.name)
    if up == "z":
        root_rest = skeleton.joints_rest[0].detach().cpu().double().numpy()
        poses, translation = y_up_from_z_up(poses, translation, root_rest)
    return Motion(name, poses, translation, frame_rate)


def _values(arrays: Mapping[str, NDArray], path: Path, wanted: str) -> tuple[NDArray[np.float64], tuple[str, ...], bool]:
    """Return poses [T, K, 3], the names of the K joints if the file says which they are, and whether it is AMASS's."""
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
        raise UserError(f"pose file {path}: {key} has shape {list(values.shape)}, wanted [frames, values]")
    if values.shape[1] % 3 or not values.shape[1]:
        raise UserError(f"pose file {path} has {values.shape[1]} values a frame, wanted {wanted}")
    poses = values.reshape(len(values), values.shape[1] // 3, 3)
    return poses, (), values.shape[1] in (156, 165)


def _from_matrices(matrices: NDArray[np.float64], key: str, path: Path) -> NDArray[np.float64]:
    flat = matrices.reshape(-1, 3, 3)
    error = np.abs(flat @ flat.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if error > 1e-3 or (np.linalg.det(flat) < 0).any():
        raise UserError(f"pose file {path}: {key} has shape {list(matrices.shape)}, but does not hold rotation matrices")
    turns = Rotation.from_matrix(flat).as_rotvec() if len(flat) else np.zeros((0, 3))
    return turns.reshape(*matrices.shape[:2], 3)


def _from_parts(arrays: Mapping[str, NDArray], path: Path) -> NDArray[np.float64]:
    """Return poses [T, 55, 3] of body, fingers and face from AMASS's parts; parts that are missing stay straight."""
    missing = [key for key in ("root_orient", "pose_body") if key not in arrays]
    if missing:
        found = ", ".join(sorted(arrays)) or "nothing of use"
        raise UserError(f"pose file {path} has no 'poses'; it holds {found}; give an AMASS-style file")
    frames = np.atleast_2d(arrays["root_orient"]).shape[0]
    parts = []
    for key, joints in _PARTS.items():
        values = np.zeros((frames, 3 * len(joints)))
        if key in arrays:
            values = np.atleast_2d(_numbers(arrays[key], key, path))
            if values.size != frames * 3 * len(joints):
                shape = list(arrays[key].shape)
                raise UserError(f"pose file {path}: {key} has shape {shape}, wanted [{frames}, {3 * len(joints)}]")
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
        raise UserError(f"pose file {path} has {3 * values.shape[1]} values a frame, wanted {_wanted(skeleton)}")
    return carry_over(values, names, wanted, hands)


def _wanted(skeleton: Skeleton) -> str:
    """Say which numbers of values can be read."""
    if layout_of(skeleton) is None:
        return str(3 * skeleton.num_joints)
    return "72 (SMPL), 156 (SMPL-H) or 165 (SMPL-X)"


def _check_angles(poses: NDArray[np.float64], path: Path) -> None:
    largest = np.abs(poses).max()
    if poses.shape[1] > 1 and np.median(np.abs(poses[:, 1:]).max((1, 2))) > _DEGREES:
        raise UserError(f"pose file {path}: the poses look like degrees, up to {largest:.5g}; save them in radians")
    if largest > _LARGEST_ANGLE:
        raise UserError(f"pose file {path}: the poses hold {largest:.5g}, which is no angle in radians; repair the file")


def _numbers(array: NDArray, name: str, path: Path) -> NDArray[np.float64]:
    if array.dtype.kind not in "fiu":
        raise UserError(f"pose file {path}: {name} holds {array.dtype}, wanted numbers")
    if array.size > _MOST_VALUES:
        raise UserError(f"pose file {path}: {name} has {array.size} values, more than {_MOST_VALUES}; cut it into parts")
    with np.errstate(over="ignore"):
        values = array.astype(np.float64)
    broken = ~np.isfinite(values)
    if broken.any():
        frame = int(np.argwhere(broken)[0][0]) if array.ndim > 1 else 0
        raise UserError(f"pose file {path}: {name} holds NaN or infinity, first in frame {frame}; repair or cut the file")
    return values


def _positive(array: NDArray, key: str, path: Path) -> float:
    if array.dtype.kind not in "fiu" or array.size != 1 or not np.isfinite(array).all() or not 1e-6 < array.item() < 1e6:
        raise UserError(f"pose file {path}: {key} must be one positive number")
    return float(array.item())


def _scaling(arrays: Mapping[str, NDArray], path: Path) -> float:
    """Return what AIST++'s translation is to be divided by; 1 for other files."""
    return _positive(arrays["smpl_scaling"], "smpl_scaling", path) if "smpl_scaling" in arrays else 1.0


def _frame_rate(arrays: Mapping[str, NDArray], path: Path) -> float:
    key = next((key for key in _FRAME_RATES if key in arrays), None)
    if key is None:
        log.info("%s: no frame rate given, %g frames a second assumed", path.name, DEFAULT_FRAME_RATE)
        return DEFAULT_FRAME_RATE
    return _positive(arrays[key], key, path)
