"""Read skeletons and poses that users write: `skeleton.json`, `skeleton.npz`, `poses.json`, `poses.npz`.

A skeleton file is a JSON object, or an `.npz` with arrays of the same names:

    parents         [J]     index of the parent of each joint, -1 or null for a root; in JSON a name is accepted; any order
    joints_rest     [J, 3]  joint positions in the rest pose, units and axes of the meshes
    names           [J]     optional; names of left and right joints should start with l_ and r_
    canonical_pose  [J, 3]  optional: pose in which the avatar is learned, axis-angle relative to the rest pose, radians
    up              y or z  optional: up axis
    scale           number  optional: metres per unit

A pose file has the same form, with one of the first two entries:

    poses            [T, J, 3]     rotation of each joint relative to its parent, axis-angle, radians, world axes at rest
    bone_transforms  [T, J, 4, 4]  transforms from the rest pose to the posed frame of each joint; column vectors
    trans            [T, 3]        with poses, optional: offset of the first root from its rest position
    frame_rate       number        optional: frames per second, 30 if not given
    trusted          [T]           optional: whether each pose can be trusted; others are left out (`snarf fit` writes this)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies.skeleton import MAX_JOINTS
from snarfcli.datasets.named_values import NamedValues
from snarfcli.motions.angles import angle_problem

__all__ = ["DEFAULT_FRAME_RATE", "PoseFile", "SkeletonFile", "read_poses", "read_skeleton"]

DEFAULT_FRAME_RATE = 30.0
"""Frames per second of pose files without a frame rate."""

_FULL_TURN = 2 * np.pi  # radians; no joint is turned further in one pose
_ALIASES = {
    "names": ("names", "joint_names"),
    "parents": ("parents",),
    "joints_rest": ("joints_rest", "rest_joints", "joints"),
    "canonical_pose": ("canonical_pose",),
    "up": ("up",),
    "scale": ("scale",),
    "poses": ("poses", "pose"),
    "bone_transforms": ("bone_transforms",),
    "trans": ("trans", "translation"),
    "trusted": ("trusted",),
    "frame_rate": ("frame_rate", "mocap_framerate", "mocap_frame_rate", "fps"),
}


@dataclass(frozen=True, eq=False)
class SkeletonFile:
    """A skeleton in the units and axes of its file; each joint comes after its parent."""

    names: tuple[str, ...]
    """J unique joint names."""
    parents: tuple[int, ...]
    """J parents, -1 for a root."""
    joints_rest: NDArray[np.float64]
    """[J, 3], joint positions in the rest pose."""
    order: NDArray[np.int64]
    """[J], index of each joint in the file; poses are reordered by it."""
    canonical_pose: NDArray[np.float64] | None = None
    """[J, 3], axis-angle relative to the rest pose, radians; None if the file has none."""
    up: str | None = None
    """Up axis, y or z; None if the file has none."""
    scale: float | None = None
    """Metres per unit; None if the file has none."""
    idle: tuple[int, ...] = ()
    """Joints that move no part of the mesh, as far as the file says so."""


@dataclass(frozen=True, eq=False)
class PoseFile:
    """Motion of a skeleton in the units and axes of its file: either poses and translation, or bone transforms."""

    frame_rate: float
    """Frames per second."""
    poses: NDArray[np.float64] | None = None
    """[T, J, 3], axis-angle, radians."""
    translation: NDArray[np.float64] | None = None
    """[T, 3], units of the file."""
    posed_from_rest: NDArray[np.float64] | None = None
    """[T, J, 4, 4], bone transforms, units of the file."""
    is_trusted: NDArray[np.bool_] | None = None
    """[T]; None if the file trusts all."""

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        frames = self.poses if self.poses is not None else self.posed_from_rest
        if frames is None:
            raise ValueError("poses, posed_from_rest: wanted one of them, got none")
        return len(frames)


def read_skeleton(path: str | Path) -> SkeletonFile:
    """Read a skeleton file; the joints are sorted so that each comes after its parent.

    Raises:
        UserError: the file is missing or damaged, an entry is missing or has a wrong shape, or the joints do not form a tree.
    """
    content = NamedValues(path, "skeleton file", _ALIASES)
    parents = content.get("parents")
    if parents is None or content.get("joints_rest") is None:
        missing = "parents" if parents is None else "joints_rest"
        content.fail(f"has no {missing}; wanted names, parents and joints_rest, see data/README.md")
    parents = parents.tolist() if isinstance(parents, np.ndarray) and parents.ndim == 1 else parents
    if not isinstance(parents, list) or not 0 < len(parents) <= MAX_JOINTS:
        content.fail(f"parents: wanted a list of 1 to {MAX_JOINTS} joints, got another value; repair it")
    count = len(parents)
    names = _names(content, count)
    numbers = [_parent(content, parent, names) for parent in parents]
    order = _parents_first(content, numbers)
    place = {joint: number for number, joint in enumerate(order)}
    chosen = np.array(order)
    canonical = None
    if content.get("canonical_pose") is not None:
        canonical = content.numbers("canonical_pose", (count, 3))[chosen]
        largest = np.linalg.norm(canonical, axis=1).max()
        if largest > _FULL_TURN:
            content.fail(f"canonical_pose: wanted angles in radians, got {largest:.5g}; save them in radians")
    up = content.text("up")
    if up not in (None, "y", "z"):
        content.fail(f"up: wanted y or z, got {up!r:.40}; repair it")
    return SkeletonFile(
        tuple(names[joint] for joint in order),
        tuple(place[numbers[joint]] if numbers[joint] >= 0 else -1 for joint in order),
        content.numbers("joints_rest", (count, 3))[chosen],
        chosen,
        canonical,
        up,
        content.positive("scale"),
    )


def read_poses(path: str | Path, order: NDArray[np.int64]) -> PoseFile:
    """Read a pose file, and put the joints in the order of a skeleton (see `SkeletonFile.order`).

    Raises:
        UserError: the file is missing or damaged, or has neither poses nor bone transforms of this number of joints.
    """
    content = NamedValues(path, "pose file", _ALIASES)
    count = len(order)
    frame_rate = content.positive("frame_rate") or DEFAULT_FRAME_RATE
    if content.get("bone_transforms") is not None:
        transforms = content.numbers("bone_transforms", (None, count, 4, 4))
        if not len(transforms):
            content.fail("wanted at least 1 frame, got 0; give another file")
        if np.abs(transforms[..., 3, :] - (0, 0, 0, 1)).max() > 1e-4:
            content.fail("bone_transforms: wanted last rows 0 0 0 1, got others; transpose them if they are for row vectors")
        is_trusted = content.flags("trusted", len(transforms))
        return PoseFile(frame_rate, posed_from_rest=transforms[:, order], is_trusted=is_trusted)
    if content.get("poses") is None:
        content.fail("has neither poses nor bone_transforms; see data/README.md")
    poses = content.numbers("poses", (None, count, 3))
    if not len(poses):
        content.fail("wanted at least 1 frame, got 0; give another file")
    problem = angle_problem(poses)
    if problem:
        content.fail(f"poses: {problem}")
    translation = np.zeros((len(poses), 3))
    if content.get("trans") is not None:
        translation = content.numbers("trans", (None, 3))
        if len(translation) != len(poses):
            content.fail(f"trans: wanted {len(poses)} rows, one per pose, got {len(translation)}; repair it")
    return PoseFile(frame_rate, poses[:, order], translation, is_trusted=content.flags("trusted", len(poses)))


def _names(content: NamedValues, count: int) -> list[str]:
    """Return the names of the joints; `joint_N` if the file has none."""
    names = content.get("names")
    if names is None:
        return [f"joint_{joint}" for joint in range(count)]
    if isinstance(names, np.ndarray):
        names = names.tolist() if names.dtype.kind in "US" and names.ndim == 1 else None
    if not isinstance(names, list) or len(names) != count:
        content.fail(f"names: wanted {count} texts, one per entry of parents, got other values; repair it")
    texts = [name.decode("latin1") if isinstance(name, bytes) else name for name in names]
    for name in texts:
        if not isinstance(name, str) or not 0 < len(name) <= 100 or not name.isprintable():
            content.fail(f"names: wanted texts of 1 to 100 letters, got {name!r:.40}; repair it")
    twice = next((name for name in texts if texts.count(name) > 1), None)
    if twice is not None:
        content.fail(f"names: wanted each name once, got {twice!r:.60} twice; rename one joint")
    return texts


def _parent(content: NamedValues, parent: Any, names: list[str]) -> int:
    """Return the index of a parent that is given by index or by name; -1 for a root."""
    if parent is None:
        return -1
    if isinstance(parent, str) and parent in names:
        return names.index(parent)
    if isinstance(parent, float) and parent.is_integer():
        parent = int(parent)
    if type(parent) is not int or not (
        -1 <= parent < len(names) or parent == 2**32 - 1
    ):  # SMPL stores -1 as an unsigned number
        content.fail(
            f"parents: wanted names, numbers from 0 to {len(names) - 1}, or -1 for a root, got {parent!r:.40}; repair it"
        )
    return parent if parent < len(names) else -1


def _parents_first(content: NamedValues, parents: list[int]) -> list[int]:
    """Return the joints sorted so that each comes after its parent, otherwise in the order of the file."""
    order: list[int] = []
    left = list(range(len(parents)))
    placed = {-1}
    while left:
        later = []
        for joint in left:
            if parents[joint] in placed:
                order.append(joint)
                placed.add(joint)
            else:
                later.append(joint)
        if len(later) == len(left):
            content.fail("its parents form a circle; make at least one joint a root (-1)")
        left = later
    return order
