"""Reading BVH files: a tree of joints in words and braces, then one line of numbers a frame."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.errors import UserError
from snarfcli.formats.rig import Rig, RigClip

__all__ = ["read_bvh"]

log = logging.getLogger(__name__)

_DEFAULT_FRAME_RATE = 60.0
# World transforms take 128 bytes a joint and frame: 256 MiB for ten minutes of 30 joints at 120 frames a second.
_MOST_JOINT_FRAMES = 2**21
_MOST_JOINTS = 5000
_LONGEST_LINE = 2**20
_CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)
_FRAMES = re.compile(r"frames\s*:?\s*(\S*)", re.IGNORECASE)
_FRAME_TIME = re.compile(r"frame\s*time\s*:?\s*(\S*)", re.IGNORECASE)


@dataclass
class _Joint:
    name: str
    parent: int
    offset: NDArray[np.float64]
    channels: tuple[tuple[str, str], ...] = ()
    """Pairs of axis (x, y or z) and kind (position or rotation), in the order of the file."""
    is_end: bool = False


class _Lines:
    """The lines of a file with their numbers, and errors that name both."""

    def __init__(self, file: IO[str], path: Path) -> None:
        self.file, self.path, self.number = file, path, 0

    def __iter__(self) -> Iterator[str]:
        while line := self.file.readline(_LONGEST_LINE):
            self.number += 1
            if len(line) == _LONGEST_LINE:
                raise self.error("it is too long for a line of BVH")
            yield line

    def error(self, what: str) -> UserError:
        return UserError(f"BVH file {self.path}, line {self.number}: {what}; export or download it again")


def read_bvh(path: str | Path) -> Rig:
    """Read the joints and the motion of a BVH file.

    Names, spaces, line ends and letter case are taken as they come. Any order of channels is read, positions of any joint too;
    a position replaces the joint's OFFSET. An End Site becomes a joint `<parent>_end` that never turns, since it tells where
    the last bone points; names that occur twice get a number. A frame time of 0 or none counts as 60 frames a second, frames
    beyond or short of the declared number as they are, and an incomplete last frame is left out.

    Args:
        path: file.

    Returns:
        The joints at rest, all angles zero, and one clip named as the file, or none without frames. Units and axes are the
        file's, usually centimetres or inches and y up.

    Raises:
        UserError: the file is missing, is no BVH, or is broken; the message names the line.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"BVH file {path} is a folder; name a .bvh file")
    if not path.is_file():
        raise UserError(f"no BVH file at {path}")
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = _Lines(file, path)
            joints = _hierarchy(lines)
            values, frame_rate = _motion(lines, joints)
    except OSError as error:
        raise UserError(f"BVH file {path} cannot be read ({error.strerror or error})") from None
    with np.errstate(over="ignore", invalid="ignore"):
        rest = _rest(joints)
        clips = (RigClip(path.stem, frame_rate, _world(joints, values)),) if len(values) else ()
        is_sane = all(np.isfinite(world[..., 3].sum()) for world in (rest, *(clip.world_from_joint for clip in clips)))
    if not is_sane:
        raise UserError(f"BVH file {path} holds numbers too large to add up; export or download it again")
    return Rig(_unique([joint.name for joint in joints]), tuple(joint.parent for joint in joints), rest, clips)


# --- the hierarchy -----------------------------------------------------------------------------------------------------------


def _words(lines: _Lines) -> Iterator[tuple[str, bool]]:
    """Yield words and braces, and whether each is the first of its line, up to and without the word MOTION."""
    for line in lines:
        first = True
        for word in re.findall(r"[{}]|[^\s{}]+", line):
            if word.lower() == "motion" and first:
                return
            yield word, first
            first = False


def _hierarchy(lines: _Lines) -> list[_Joint]:
    """Read everything before MOTION. A stack in place of recursion: files may nest as deep as they like."""
    words = _words(lines)
    if next(words, ("", True))[0].lower() != "hierarchy":
        raise lines.error("a BVH file begins with HIERARCHY")
    joints: list[_Joint] = []
    stack: list[int] = []
    word = next(words, None)
    while word is not None:
        keyword = word[0].lower()
        if keyword in ("root", "joint", "end"):
            if len(joints) == _MOST_JOINTS:
                raise lines.error(f"there are more than {_MOST_JOINTS} joints")
            if (keyword == "root") == bool(stack):
                raise lines.error("a ROOT stands alone, and a JOINT or End Site inside another joint's braces")
            if stack and joints[stack[-1]].is_end:
                raise lines.error("an End Site holds no joints")
            name = []
            while (word := next(words, None)) is not None and word[0] != "{":
                if word[1]:
                    raise lines.error(f"wanted {{ after the name of a joint, got {_shown(word[0])}")
                name.append(word[0])
            if word is None:
                raise lines.error("the file ends after the name of a joint")
            parent = stack[-1] if stack else -1
            is_end = keyword == "end"
            title = f"{joints[parent].name}_end" if is_end else " ".join(name) or f"joint_{len(joints)}"
            stack.append(len(joints))
            joints.append(_Joint(title, parent, np.zeros(3), is_end=is_end))
        elif not stack:
            raise lines.error(f"wanted ROOT or MOTION, got {_shown(word[0])}")
        elif keyword == "}":
            stack.pop()
        elif keyword == "offset":
            joints[stack[-1]].offset = np.array([_number(lines, _next(lines, words)) for _ in range(3)])
        elif keyword == "channels":
            joints[stack[-1]].channels = _channels(lines, words)
        else:
            raise lines.error(f"wanted OFFSET, CHANNELS, JOINT, End Site or a brace, got {_shown(word[0])}")
        word = next(words, None)
    if stack:
        raise lines.error(f"the braces of {len(stack)} joints are not closed")
    if not joints:
        raise lines.error("there is no ROOT")
    return joints


