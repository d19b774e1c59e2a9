"""Triangles of OBJ, OFF and STL files, from their bytes; polygons are cut into fans.

All raise ValueError with a short reason, and take memory in proportion to the bytes they are given, whatever those declare.
"""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_FACES", "Surface", "add_fan", "parse_obj", "parse_off", "parse_stl"]

Surface = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices [V, 3] and faces [F, 3]; the numbers in faces may still be out of range."""

MAX_FACES = 1_000_000  # an STL file of that many is read and merged in some 3 s
_MAX_LINES = 2_000_000  # about 5 s
_MAX_LINE = 2**20  # one split into words takes up to thirty times its bytes
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def add_fan(corners: array, polygon: Sequence[int]) -> None:
    """Append the triangles of a polygon to the corners of all triangles so far.

    Raises:
        ValueError: these are more than `MAX_FACES`.
        OverflowError: a number is over 64 bits.
    """
    if len(corners) // 3 + len(polygon) - 2 > MAX_FACES:
        raise ValueError(f"it has over {MAX_FACES} triangles")
    for i in range(1, len(polygon) - 1):
        corners.extend((polygon[0], polygon[i], polygon[i + 1]))


def parse_obj(content: bytes) -> Surface:
    """Read the `v` and `f` lines of an OBJ file; all else (texture coordinates, materials, curves) is skipped unseen."""
    positions, corners = array("d"), array("q")
    for words in _lines(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        if words[0] == b"v":
            if len(words) < 4:
                raise ValueError("a vertex has less than 3 coordinates")
            positions.extend(map(float, words[1:4]))
        elif words[0] == b"f":
            count = len(positions) // 3
            polygon = [int(word.partition(b"/")[0]) for word in words[1:]]
            # 1 is the first vertex, -1 the last one so far; there is no 0.
            add_fan(corners, [i - 1 if i > 0 else count + i if i < 0 else -1 for i in polygon])
    return _surface(positions, corners)


def parse_off(content: bytes) -> Surface:
    """Read an OFF file in text form, with colours or normals or without."""
    lines = _lines(content)
    words = next(lines, [b""])
    if not words[0].upper().endswith(b"OFF"):
        raise ValueError("it does not begin with OFF")
    words = words[1:] or next(lines, [])
    if len(words) < 2:
        raise ValueError("it does not say how many vertices and faces it has")
    num_vertices, num_faces = int(words[0]), int(words[1])
    positions, corners = array("d"), array("q")
    for _ in range(num_vertices):
        words = next(lines, [])
        if len(words) < 3:
            raise ValueError(f"it has {len(positions) // 3} vertices and promises {num_vertices}")
        positions.extend(map(float, words[:3]))
    for number in range(num_faces):
        words = next(lines, [])
        if not words:
            raise ValueError(f"it has {number} faces and promises {num_faces}")
        count = int(words[0])
        if not 0 <= count < len(words):
            raise ValueError(f"a face has {len(words) - 1} corners and promises {count}")
        add_fan(corners, [int(word) for word in words[1 : 1 + count]])
    return _surface(positions, corners)


def parse_stl(content: bytes) -> Surface:
    """Read an STL file, binary or text, all its solids as one; each triangle has vertices of its own."""
    count = int.from_bytes(content[80:84], "little")
    end = 84 + _STL_FACE.itemsize * count
    # Binary files may begin with "solid" too, so the length decides. Some writers leave bytes at the end.
    is_text = content.lstrip()[:5].lower() == b"solid" and b"vertex" in content.lower()
    if len(content) >= 84 and (end == len(content) or (end <= len(content) and not is_text)):
        vertices = np.frombuffer(content, _STL_FACE, count, 84)["corners"].astype(np.float64).reshape(-1, 3)
    elif is_text:
        positions = array("d")
        for words in _lines(content):
            if words[0].lower() == b"vertex":
                if len(words) != 4:
                    raise ValueError("a vertex has other than 3 coordinates")
                positions.extend(map(float, words[1:]))
        vertices = np.array(positions).reshape(-1, 3)
        if len(vertices) % 3:
            raise ValueError("its last triangle is not whole")
    else:
        raise ValueError(f"it has {len(content)} bytes and promises {end}")
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _lines(content: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each line that has any, without comments."""
    content = content if b"\n" in content else content.replace(b"\r", b"\n")
    if content.count(b"\n") > _MAX_LINES:
        raise ValueError(f"it has over {_MAX_LINES} lines; save it in a binary format")
    for line in io.BytesIO(content):
        if len(line) > _MAX_LINE:
            raise ValueError(f"it has a line of {len(line)} bytes")
        words = (line.partition(b"#")[0] if b"#" in line else line).split()
        if words:
            yield words


def _surface(positions: array, corners: array) -> Surface:
    return np.array(positions, np.float64).reshape(-1, 3), np.array(corners, np.int64).reshape(-1, 3)
