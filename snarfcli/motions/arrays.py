"""Make a motion of a set of pose arrays: poses in any layout, translation, frame rate, up axis."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions.angles import angle_problem
from snarfcli.motions.layouts import BODY_JOINTS, LAYOUTS, carry_over, layout_of
from snarfcli.motions.motion import Motion
from snarfcli.motions.pose_parts import numbers, poses_of
from snarfcli.motions.pose_sets import PoseSet
from snarfcli.motions.positions import are_positions
from snarfcli.motions.up_axis import UPS, Up, hangs_head_down, up_axis, upright, y_from_up

__all__ = ["DEFAULT_FRAME_RATE", "VIDEO_FRAME_RATE", "frame_rate_of", "motion_from_arrays", "place_of"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

DEFAULT_FRAME_RATE = 60.0
"""Frames per second of files without a frame rate: that of DFaust, CAPE and AIST++."""
VIDEO_FRAME_RATE = 30.0
"""The same for results of video estimators, whose frames are those of the video."""
_MAX_DISTANCE_M = 1e6
_MAX_TURN = 4 * np.pi  # radians, of the whole body in one frame
_MAX_POSITIONS = 200  # joints


def motion_from_arrays(arrays: PoseSet, skeleton: Skeleton, path: Path, *, name: str, up: Up, hands: str) -> Motion:
    """Return the motion that a set of pose arrays describes.

    Args:
        arrays: poses as [T, 3 K], [T, K, 3] or rotation matrices [T, K, 3, 3], or root, body and further parts. Optional: a
            translation; a divisor of it, or metres per unit; a frame rate; the up axis as text; the up axis of the rest pose.
        skeleton: skeleton of the poses to return.
        path: the file, for messages.
        name: name of the motion.
        up: up axis of the file; `auto` uses that of the file if present.
        hands: pose of SMPL's hand joints if the file has fingers: `rest` or `released`.

    Raises:
        UserError: an array is missing, has a wrong shape or number of values, is not finite, is in degrees, or has positions
            of joints.
    """
    values, names = poses_of(arrays.found, path, _wanted(skeleton))
    frames = len(values)
    if frames == 0:
        raise UserError(f"pose file {path}: wanted at least 1 frame, got 0; give another file")
    _check_rotations(values, arrays, path)
    poses = _of_skeleton(values, names, skeleton, path, hands)
    _check_angles(poses, path)
    translation = place_of(arrays, frames, path)
    has_place = translation is not None
    translation = np.zeros((frames, 3)) if translation is None else translation
    root_rest = skeleton.joints_rest[0].detach().cpu().double().numpy()
    if "rest_up" in arrays.found:
        declared = _declared_up(arrays, "rest_up")
        if declared == "auto" or up not in ("auto", declared):
            wanted = f"up={declared}, as the file says" if declared != "auto" else f"rest_up: one of {', '.join(UPS[1:])}"
            raise UserError(f"pose file {path}: wanted {wanted}, got another value; leave up out, or repair the file")
        turn = y_from_up(declared)  # of all that has axes: the rest pose is then that of the skeleton
        poses = turn.apply(poses.reshape(-1, 3)).reshape(poses.shape)
        return Motion(name, poses, turn.apply(translation), frame_rate_of(arrays, path))
    if "placed_rotation" in arrays.found and "placed_translation" in arrays.found:
        poses, translation = _placed(poses, arrays, root_rest, path)
        has_place = True
    if up == "auto":
        up = _guessed_up(arrays, poses, skeleton, has_place, path)
    poses, translation = upright(poses, translation, root_rest, up)
    return Motion(name, poses, translation, frame_rate_of(arrays, path))


def place_of(arrays: PoseSet, frames: int, path: Path) -> Array | None:
    """Return the translation [T, 3] of a set of pose arrays, metres; None if there is none.

    Raises:
        UserError: it has another shape, is not finite, or is no place on earth.
    """
    if "trans" not in arrays.found:
        return None
    key, array = arrays.found["trans"]
    translation = np.atleast_2d(numbers(array, key, path))
    if translation.ndim > 2 and translation.size == 3 * frames:
        translation = translation.reshape(frames, 3)
    if translation.shape != (frames, 3):
        shape = list(translation.shape)
        raise UserError(f"pose file {path}: {key}: wanted shape [{frames}, 3], got {shape}; repair the file")
    translation = translation * _metres_per_unit(arrays, path)
    if np.abs(translation).max() > _MAX_DISTANCE_M:
        limit = f"at most {_MAX_DISTANCE_M / 1000:g} km"
        raise UserError(f"pose file {path}: {key}: wanted metres, {limit}, got more; repair the file")
    return translation


def frame_rate_of(arrays: PoseSet, path: Path) -> float:
    """Return the frames per second of a set of pose arrays, or the usual number if the file has none."""
    if "frame_rate" in arrays.found:
        key, value = arrays.found["frame_rate"]
        return _positive(value, key, path)
    usual = VIDEO_FRAME_RATE if arrays.frame or arrays.is_video else DEFAULT_FRAME_RATE
    log.info("%s: no frame rate given, %g frames per second assumed", path.name, usual)
    return usual


def _guessed_up(arrays: PoseSet, poses: Array, skeleton: Skeleton, has_place: bool, path: Path) -> Up:
    """Return the up axis that the file declares, that of its kind of file, or that along which the body stands."""
    up = _declared_up(arrays, "up")
    if up == "auto" and layout_of(skeleton) is not None and _is_amass(arrays):
        up = "z"
    elif up == "auto" and _has_y_up(arrays):
        up = "y"
    elif up == "auto":
        up = up_axis(Rotation.from_rotvec(poses[:, 0])) if has_place and arrays.frame != "camera" else "y"
        if up == "y" and layout_of(skeleton) is not None and hangs_head_down(poses, is_likely=arrays.frame == "camera"):
            log.info("%s: the body hangs head down along y, so that y was taken to point down; up=y keeps it", path.name)
            return "-y"
    if up != "y":
        log.info("%s: %s is up in this file and was turned to y", path.name, up)
    return up


def _declared_up(arrays: PoseSet, role: str) -> Up:
    """Return the up axis that the file declares in an array of this role; `auto` if it does not."""
    value = arrays.found.get(role, ("", ""))[1]
    word = str(value.ravel()[0] if isinstance(value, np.ndarray) and value.size else value)
    return cast(Up, word) if word in UPS else "auto"


def _has_y_up(arrays: PoseSet) -> bool:
    """Return whether files of this kind have y up, also where the body lies on the floor: AIST++ and GVHMR."""
    return arrays.found.get("poses", ("",))[0] == "smpl_poses" or "smpl_params_global" in arrays.label


def _is_amass(arrays: PoseSet) -> bool:
    """Return whether the arrays are in AMASS's form: 156 or 165 values, or its parts."""
    if arrays.frame:
        return False
    if "poses" not in arrays.found:
        return arrays.found["body"][0] == "pose_body"
    shape = arrays.found["poses"][1].shape
    width = 3 * shape[-2] if len(shape) == 3 and shape[-1] == 3 else shape[-1] if len(shape) < 3 else 0
    return width in (156, 165)


