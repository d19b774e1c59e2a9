"""Reading AMASS-style pose files."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.errors import UserError
from snarfcli.files import read_npz
from snarfcli.motions.motion import Motion

__all__ = ["read_motion"]

log = logging.getLogger(__name__)

Up = Literal["auto", "y", "z"]

_DEFAULT_FRAME_RATE = 60.0
_FRAME_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")
# Root and 21 body joints come first in SMPL-H's 156 and SMPL-X's 165 values; SMPL's two hand joints are not among them.
_BODY_VALUES = 66
_LONG_WIDTHS = {156: "SMPL-H", 165: "SMPL-X"}
_SMPL_JOINTS = 24
# Where SMPL's bodies, and the built-in one, have their pelvis. The root turns about it, so a turn of the world moves it.
_PELVIS_REST = np.array([0.0, -0.22, 0.03])


def read_motion(path: str | Path, num_joints: int = _SMPL_JOINTS, *, up: Up = "auto") -> Motion:
    """Read the poses, the translation and the frame rate of an AMASS-style `.npz` file.

    Args:
        path: file with `poses` (T, 72), (T, 156) of SMPL-H or (T, 165) of SMPL-X, axis-angle, radians, global orientation
            first; of the last two the 22 body joints are taken and the hands are left straight. Optional: `trans` (T, 3)
            metres, and `mocap_framerate` or `mocap_frame_rate`. Everything else, gender too, is not looked at.
        num_joints: joints of the skeleton to be posed; 3 values a joint are read as they are.
        up: which way is up in the file. `auto`: z for 156 and 165 values, as in AMASS; y for 72 without a translation; for 72
            with one, the axis along which the body stands.

    Returns:
        The motion in a world with y up, facing as in the file.

    Raises:
        UserError: the file is missing, truncated, not a zip, holds pickled objects; it has no poses, no frame, a wrong
            number of values, values that are not finite numbers, a translation or frame rate that does not fit.
        ValueError: `up` is none of the three.
    """
    if up not in ("auto", "y", "z"):
        raise ValueError(f"up: wanted 'auto', 'y' or 'z', got {up!r}")
    path = Path(path)
    arrays = read_npz(path, "pose file")
    if "poses" not in arrays:
        found = ", ".join(sorted(arrays)) or "nothing"
        raise UserError(f"pose file {path} has no 'poses'; it holds {found}; give an AMASS-style .npz file")
    values = _numbers(arrays["poses"], "poses", path)
    if values.ndim == 3 and values.shape[2] == 3:
        values = values.reshape(len(values), 3 * values.shape[1])
    if values.ndim == 1 and len(values):
        values = values[None]
    if values.ndim != 2:
        raise UserError(f"pose file {path}: poses has shape {list(values.shape)}, wanted [frames, values]")
    frames, width = values.shape
    if frames == 0:
        raise UserError(f"pose file {path} has zero frames; give a file with at least one")
    if width == 3 * num_joints:
        poses = values
    elif num_joints == _SMPL_JOINTS and width in _LONG_WIDTHS:
        poses = np.zeros((frames, 3 * num_joints))
        poses[:, :_BODY_VALUES] = values[:, :_BODY_VALUES]
    else:
        wanted = f"{3 * num_joints}"
        if num_joints == _SMPL_JOINTS:
            wanted += " (SMPL), " + " or ".join(f"{w} ({name})" for w, name in _LONG_WIDTHS.items())
        raise UserError(f"pose file {path} has {width} values a frame, wanted {wanted}")
    poses = poses.reshape(frames, num_joints, 3).copy()
    translation = np.zeros((frames, 3))
    if "trans" in arrays:
        translation = np.atleast_2d(_numbers(arrays["trans"], "trans", path))
        if translation.shape != (frames, 3):
            raise UserError(f"pose file {path}: trans has shape {list(translation.shape)}, wanted [{frames}, 3]")
    if up == "auto":
        up = _up_axis(poses, width, "trans" in arrays)
        if up == "z":
            log.info("%s: z is up in this file and was turned to y", path.name)
    if up == "z":
        poses, translation = _y_up_from_z_up(poses, translation)
    return Motion(path.stem, poses, translation, _frame_rate(arrays, path))


def _numbers(array: NDArray, name: str, path: Path) -> NDArray[np.float64]:
    if array.dtype.kind not in "fiu":
        raise UserError(f"pose file {path}: {name} holds {array.dtype}, wanted numbers")
    broken = ~np.isfinite(array)
    if broken.any():
        frame = int(np.argwhere(broken)[0][0]) if array.ndim > 1 else 0
        raise UserError(f"pose file {path}: {name} holds NaN or infinity, first in frame {frame}; repair or cut the file")
    return array.astype(np.float64)


def _frame_rate(arrays: dict[str, NDArray], path: Path) -> float:
    key = next((key for key in _FRAME_RATE_KEYS if key in arrays), None)
    if key is None:
        log.info("%s: no frame rate given, %g frames a second assumed", path.name, _DEFAULT_FRAME_RATE)
        return _DEFAULT_FRAME_RATE
    value = arrays[key]
    if value.dtype.kind not in "fiu" or value.size != 1 or not np.isfinite(value).all() or not value.item() > 0:
        raise UserError(f"pose file {path}: {key} must be one positive number")
    return float(value.item())


def _up_axis(poses: NDArray[np.float64], width: int, has_translation: bool) -> Up:
    if width in _LONG_WIDTHS:
        return "z"
    if not has_translation:
        return "y"
    spine = Rotation.from_rotvec(poses[:, 0]).apply([0.0, 1.0, 0.0]).mean(0)
    return "z" if abs(spine[2]) > abs(spine[1]) else "y"


def _y_up_from_z_up(
    poses: NDArray[np.float64], translation: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn the world by -90 degrees about x, so that z becomes y."""
    turn = Rotation.from_euler("x", -90, degrees=True)
    poses = poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, turn.apply(translation + _PELVIS_REST) - _PELVIS_REST
