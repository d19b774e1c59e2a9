"""Read BVH files: a tree of joints written in words and braces, then one line of numbers per frame."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.errors import UserError
from snarfcli.formats.bvh_hierarchy import BvhJoint, BvhLines, read_hierarchy, read_number, shown
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.names import unique_names

__all__ = ["read_bvh"]

log = logging.getLogger(__name__)

_DEFAULT_FRAME_RATE = 60.0
# World transforms take 128 bytes per joint and frame: 256 MiB for ten minutes of 30 joints at 120 frames per second.
_MAX_JOINT_FRAMES = 2**21
_FRAMES = re.compile(r"frames\s*:?\s*(\S*)", re.IGNORECASE)
_NO_POSITIONS = 0.05  # positions of joints that are all smaller than this share of the OFFSETs are relative to them
_OTHER_SIZE = 1.25  # a bone whose lengths at rest and in motion differ by this factor
_TRAVELS = 0.3  # share of its length by which a position may change, if it is that of a bone
_FRAME_TIME = re.compile(r"frame\s*time\s*:?\s*(\S*)", re.IGNORECASE)


def read_bvh(path: str | Path) -> Rig:
    """Read the joints and the motion of a BVH file.

    The reader accepts any names, white space, line ends and letter case. Channels may come in any order, and any joint may have
    position channels; a position replaces the joint's OFFSET, unless all are near zero, which means that they are added to it.
    Bones whose length is in the positions only, or in other units there, have the median position at rest; a log line says so.
    An End Site becomes a joint `<parent>_end` that never rotates; it gives the direction of the last bone. Names that occur
    twice get a number. A missing frame time, or 0, means 60 frames per second. All complete frames are read, even if the
    declared number differs; an incomplete last frame is left out.

    Args:
        path: the file.

    Returns:
        The joints at rest (all angles zero), and one clip named after the file, or none if there are no frames. Units and axes
        of the file, usually centimetres or inches and y up.

    Raises:
        UserError: the file is missing, is not a BVH file, or is damaged; the message names the line.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"BVH file {path} is a folder; name a .bvh file")
    if not path.is_file():
        raise UserError(f"no BVH file at {path}; give the path of one")
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = BvhLines(file, path)
            joints = read_hierarchy(lines)
            values, frame_rate = _read_motion(lines, joints)
            _reconcile_positions(joints, values, path)
    except OSError as error:
        raise UserError(f"BVH file {path} cannot be read ({error.strerror or error})") from None
    with np.errstate(over="ignore", invalid="ignore"):
        rest = _rest_transforms(joints)
        clips = (RigClip(path.stem, frame_rate, _world_from_joint(joints, values)),) if len(values) else ()
        is_sane = all(np.isfinite(world[..., 3].sum()) for world in (rest, *(clip.world_from_joint for clip in clips)))
    if not is_sane:
        raise UserError(f"BVH file {path} has numbers too large to add up; export or download it again")
    return Rig(tuple(unique_names(joint.name for joint in joints)), tuple(joint.parent for joint in joints), rest, clips)


def _read_motion(lines: BvhLines, joints: list[BvhJoint]) -> tuple[NDArray[np.float64], float]:
    """Read the values of all frames [T, channels] and the frame rate. A frame may span several lines."""
    width = sum(len(joint.channels) for joint in joints)
    max_frames = _MAX_JOINT_FRAMES // len(joints)
    frame_rate, declared = 0.0, ""
    rows: list[NDArray[np.float64]] = []
    row: list[float] = []
    for line in lines:
        text = line.strip()
        if not text:
            continue
        if match := _FRAME_TIME.match(text):
            frame_rate = _read_frame_rate(lines, match[1])
            continue
        if match := _FRAMES.match(text):
            declared = match[1]
            continue
        words = text.split()
        try:
            values = list(map(float, words))
        except ValueError:
            values = [read_number(lines, word) for word in words]
        if not math.isfinite(sum(values)):
            raise lines.error(f"frame {len(rows)} has NaN, infinity or far too large numbers")
        row += values
        if len(row) > width:
            raise lines.error(f"frame {len(rows)}: wanted {width} values, one per channel, got {len(row)}")
        if len(row) == width:
            if len(rows) == max_frames:
                raise lines.error(
                    f"wanted at most {max_frames} frames of {len(joints)} joints, got more; cut the file into parts first"
                )
            rows.append(np.array(row))
            row = []
    if row:
        log.info("%s: the last frame is incomplete and was left out", lines.path.name)
    if declared and declared != str(len(rows)):
        log.info("%s: %s frames are declared, %d were found", lines.path.name, shown(declared), len(rows))
    if not frame_rate:
        frame_rate = _DEFAULT_FRAME_RATE
        if rows:
            log.info("%s: no frame time given, %g frames per second assumed", lines.path.name, frame_rate)
    return np.array(rows).reshape(len(rows), width), frame_rate


