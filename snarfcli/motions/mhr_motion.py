"""Make a motion of the joints of MHR that SAM 3D Body writes."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.formats.mhr import MHR_JOINTS, mhr_rig
from snarfcli.motions.arrays import frame_rate_of, place_of
from snarfcli.motions.pose_parts import numbers
from snarfcli.motions.pose_sets import PoseSet
from snarfcli.motions.retarget import Retargeted, retarget_rig
from snarfcli.motions.up_axis import Up

__all__ = ["retarget_mhr"]

log = logging.getLogger(__name__)


def retarget_mhr(
    arrays: PoseSet,
    skeleton: Skeleton,
    path: Path,
    *,
    name: str,
    up: Up,
    rest: str,
    mapping: str | Path | Mapping[str, str | None] | None,
) -> Retargeted:
    """Return the motion of a person that SAM 3D Body saw: MHR's joints, retargeted as those of a rig.

    Args:
        arrays: `pred_global_rots` [T, 127, 3, 3], `pred_joint_coords` [T, 127, 3] and optionally `pred_cam_t` [T, 3], or
            without the axis of frames.
        skeleton: the target.
        path: the file, for messages.
        name: name of the motion.
        up: up axis of the file; `auto`: that along which the body stands, y down in the frame of the camera.
        rest: see `read_motion`.
        mapping: see `map_joints`.

    Raises:
        UserError: an array has another shape, the arrays do not belong together, or the joints cannot be paired.
    """
    (key, rotations), (other, positions) = arrays.found["mhr_rotations"], arrays.found["mhr_positions"]
    turns, places = numbers(rotations, key, path), numbers(positions, other, path)
    frames = len(turns) if turns.ndim == 4 else 1
    for values, label, last in ((turns, key, (MHR_JOINTS, 3, 3)), (places, other, (MHR_JOINTS, 3))):
        if values.size != frames * np.prod(last) or values.shape[-len(last) :] != last or not frames:
            wanted = ", ".join(map(str, last))
            raise UserError(
                f"pose file {path}: {label}: wanted shape [frames, {wanted}], got {list(values.shape)}; repair the file"
            )
    turns, places = turns.reshape(frames, MHR_JOINTS, 3, 3), places.reshape(frames, MHR_JOINTS, 3)
    place = place_of(arrays, frames, path)
    if place is not None:
        places = places + place[:, None]
    try:
        rig, is_camera = mhr_rig(turns, places, frame_rate_of(arrays, path), name)
    except ValueError as error:
        raise UserError(f"pose file {path}: {key}: {error}; repair the file") from None
    if up == "auto":
        # In files of which rotations and positions are in one frame, only the body tells which that is.
        is_camera = is_camera or _standing(rig.names, rig.clips[0].world_from_joint[..., 1, 3]) < 0
        up = "-y" if is_camera else "y"
        if is_camera:
            log.info("%s: y points down, as in the frame of a camera, and was turned up; up=y keeps it", path.name)
    return retarget_rig(rig, rig.clips[0], skeleton, path=path, name=name, up=up, rest=rest, mapping=mapping)


def _standing(names: tuple[str, ...], heights: np.ndarray) -> float:
    """Return how far the head is above the feet along y, on average over the frames."""
    head, left, right = (names.index(name) for name in ("c_head", "l_foot", "r_foot"))
    return float((heights[:, head] - (heights[:, left] + heights[:, right]) / 2).mean())
