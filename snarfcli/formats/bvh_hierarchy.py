"""Read the HIERARCHY part of BVH files: the tree of joints with their offsets and channels."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.texts import counted

__all__ = ["BvhJoint", "BvhLines", "read_hierarchy", "read_number", "shown"]

_MAX_JOINTS = 5000
_MAX_LINE = 2**20
_CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)


@dataclass
class BvhJoint:
    """One joint or End Site of the hierarchy."""

    name: str
    parent: int
    """Index of the parent joint, -1 for a root."""
    offset: NDArray[np.float64]
    """[3], position relative to the parent, units of the file."""
    channels: tuple[tuple[str, str], ...] = ()
    """Pairs of axis (x, y or z) and kind (position or rotation), in the order of the file."""
    is_end: bool = False
    """Whether it is an End Site, which has no channels and no children."""


class BvhLines:
    """The lines of a file, and errors that name the file and the current line."""

    def __init__(self, file: IO[str], path: Path) -> None:
        self.file, self.path, self.number = file, path, 0

    def __iter__(self) -> Iterator[str]:
        while line := self.file.readline(_MAX_LINE):
            self.number += 1
            if len(line) == _MAX_LINE:
                raise self.error("the line is too long for a BVH file")
            yield line

    def error(self, what: str) -> UserError:
        """Return the error to raise for the current line."""
        return UserError(f"BVH file {self.path}, line {self.number}: {what}; export or download it again")


class _Words:
    """The words and braces of the hierarchy, up to the word MOTION."""

    def __init__(self, lines: BvhLines) -> None:
        self._lines = lines
        self._words = self._split()

    def _split(self) -> Iterator[tuple[str, bool]]:
        for line in self._lines:
            is_first = True
            for word in re.findall(r"[{}]|[^\s{}]+", line):
                if is_first and word.lower() == "motion":
                    return
                yield word, is_first
                is_first = False

    def next_or_none(self) -> tuple[str, bool] | None:
        """Return the next word and whether it is the first of its line; None at the end."""
        return next(self._words, None)

    def next(self) -> str:
        """Return the next word.

        Raises:
            UserError: there is none.
        """
        word = self.next_or_none()
        if word is None:
            raise self._lines.error("the file ends inside the hierarchy")
        return word[0]


def read_hierarchy(lines: BvhLines) -> list[BvhJoint]:
    """Read everything before MOTION, each joint after its parent.

    Raises:
        UserError: the text is not a BVH hierarchy; the message names the line.
    """
    words = _Words(lines)
    first = words.next_or_none()
    if first is None or first[0].lower() != "hierarchy":
        raise lines.error("a BVH file begins with HIERARCHY")
    joints: list[BvhJoint] = []
    open_joints: list[int] = []  # a stack instead of recursion, since files may nest deeper than Python's limit
    while (word := words.next_or_none()) is not None:
        keyword = word[0].lower()
        if keyword in ("root", "joint", "end"):
            joint = _read_joint(lines, words, keyword, joints, open_joints)
            open_joints.append(len(joints))
            joints.append(joint)
        elif not open_joints:
            raise lines.error(f"wanted ROOT or MOTION, got {shown(word[0])}")
        elif keyword == "}":
            open_joints.pop()
        elif keyword == "offset":
            joints[open_joints[-1]].offset = np.array([read_number(lines, words.next()) for _ in range(3)])
        elif keyword == "channels":
            joints[open_joints[-1]].channels = _read_channels(lines, words)
        else:
            raise lines.error(f"wanted OFFSET, CHANNELS, JOINT, End Site or a brace, got {shown(word[0])}")
    if open_joints:
        raise lines.error(f"the braces of {counted(len(open_joints), 'joint')} are not closed")
    if not joints:
        raise lines.error("there is no ROOT")
    return joints


def _read_joint(lines: BvhLines, words: _Words, keyword: str, joints: list[BvhJoint], open_joints: list[int]) -> BvhJoint:
    """Read the name of a joint up to its opening brace, and check that a joint may stand here."""
    if len(joints) == _MAX_JOINTS:
        raise lines.error(f"there are more than {_MAX_JOINTS} joints")
    if (keyword == "root") == bool(open_joints):
        raise lines.error("a ROOT must stand outside, a JOINT or End Site inside the braces of another joint")
    if open_joints and joints[open_joints[-1]].is_end:
        raise lines.error("an End Site cannot contain joints")
    name = []
    while (word := words.next_or_none()) is not None and word[0] != "{":
        if word[1]:
            raise lines.error(f"wanted {{ after the name of a joint, got {shown(word[0])}")
        name.append(word[0])
    if word is None:
        raise lines.error("the file ends after the name of a joint")
    parent = open_joints[-1] if open_joints else -1
    is_end = keyword == "end"
    title = f"{joints[parent].name}_end" if is_end else " ".join(name) or f"joint_{len(joints)}"
    return BvhJoint(title, parent, np.zeros(3), is_end=is_end)


def _read_channels(lines: BvhLines, words: _Words) -> tuple[tuple[str, str], ...]:
    count = words.next()
    if count not in ("0", "1", "2", "3", "4", "5", "6"):
        raise lines.error(f"wanted 0 to 6 channels, got {shown(count)}")
    channels = []
    for _ in range(int(count)):
        word = words.next()
        match = _CHANNEL.fullmatch(word)
        if match is None:
            raise lines.error(f"wanted a channel such as Xposition or Zrotation, got {shown(word)}")
        channels.append((match[1].lower(), match[2].lower()))
    if len(set(channels)) < len(channels):
        raise lines.error("a channel is named twice")
    return tuple(channels)


def read_number(lines: BvhLines, word: str) -> float:
    """Return the finite number that a word spells.

    Raises:
        UserError: it is not a finite number; the message names the line.
    """
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise lines.error(f"wanted a number, got {shown(word)}")
    return value


def shown(word: str) -> str:
    """Return the start of a word in quotes, for messages."""
    return repr(word[:40])
