"""Export a motion as BVH, the format for motions without a mesh.

BVH has no orientation at rest: with all angles zero, the axes of every joint are those of the world. So a joint with the world
orientations R_0 at rest and R(t) in motion gets the world rotation R(t) inv(R_0), and its OFFSET is the difference of the rest
positions in the world. This moves every joint as before.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.checks import check_choice, check_positive
from snarfcli.export.bvh_angles import ORDERS
from snarfcli.export.bvh_write import BvhMotion, write_bvh
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.export import check_output
from snarfcli.motions import Motion
from snarfcli.motions.joint_names import find_body_parts
from snarfcli.motions.up_axis import y_from_up
from snarfcli.names import unique_names
from snarfcli.texts import counted

__all__ = ["BVH_ORDERS", "UNITS", "BvhOptions", "BvhReport", "bvh_motion", "export_bvh"]

log = logging.getLogger(__name__)

UNITS = {"cm": 100.0, "m": 1.0, "mm": 1000.0}
"""Names of units, and how many of them are a metre."""
BVH_ORDERS = ("auto", *ORDERS)
"""Choices for the order of rotations."""

_STILL = 1e-5  # share of the size of the skeleton by which a joint may leave its OFFSET without position channels
_RIGID = 1e-4  # largest scale or shear that counts as rounding
_BREAK = re.compile(r"[{}\s]+")


@dataclass(frozen=True)
class BvhOptions:
    """How a motion is written."""

    units_per_metre: float = UNITS["cm"]
    """Units of length in the file per unit of the skeleton, which is a metre for the skeletons of avatars."""
    up: str = "y"
    """Up axis of the file, y or z."""
    skeleton_up: str = "y"
    """Up axis of the skeleton and the motion."""
    order: str = "auto"
    """Order of rotations of every joint, such as ZXY; `auto` takes ZXY, and another order for joints near gimbal lock."""
    end_sites: bool = True
    """Whether joints without children get an End Site, as the format asks for; without, only joints that were End Sites do."""
    root_offset: bool = False
    """Whether the OFFSET of a root is its position at rest; otherwise zero, for which all readers agree on its position."""


@dataclass(frozen=True)
class BvhReport:
    """Facts about a BVH file."""

    path: Path
    num_bytes: int
    name: str
    frames: int
    frame_rate: float
    joints: int
    sliding: tuple[str, ...]
    """Joints, other than roots, with position channels: their place relative to the parent is not always that at rest."""
    resized: tuple[str, ...]
    """Joints whose scale or shear changes, which BVH cannot express and was left out."""

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        seconds = (self.frames - 1) / self.frame_rate
        joints, frames = counted(self.joints, "joint"), counted(self.frames, "frame")
        return [
            f"{self.path}: {joints}, {frames}, {seconds:.2f} s at {self.frame_rate:g} per second, {self.num_bytes / 1e6:.2f} MB"
        ]


def export_bvh(
    path: str | Path,
    motion: Motion | Clip,
    skeleton: Skeleton,
    options: BvhOptions | None = None,
    *,
    overwrite: bool = False,
) -> BvhReport:
    """Write a motion as BVH, like `snarf export format=bvh`. The file is whole or absent.

    Any motion that `read_motion` reads for the skeleton can be written, and the motion of a BVH or glTF file on the file's own
    skeleton, see `rig_clip`. Joint positions and rotations read from the file are those of the motion up to rounding: 1e-6
    degrees and 1e-6 units.

    Args:
        path: the file.
        motion: poses of the skeleton; a `Clip` has bone transforms for joints that stretch.
        skeleton: its names are written, and its rest pose has all angles zero. For other names see `named_joints`.
        options: unit, axes and order of rotations; centimetres and y up by default.
        overwrite: whether an existing file is replaced.

    Returns:
        Facts about the file, with the joints that needed position channels, and those whose scale was left out.

    Raises:
        UserError: an option is unknown, or the file exists.
        ValueError: the motion is of another number of joints.
    """
    options = BvhOptions() if options is None else options
    check_positive("units_per_metre", options.units_per_metre)
    check_choice("order", options.order, BVH_ORDERS)
    for name in ("up", "skeleton_up"):
        check_choice(name, getattr(options, name), ("y", "z"))
    path = Path(path)
    check_output(path, overwrite)
    clip = motion if isinstance(motion, Clip) else Clip(motion)
    content, resized = bvh_motion(clip, skeleton, options)
    sliding = tuple(content.names[joint] for joint in content.positions if content.parents[joint] >= 0)
    if resized:
        log.warning("%s: BVH has no scale; that of %s was left out, positions are kept", path.name, _listed(resized))
    if sliding:
        log.info("%s: joints that move relative to their parents have position channels: %s", path.name, _listed(sliding))
    size = write_bvh(path, content, order=options.order)
    rate = content.frame_rate
    return BvhReport(path, size, clip.motion.name, len(content.rotations), rate, len(content.names), sliding, resized)


def bvh_motion(clip: Clip, skeleton: Skeleton, options: BvhOptions) -> tuple[BvhMotion, tuple[str, ...]]:
    """Return the content of a BVH file, and the names of joints whose scale or shear is left out."""
    skeleton = skeleton.to(dtype=torch.float64, device="cpu")
    rest, parents = skeleton.joints_rest.numpy(), skeleton.parents
    rotations, places, resized = _world(clip, skeleton)
    offsets, local, positions = rest.copy(), rotations.copy(), places.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            inverse = rotations[:, parent].transpose(0, 2, 1)
            offsets[joint] = rest[joint] - rest[parent]
            local[:, joint] = inverse @ rotations[:, joint]
            positions[:, joint] = np.einsum("tab,tb->ta", inverse, places[:, joint] - places[:, parent])
    turn = _turn(options)
    offsets, positions = (options.units_per_metre * part @ turn.T for part in (offsets, positions))
    local = turn @ local @ turn.T
    still = _STILL * max(float(np.ptp(rest, axis=0).max()), 1e-30) * options.units_per_metre
    slides = np.abs(positions - offsets).max((0, 2)) > still
    kept, ends = _end_sites(skeleton, offsets, local, slides, turn[:, 1], options.end_sites)
    number = {joint: at for at, joint in enumerate(kept)}
    names = _clean_names(skeleton.names)
    moving = [joint for joint in kept if parents[joint] < 0 or slides[joint]]
    if not options.root_offset:
        offsets[[joint for joint, parent in enumerate(parents) if parent < 0]] = 0
    content = BvhMotion(
        names=tuple(names[joint] for joint in kept),
        parents=tuple(number.get(parents[joint], -1) for joint in kept),
        offsets=offsets[kept],
        ends=tuple((number[joint], offset) for joint, offset in ends),
        rotations=local[:, kept],
        positions={number[joint]: positions[:, joint] for joint in moving},
        frame_rate=clip.motion.frame_rate,
    )
    return content, tuple(names[joint] for joint in kept if resized[joint])


def _world(clip: Clip, skeleton: Skeleton) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return world rotations [T, J, 3, 3] relative to the rest pose, joint positions [T, J, 3], and which joints [J] resize."""
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0].numpy()
    moved = clip_transforms(skeleton, clip) @ canonical_from_rest
    linear = moved[..., :3, :3]
    places = np.einsum("tjab,jb->tja", linear, skeleton.joints_rest.numpy()) + moved[..., :3, 3]
    resized = np.abs(linear.swapaxes(-1, -2) @ linear - np.eye(3)).max((0, 2, 3)) > _RIGID
    return nearest_rotation(torch.from_numpy(linear)).numpy(), places, resized