def _read_frame_rate(lines: BvhLines, word: str) -> float:
    """Return the frames per second from a frame time in seconds; 0 for a frame time of 0."""
    seconds = read_number(lines, word)
    if seconds == 0:
        return 0.0
    if not 1e-6 <= seconds <= 1e6:
        raise lines.error(f"wanted a frame time in seconds, got {shown(word)}")
    # Files round the frame time: 120 frames per second are written as 0.008333 or 0.0083333.
    rate = 1 / seconds
    return float(round(rate)) if abs(rate - round(rate)) < 2e-4 * rate and rate >= 1 else rate


def _reconcile_positions(joints: list[BvhJoint], values: NDArray[np.float64], path: Path) -> None:
    """Make OFFSETs and position channels of the bones agree, in place, if lengths are in one of them only, or in other units.

    Joints that only place the body, such as hips below a root on the floor, have no bone above and keep their OFFSETs: those
    down to the first joint with several children, and those that travel.

    Args:
        joints: J joints.
        values: [T, channels], values of all channels, units of the file.
        path: the file, for messages.
    """
    columns: dict[int, list[int]] = {}  # of the x, y and z position per joint that has all three
    start = 0
    for index, joint in enumerate(joints):
        places = [start + joint.channels.index((axis, "position")) for axis in "xyz" if (axis, "position") in joint.channels]
        if len(places) == 3 and joint.parent >= 0:
            columns[index] = places
        start += len(joint.channels)
    if not columns or not len(values):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        placed = values[:, list(columns.values())]
        medians = np.median(placed, axis=0)
        posed = np.linalg.norm(medians, axis=1)
        sizes = np.array([np.linalg.norm(joints[index].offset) for index in columns])
        if posed.sum() < _NO_POSITIONS * sizes.sum():
            log.info(
                "%s: the positions of joints are near zero and were added to their OFFSETs; write whole positions otherwise",
                path.name,
            )
            for index, places in columns.items():
                values[:, places] += joints[index].offset
            return
        places_body = _above_the_branches(joints)
        is_bone = np.abs(placed - medians).max((0, 2)) <= _TRAVELS * np.maximum(posed, sizes)
        is_bone &= np.array([index not in places_body for index in columns])
        is_other = is_bone & ((sizes == 0) | (posed > _OTHER_SIZE * sizes) | (sizes > _OTHER_SIZE * posed))
        told = is_other & (sizes > 0)
        ratio = posed[told].sum() / sizes[told].sum() if told.any() else 1.0  # of the units of positions and OFFSETs
    if not is_other.any():
        return
    log.info("%s: OFFSETs do not fit the position channels, so the rest pose has the median positions", path.name)
    for index, joint in enumerate(joints):
        if joint.parent >= 0 and index not in columns:
            joint.offset = ratio * joint.offset
    for index, median, other in zip(columns, medians, is_other, strict=True):
        if other:
            joints[index].offset = median


def _above_the_branches(joints: list[BvhJoint]) -> set[int]:
    """Return the joints from the first root down to the first joint with several children; none in a chain without branches."""
    children: list[list[int]] = [[] for _ in joints]
    for index, joint in enumerate(joints):
        if joint.parent >= 0:
            children[joint.parent].append(index)
    chain = [0]
    while len(children[chain[-1]]) == 1:
        chain += children[chain[-1]]
    return {*chain} if children[chain[-1]] else set()


def _rest_transforms(joints: list[BvhJoint]) -> NDArray[np.float64]:
    """Return the transforms [J, 4, 4] from the frame of each joint to the world, all angles zero."""
    rest = np.tile(np.eye(4), (len(joints), 1, 1))
    for index, joint in enumerate(joints):
        rest[index, :3, 3] = joint.offset + (rest[joint.parent, :3, 3] if joint.parent >= 0 else 0)
    return rest


def _world_from_joint(joints: list[BvhJoint], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transforms [T, J, 4, 4] from the frame of each joint to the world.

    Args:
        joints: J joints, each after its parent.
        values: [T, channels], values of all channels, degrees and units of the file.
    """
    world = np.zeros((len(values), len(joints), 4, 4))
    world[..., 3, 3] = 1
    column = 0
    for index, joint in enumerate(joints):
        offset = np.broadcast_to(joint.offset, (len(values), 3)).copy()
        order, angles = "", []
        for axis, kind in joint.channels:
            if kind == "position":
                offset[:, "xyz".index(axis)] = values[:, column]
            else:
                order += axis.upper()  # capitals mean intrinsic rotations: about axes rotated by those before
                angles.append(values[:, column])
            column += 1
        local = Rotation.from_euler(order, np.stack(angles, 1), degrees=True).as_matrix() if order else np.eye(3)
        if joint.parent < 0:
            world[:, index, :3, :3] = local
            world[:, index, :3, 3] = offset
        else:
            parent = world[:, joint.parent, :3]
            world[:, index, :3, :3] = parent[..., :3] @ local
            world[:, index, :3, 3] = (parent[..., :3] @ offset[..., None])[..., 0] + parent[..., 3]
    return world