def _next(lines: _Lines, words: Iterator[tuple[str, bool]]) -> str:
    word = next(words, None)
    if word is None:
        raise lines.error("the file ends inside the hierarchy")
    return word[0]


def _channels(lines: _Lines, words: Iterator[tuple[str, bool]]) -> tuple[tuple[str, str], ...]:
    count = _next(lines, words)
    if count not in ("0", "1", "2", "3", "4", "5", "6"):
        raise lines.error(f"wanted 0 to 6 channels, got {_shown(count)}")
    channels = []
    for _ in range(int(count)):
        word = _next(lines, words)
        match = _CHANNEL.fullmatch(word)
        if match is None:
            raise lines.error(f"wanted a channel such as Xposition or Zrotation, got {_shown(word)}")
        channels.append((match[1].lower(), match[2].lower()))
    if len(set(channels)) < len(channels):
        raise lines.error("a channel is named twice")
    return tuple(channels)


def _number(lines: _Lines, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise lines.error(f"wanted a number, got {_shown(word)}")
    return value


def _shown(word: str) -> str:
    return repr(word[:40])


def _unique(names: list[str]) -> tuple[str, ...]:
    """Return the names with a number after those that came before."""
    taken: set[str] = set()
    counts: dict[str, int] = {}
    unique = []
    for name in names:
        title = name
        while title in taken:
            counts[name] = counts.get(name, 1) + 1
            title = f"{name}_{counts[name]}"
        taken.add(title)
        unique.append(title)
    return tuple(unique)


# --- the motion --------------------------------------------------------------------------------------------------------------


def _motion(lines: _Lines, joints: list[_Joint]) -> tuple[NDArray[np.float64], float]:
    """Read the frames [T, channels] and the frame rate. A frame may take several lines."""
    width = sum(len(joint.channels) for joint in joints)
    most = _MOST_JOINT_FRAMES // len(joints)
    frame_rate, declared = 0.0, ""
    rows: list[NDArray[np.float64]] = []
    row: list[float] = []
    for line in lines:
        text = line.strip()
        if not text:
            continue
        if match := _FRAME_TIME.match(text):
            frame_rate = _frame_rate(lines, match[1])
            continue
        if match := _FRAMES.match(text):
            declared = match[1]
            continue
        words = text.split()
        try:
            values = list(map(float, words))
        except ValueError:
            values = [_number(lines, word) for word in words]
        if not math.isfinite(sum(values)):
            raise lines.error(f"frame {len(rows)} holds NaN, infinity or absurd numbers")
        row += values
        if len(row) > width:
            raise lines.error(f"frame {len(rows)} has {len(row)} values, wanted {width}, one for each channel")
        if len(row) == width:
            if len(rows) == most:
                raise lines.error(f"there are more than {most} frames of {len(joints)} joints; cut the file into parts first")
            rows.append(np.array(row))
            row = []
    if row:
        log.info("%s: the last frame is incomplete and was left out", lines.path.name)
    if declared and declared != str(len(rows)):
        log.info("%s: %s frames are declared, %d are there", lines.path.name, _shown(declared), len(rows))
    if not frame_rate:
        frame_rate = _DEFAULT_FRAME_RATE
        if rows:
            log.info("%s: no frame time given, %g frames a second assumed", lines.path.name, frame_rate)
    return np.array(rows).reshape(len(rows), width), frame_rate


def _frame_rate(lines: _Lines, word: str) -> float:
    """Return frames a second; 0 if the file does not know."""
    seconds = _number(lines, word)
    if seconds == 0:
        return 0.0
    if not 1e-6 <= seconds <= 1e6:
        raise lines.error(f"wanted a frame time in seconds, got {_shown(word)}")
    # 120 frames a second are written as 0.008333 or 0.0083333
    rate = 1 / seconds
    return float(round(rate)) if abs(rate - round(rate)) < 2e-4 * rate and rate >= 1 else rate


def _rest(joints: list[_Joint]) -> NDArray[np.float64]:
    rest = np.tile(np.eye(4), (len(joints), 1, 1))
    for index, joint in enumerate(joints):
        rest[index, :3, 3] = joint.offset + (rest[joint.parent, :3, 3] if joint.parent >= 0 else 0)
    return rest


def _world(joints: list[_Joint], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [T, J, 4, 4] from each joint's frame to the world."""
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
                order += axis.upper()  # capitals: each turn is about the axes as turned by those before it
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