def _turn(options: BvhOptions) -> NDArray[np.float64]:
    """Return the rotation [3, 3] of the world from the axes of the skeleton to those of the file."""
    if options.up == options.skeleton_up:
        return np.eye(3)
    turn = np.rint(y_from_up("z").as_matrix())
    return turn if options.up == "y" else turn.T


def _end_sites(
    skeleton: Skeleton,
    offsets: NDArray[np.float64],
    local: NDArray[np.float64],
    slides: NDArray[np.bool_],
    up: NDArray[np.float64],
    for_all: bool,
) -> tuple[list[int], list[tuple[int, NDArray[np.float64]]]]:
    """Return the joints that are written as joints, and the End Sites: joint and offset [3].

    A joint without children that never moves and is named after its parent, NAME_end, was an End Site when it was read. Other
    joints without children get one that continues the bone; under toes it is level.
    """
    parents, names = skeleton.parents, skeleton.names
    leaves = set(range(len(parents))) - set(parents)
    still = np.abs(local - np.eye(3)).max((0, 2, 3)) < 1e-9
    were = {
        joint
        for joint in leaves
        if parents[joint] >= 0
        and still[joint]
        and not slides[joint]
        and re.fullmatch(re.escape(names[parents[joint]]) + r"_end(_\d+)?", names[joint])
    }
    ends = [(parents[joint], offsets[joint]) for joint in sorted(were)]
    if for_all:
        parts = find_body_parts(names, parents).joints
        toes = {parts[name] for name in ("l_foot", "r_foot") if name in parts}
        for joint in sorted(leaves - were):
            length = np.linalg.norm(offsets[joint])
            along = offsets[joint] - (offsets[joint] @ up) * up if joint in toes else offsets[joint]
            reach = np.linalg.norm(along)
            if parents[joint] >= 0 and length > 0:
                ends.append((joint, along * length / reach if reach > 0.1 * length else offsets[joint]))
            else:
                ends.append((joint, np.zeros(3)))
    return [joint for joint in range(len(parents)) if joint not in were], ends


def _clean_names(names: tuple[str, ...]) -> list[str]:
    """Return unique names without braces and line breaks; inner spaces stay single spaces, as 3ds Max writes them."""
    clean = [" ".join(_BREAK.sub(" ", name).split()) or f"joint_{joint}" for joint, name in enumerate(names)]
    return unique_names(clean)


def _listed(names: tuple[str, ...]) -> str:
    """Return the first names as text."""
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
