"""Skeletons and poses as a user writes them down: `skeleton.json`, `skeleton.npz`, `poses.json`, `poses.npz`.

A skeleton file is a JSON object, or an `.npz` with arrays of the same names:

    parents         [J]     number of each joint's parent, -1 or null for a root; in JSON a name will do. Any order.
    joints_rest     [J, 3]  where the joints are in the rest pose, in the units and axes of the meshes
    names           [J]     optional; those of left and right joints best start with l_ and r_
    canonical_pose  [J, 3]  optional: pose in which the avatar is learned, axis-angle relative to the rest pose, radians
    up              y or z  optional: which way is up
    scale           number  optional: metres a unit

A pose file has the same form; one of the first two says how the joints move:

    poses            [T, J, 3]     turn of each joint relative to its parent, axis-angle, radians, axes of the rest pose's world
    bone_transforms  [T, J, 4, 4]  what moves a point of the rest pose with each joint; column vectors
    trans            [T, 3]        with poses, optional: the first root stands at its rest position plus this
    frame_rate       number        optional: frames a second, 30 if not given
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.files import read_npz

__all__ = ["DEFAULT_FRAME_RATE", "PoseFile", "SkeletonFile", "read_poses", "read_skeleton"]

DEFAULT_FRAME_RATE = 30.0
"""Of poses that come without one, frames a second."""

_MOST_JOINTS = 1000  # SMPL-X has 55, a character with fingers and face some 200; each one costs weights everywhere
_MOST_JSON_BYTES = 2**25  # 32 MiB: parsed they take some 600; an hour of poses fits an .npz
_MOST_NPZ_BYTES = 2**28
_MOST_NUMBERS = 2**25  # 256 MiB as float64: 35,000 frames of 60 bone transforms
_LARGEST = 1e9  # lengths and angles beyond this are garbage, and overflow when they are squared
_KEYS = {
    "names": ("names", "joint_names"),
    "parents": ("parents",),
    "joints_rest": ("joints_rest", "rest_joints", "joints"),
    "canonical_pose": ("canonical_pose",),
    "up": ("up",),
    "scale": ("scale",),
    "poses": ("poses", "pose"),
    "bone_transforms": ("bone_transforms",),
    "trans": ("trans", "translation"),
    "frame_rate": ("frame_rate", "mocap_framerate", "mocap_frame_rate", "fps"),
}


@dataclass(frozen=True, eq=False)
class SkeletonFile:
    """A skeleton in the units and axes of its file, each joint after its parent."""

    names: tuple[str, ...]
    """J joint names, each once."""
    parents: tuple[int, ...]
    """J parents, -1 for a root."""
    joints_rest: NDArray[np.float64]
    """[J, 3], joint positions in the rest pose."""
    order: NDArray[np.int64]
    """[J], place of each joint in the file, by which poses are reordered."""
    canonical_pose: NDArray[np.float64] | None = None
    """[J, 3], axis-angle relative to the rest pose, radians, if the file has one."""
    up: str | None = None
    """y or z, if the file says it."""
    scale: float | None = None
    """Metres a unit, if the file says it."""


@dataclass(frozen=True, eq=False)
class PoseFile:
    """How a skeleton moves, in the units and axes of the file: either poses and translation, or bone transforms."""

    frame_rate: float
    """Frames a second."""
    poses: NDArray[np.float64] | None = None
    """[T, J, 3], axis-angle, radians."""
    translation: NDArray[np.float64] | None = None
    """[T, 3]."""
    posed_from_rest: NDArray[np.float64] | None = None
    """[T, J, 4, 4]."""

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        return len(self.poses if self.poses is not None else self.posed_from_rest)


class _Content:
    """What a file holds under names, checked as it is asked for."""

    def __init__(self, path: str | Path, what: str) -> None:
        self.path, self.what = Path(path), what
        is_npz = self.path.suffix.lower() == ".npz"
        keys = list(chain.from_iterable(_KEYS.values()))
        self.values: Mapping[str, Any] = (
            read_npz(self.path, what, only=keys, max_bytes=_MOST_NPZ_BYTES) if is_npz else self._read_json()
        )

    def fail(self, message: str) -> NoReturn:
        raise UserError(f"{self.what} {self.path}: {message}")

    def _read_json(self) -> dict[str, Any]:
        if not self.path.is_file():
            raise UserError(f"no {self.what} at {self.path}")
        try:
            size = self.path.stat().st_size
            if size > _MOST_JSON_BYTES:
                self.fail(f"has {size / 2**20:.0f} MiB, more than {_MOST_JSON_BYTES / 2**20:.0f}; write it as .npz")
            values = json.loads(self.path.read_bytes().decode("utf-8-sig"))
        except OSError as error:
            self.fail(f"cannot be read ({error.strerror or type(error).__name__})")
        except UserError:
            raise
        except (ValueError, RecursionError):  # bad UTF-8, bad JSON, a number of over 4300 digits, or lists in lists in lists
            self.fail("is not valid JSON; write it again")
        return values if isinstance(values, dict) else self.fail("is not a JSON object; see data/README.md")

    def get(self, name: str) -> Any:
        """Return a value under one of its names, None if there is none."""
        return next((self.values[key] for key in _KEYS[name] if self.values.get(key) is not None), None)

    def numbers(self, name: str, shape: Sequence[int | None]) -> NDArray[np.float64]:
        """Return finite numbers of a shape, in which None stands for any length; one long axis may be folded."""
        value = self.get(name)
        wanted = "x".join("T" if length is None else str(length) for length in shape)
        array = _nested(value, len(shape)) if isinstance(value, list) else value
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            self.fail(f"{name} must be {wanted} numbers")
        if array.size > _MOST_NUMBERS:
            self.fail(f"{name} holds {array.size} numbers, more than {_MOST_NUMBERS}; cut the sequence into parts")
        lengths = [length for length in shape if length is not None]
        if array.ndim == 2 and len(shape) == 3 and array.shape[1] == math.prod(lengths) and shape[0] is None:
            array = array.reshape(len(array), *lengths)
        fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
        if not fits:
            self.fail(f"{name} has shape {'x'.join(map(str, array.shape)) or 'of one number'}, wanted {wanted}")
        array = array.astype(np.float64)
        bad = ~(np.abs(array) < _LARGEST)
        if bad.any():
            where = f" in frame {np.argwhere(bad)[0][0]}" if shape[0] is None else ""
            self.fail(f"{name} has NaN, infinite or absurdly large numbers{where}; repair them")
        return array

    def text(self, name: str) -> str | None:
        """Return a short text, if there is one."""
        value = self.get(name)
        if isinstance(value, np.ndarray) and value.dtype.kind in "US" and value.size == 1 and value.itemsize < 4000:
            value = value.reshape(-1)[0]
        value = value.decode("latin1") if isinstance(value, bytes) else value
        if value is not None and not isinstance(value, str):
            self.fail(f"{name} must be a text")
        return value

    def positive(self, name: str) -> float | None:
        """Return a positive number, if there is one."""
        value = self.get(name)
        if isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "fiu":
            value = value.reshape(-1)[0].item()
        if value is None:
            return None
        if type(value) not in (int, float) or not 1e-9 < value < 1e9:
            self.fail(f"{name} must be a positive number")
        return float(value)


def read_skeleton(path: str | Path) -> SkeletonFile:
    """Read a skeleton file, and sort the joints so that each comes after its parent.

    Raises:
        UserError: the file is missing or broken, something is missing in it or has another shape, the joints form no tree.
    """
    content = _Content(path, "skeleton file")
    parents = content.get("parents")
    if parents is None or content.get("joints_rest") is None:
        missing = "parents" if parents is None else "joints_rest"
        content.fail(f"has no {missing}; a skeleton is names, parents and joints_rest, see data/README.md")
    parents = parents.tolist() if isinstance(parents, np.ndarray) and parents.ndim == 1 else parents
    if not isinstance(parents, list) or not 0 < len(parents) <= _MOST_JOINTS:
        content.fail(f"parents must be a list of 1 to {_MOST_JOINTS} joints")
    count = len(parents)
    names = _names(content, count)
    numbers = [_parent(content, parent, names) for parent in parents]
    order = _parents_first(content, numbers)
    place = {joint: number for number, joint in enumerate(order)}
    chosen = np.array(order)
    canonical = content.numbers("canonical_pose", (count, 3))[chosen] if content.get("canonical_pose") is not None else None
    up = content.text("up")
    if up not in (None, "y", "z"):
        content.fail("up must be y or z")
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
    """Read a pose file of a skeleton whose joints were put in another order (see `SkeletonFile`).

    Raises:
        UserError: the file is missing or broken, or holds neither poses nor bone transforms of so many joints.
    """
    content = _Content(path, "pose file")
    count = len(order)
    frame_rate = content.positive("frame_rate") or DEFAULT_FRAME_RATE
    if content.get("bone_transforms") is not None:
        transforms = content.numbers("bone_transforms", (None, count, 4, 4))
        if not len(transforms):
            content.fail("has no frames")
        if np.abs(transforms[..., 3, :] - (0, 0, 0, 1)).max() > 1e-4:
            content.fail("bone_transforms must end with rows 0 0 0 1; transpose them if they are for row vectors")
        return PoseFile(frame_rate, posed_from_rest=transforms[:, order])
    if content.get("poses") is None:
        content.fail("has neither poses nor bone_transforms; see data/README.md")
    poses = content.numbers("poses", (None, count, 3))
    if not len(poses):
        content.fail("has no frames")
    translation = np.zeros((len(poses), 3))
    if content.get("trans") is not None:
        translation = content.numbers("trans", (None, 3))
        if len(translation) != len(poses):
            content.fail(f"has {len(poses)} poses and {len(translation)} translations")
    return PoseFile(frame_rate, poses[:, order], translation)


def _nested(value: list[Any], depth: int) -> NDArray[np.float64] | None:
    """Return lists in lists, all of one length at each depth, as an array; None if they are not, or hold no plain numbers."""
    shape = [len(value)]
    for _ in range(depth - 1):
        if not value or not all(isinstance(item, list) for item in value):
            return np.array(value, np.float64).reshape(shape) if not value else _numbers(value, shape)
        if any(len(item) != len(value[0]) for item in value):
            return None
        shape.append(len(value[0]))
        value = list(chain.from_iterable(value))
    return _numbers(value, shape)


def _numbers(flat: list[Any], shape: list[int]) -> NDArray[np.float64] | None:
    if not all(type(number) in (int, float) for number in flat):
        return None
    try:
        return np.array(flat, np.float64).reshape(shape)
    except OverflowError:  # a whole number of over 300 digits
        return None


def _names(content: _Content, count: int) -> list[str]:
    """Return the names of the joints, made up if there are none."""
    names = content.get("names")
    if names is None:
        return [f"joint_{joint}" for joint in range(count)]
    if isinstance(names, np.ndarray):
        names = names.tolist() if names.dtype.kind in "US" and names.ndim == 1 else None
    if not isinstance(names, list) or len(names) != count:
        content.fail(f"names must be {count} texts, one for each of parents")
    texts = [name.decode("latin1") if isinstance(name, bytes) else name for name in names]
    for name in texts:
        if not isinstance(name, str) or not 0 < len(name) <= 100 or not name.isprintable():
            content.fail(f"a joint's name must be a text of 1 to 100 letters, got {name!r:.40}")
    twice = next((name for name in texts if texts.count(name) > 1), None)
    if twice is not None:
        content.fail(f"two joints have the name {twice!r:.60}")
    return texts


def _parent(content: _Content, parent: Any, names: list[str]) -> int:
    """Return the number of a parent that is given by number or by name, -1 for none."""
    if parent is None:
        return -1
    if isinstance(parent, str) and parent in names:
        return names.index(parent)
    if isinstance(parent, float) and parent.is_integer():
        parent = int(parent)
    if type(parent) is not int or not (-1 <= parent < len(names) or parent == 2**32 - 1):  # SMPL's -1 without a sign
        content.fail(f"a parent is {parent!r:.40}, wanted a name, a number from 0 to {len(names) - 1}, or -1 for a root")
    return parent if parent < len(names) else -1


def _parents_first(content: _Content, parents: list[int]) -> list[int]:
    """Return the joints in an order in which each comes after its parent: the file's, wherever that is one."""
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
            content.fail("its parents form a circle; one joint at least must be a root (-1)")
        left = later
    return order
