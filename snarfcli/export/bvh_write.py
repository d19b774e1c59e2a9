"""Write BVH files: a tree of joints in words and braces, then one line of numbers per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from snarfcli.export.bvh_angles import choose_order, continuous_angles
from snarfcli.files import atomic_path

__all__ = ["BvhMotion", "write_bvh"]

_ANGLE_DIGITS = 6  # decimals: a millionth of a degree moves a hand by 10 nanometres
_LENGTH_DIGITS = 8  # significant digits of the size of the skeleton, at least 6 decimals


@dataclass(frozen=True, eq=False)
class BvhMotion:
    """What a BVH file stores: joints whose axes are those of the world at rest, and their motion."""

    names: tuple[str, ...]
    """J unique joint names, without braces and line breaks."""
    parents: tuple[int, ...]
    """J parents, -1 for a root; a parent comes before its children."""
    offsets: NDArray[np.float64]
    """[J, 3], position of each joint at rest relative to its parent; of a root, to the origin."""
    ends: tuple[tuple[int, NDArray[np.float64]], ...]
    """End Sites: joint and offset [3] from it."""
    rotations: NDArray[np.float64]
    """[T, J, 3, 3], rotation of each joint relative to its parent."""
    positions: dict[int, NDArray[np.float64]]
    """[T, 3] per joint with position channels, relative to the frame of its parent; they replace its offset. Roots need one."""
    frame_rate: float
    """Frames per second."""


def write_bvh(path: str | Path, motion: BvhMotion, *, order: str = "auto") -> int:
    """Write a BVH file, whole or not at all.

    Angles change smoothly from frame to frame, beyond 180 degrees if need be. Position channels contain the whole position, as
    Blender, MotionBuilder and most readers expect, not the difference from OFFSET.

    Args:
        path: the file.
        motion: its content.
        order: axes of the rotations of every joint, one of `ORDERS`; `auto` chooses ZXY, and another order for joints that
            would come near gimbal lock.

    Returns:
        Size of the file in bytes.
    """
    children: list[list[int]] = [[] for _ in motion.names]
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            children[parent].append(joint)
    joints = range(len(motion.names))
    orders = [choose_order(motion.rotations[:, joint]) if order == "auto" else order for joint in joints]
    with atomic_path(path) as temporary:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            sequence = _write_hierarchy(file, motion, children, orders)
            _write_frames(file, motion, sequence, orders)
        return temporary.stat().st_size


def _write_hierarchy(file: TextIO, motion: BvhMotion, children: list[list[int]], orders: Sequence[str]) -> list[int]:
    """Write the tree of joints; return them in the order of the file."""
    digits, sequence = _digits(motion.offsets), []
    file.write("HIERARCHY\n")
    # A stack instead of recursion: chains may be longer than Python's limit. Negative numbers close the joint ~number.
    stack = [(joint, 0) for joint, parent in reversed([*enumerate(motion.parents)]) if parent < 0]
    ends: dict[int, list[NDArray[np.float64]]] = {}
    for joint, offset in motion.ends:
        ends.setdefault(joint, []).append(offset)
    while stack:
        joint, depth = stack.pop()
        pad = "\t" * depth
        if joint < 0:
            for offset in ends.get(~joint, ()):
                file.write(f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\t\tOFFSET {_numbers(offset, digits)}\n{pad}\t}}\n")
            file.write(f"{pad}}}\n")
            continue
        sequence.append(joint)
        channels = [f"{axis}position" for axis in "XYZ"] if joint in motion.positions else []
        channels += [f"{axis}rotation" for axis in orders[joint]]
        file.write(f"{pad}{'JOINT' if depth else 'ROOT'} {motion.names[joint]}\n{pad}{{\n")
        file.write(f"{pad}\tOFFSET {_numbers(motion.offsets[joint], digits)}\n")
        file.write(f"{pad}\tCHANNELS {len(channels)} {' '.join(channels)}\n")
        stack.append((~joint, depth))
        stack += [(child, depth + 1) for child in reversed(children[joint])]
    return sequence


def _write_frames(file: TextIO, motion: BvhMotion, sequence: Sequence[int], orders: Sequence[str]) -> None:
    """Write the motion, with the channels of the joints in the order of the hierarchy."""
    frames = len(motion.rotations)
    angles = np.zeros((frames, len(orders), 3))
    for order in set(orders):
        which = [joint for joint, own in enumerate(orders) if own == order]
        angles[:, which] = continuous_angles(motion.rotations[:, which], order)
    digits = _digits(motion.offsets)
    columns: list[NDArray[np.float64]] = []
    formats: list[str] = []
    for joint in sequence:
        if joint in motion.positions:
            columns.append(np.round(motion.positions[joint], digits))
            formats += [f"%.{digits}f"] * 3
        columns.append(np.round(angles[:, joint], _ANGLE_DIGITS))
        formats += [f"%.{_ANGLE_DIGITS}f"] * 3
    pattern = " ".join(formats) + "\n"
    file.write(f"MOTION\nFrames: {frames}\nFrame Time: {1 / motion.frame_rate:.10f}\n")
    values = np.concatenate(columns, axis=1) + 0.0  # no negative zeros
    for row in values:
        file.write(pattern % tuple(row))


def _digits(offsets: NDArray[np.float64]) -> int:
    """Return the number of decimals of lengths."""
    largest = float(np.abs(offsets).max(initial=0))
    return max(6, min(12, _LENGTH_DIGITS - 1 - int(np.floor(np.log10(largest))))) if largest > 0 else 6


def _numbers(values: NDArray[np.float64], digits: int) -> str:
    """Return numbers as text, without negative zeros."""
    return " ".join(f"{round(float(value), digits) + 0.0:.{digits}f}" for value in values)