def _placed(poses: Array, arrays: PoseSet, root_rest: Array, path: Path) -> tuple[Array, Array]:
    """Return poses and translation of a posed body that is then rotated about the origin and moved, as in EasyMocap."""
    (key, rotations), (other, places) = arrays.found["placed_rotation"], arrays.found["placed_translation"]
    turns, way = numbers(rotations, key, path), numbers(places, other, path)
    if turns.size != 3 * len(poses) or way.size != 3 * len(poses):
        got = f"{list(turns.shape)} and {list(way.shape)}"
        raise UserError(f"pose file {path}: {key}, {other}: wanted shape [{len(poses)}, 3], got {got}; repair the file")
    if np.abs(turns).max() > _MAX_TURN or np.abs(way).max() > _MAX_DISTANCE_M:
        raise UserError(f"pose file {path}: {key}, {other}: wanted radians and metres, got far larger numbers; repair the file")
    rotation = Rotation.from_rotvec(turns.reshape(-1, 3))
    poses = poses.copy()
    poses[:, 0] = (rotation * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, rotation.apply(root_rest) + way.reshape(-1, 3) - root_rest


def _of_skeleton(values: Array, names: tuple[str, ...], skeleton: Skeleton, path: Path, hands: str) -> Array:
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


def _check_rotations(values: Array, arrays: PoseSet, path: Path) -> None:
    """Raise UserError if the values are positions of joints."""
    if values.shape[1] <= _MAX_POSITIONS and are_positions(values):
        key = arrays.found["poses" if "poses" in arrays.found else "body"][0]
        raise UserError(
            f"pose file {path}: {key}: wanted rotations, got joint positions: their distances stay those of a body's bones;"
            " give the file with the rotations, or fit SMPL to the positions first"
        )


def _check_angles(poses: Array, path: Path) -> None:
    problem = angle_problem(poses)
    if problem:
        raise UserError(f"pose file {path}: {problem}")


def _positive(array: object, key: str, path: Path) -> float:
    values = np.asarray(array)
    if values.dtype.kind not in "fiu" or values.size != 1 or not np.isfinite(values).all() or not 1e-6 < values.item() < 1e6:
        raise UserError(f"pose file {path}: {key}: wanted one positive number, got other values; repair the file")
    return float(values.item())


def _metres_per_unit(arrays: PoseSet, path: Path) -> float:
    """Return the factor of the translation: as declared, 1 / scaling for AIST++, 1 for other files."""
    for role, power in (("metres_per_unit", 1), ("scaling", -1)):
        if role in arrays.found:
            key, value = arrays.found[role]
            return _positive(value, key, path) ** power
    return 1.0
