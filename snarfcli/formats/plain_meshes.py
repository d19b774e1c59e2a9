"""Parse the triangles of OBJ and STL files from their bytes; polygons are cut into fans.

All parsers raise ValueError with a short reason. They use memory in proportion to the bytes given, not to declared counts.

trimesh 5.2, a dependency already, does not replace them, `off.py` or `ply.py`. Measured on a grid of 500,000 triangles
(seconds, ours and trimesh): OBJ 2.9 and 1.9, OFF 1.6 and 3.4, PLY 0.01 and 0.17, PLY as text 2.3 and 3.0, STL 0.06 and 0.88. It
also reads some valid files differently, even with `process=False, maintain_order=True`:

- OBJ: relative numbers count from the end of the file, not from the line of the face, so they name other vertices; a comment
  after a face or line ends of a lone CR raise; `usemtl` splits a mesh and duplicates its vertices.
- OFF and PLY: triangles come before quads and larger polygons, so the order of the faces changes, and quads start elsewhere.
- PLY, binary: polygons of different sizes, or bytes after the data, raise ("unexpected length").
- STL, binary: with bytes after the triangles it returns no triangles and no error.
- On 2,000 damaged OBJ files, 22 led to meshes that the checks of `read_surface` do not expect (vertices of 1 or 2 numbers).
"""

from __future__ import annotations

import io
import re
from array import array
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_FACES", "Surface", "add_fan", "obj_lines", "parse_obj", "parse_stl", "surface_of", "text_lines"]

Surface = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices [V, 3] and faces [F, 3]; the indices in faces are not yet checked."""

MAX_FACES = 1_000_000  # an STL file of this size is read and merged in about 3 s
_MAX_LINES = 2_000_000  # about 5 s
_MAX_LINE = 2**20  # bytes; splitting a line into words takes up to thirty times its size
_CONTINUED = re.compile(rb"\\[ \t]*(?:\r\n|\r|\n)")  # a backslash at the end of a line
_STL_LINES = {b"facet": 5, b"outer": 2, b"vertex": 4, b"endloop": 1, b"endfacet": 1}  # words in a line
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def add_fan(corners: array, polygon: Sequence[int]) -> None:
    """Append the triangles of a polygon to `corners`, the vertex indices of all triangles before it.

    Raises:
        ValueError: there are more than `MAX_FACES` triangles.
        OverflowError: an index exceeds 64 bits.
    """
    if len(corners) // 3 + len(polygon) - 2 > MAX_FACES:
        raise ValueError(f"wanted at most {MAX_FACES} triangles, got more")
    for i in range(1, len(polygon) - 1):
        corners.extend((polygon[0], polygon[i], polygon[i + 1]))


def parse_obj(content: bytes) -> Surface:
    """Parse the `v` and `f` lines of an OBJ file; other lines (texture coordinates, materials, curves) are skipped."""
    positions, corners = array("d"), array("q")
    for words in obj_lines(content):
        if words[0] == b"v":
            if len(words) < 4:
                raise ValueError(f"a vertex: wanted 3 coordinates, got {len(words) - 1}")
            positions.extend(map(float, words[1:4]))
        elif words[0] == b"f":
            count = len(positions) // 3
            polygon = [int(word.partition(b"/")[0]) for word in words[1:]]
            # 1 is the first vertex of the file, -1 the last vertex before this line; 0 is invalid.
            add_fan(corners, [i - 1 if i > 0 else count + i if i < 0 else -1 for i in polygon])
    return surface_of(positions, corners)


def obj_lines(content: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each line of an OBJ file as `text_lines` does; a backslash joins a line with the next."""
    return text_lines(_CONTINUED.sub(b" ", content) if b"\\" in content else content)


def parse_stl(content: bytes) -> Surface:
    """Parse an STL file, binary or text, all solids as one mesh; each triangle gets three separate vertices."""
    count = int.from_bytes(content[80:84], "little")
    end = 84 + _STL_FACE.itemsize * count
    # Binary files may begin with "solid" too, so the length decides. Some writers add bytes at the end.
    is_text = content.lstrip()[:5].lower() == b"solid" and b"vertex" in content.lower()
    if len(content) >= 84 and (end == len(content) or (end <= len(content) and not is_text)):
        vertices = np.frombuffer(content, _STL_FACE, count, 84)["corners"].astype(np.float64).reshape(-1, 3)
    elif is_text:
        positions = _stl_text(content)
        if len(positions) % 9:
            raise ValueError("its last triangle is incomplete")
        vertices = np.array(positions).reshape(-1, 3)
    else:
        raise ValueError(f"wanted {end} bytes, got {len(content)}")
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _stl_text(content: bytes) -> array:
    """Return the coordinates behind each word `vertex`, however the words are spread over lines."""
    positions, missing = array("d"), 0
    for words in text_lines(content):
        if not missing and len(words) == _STL_LINES.get(words[0].lower()):  # as nearly all writers do
            if len(words) == 4:
                positions.extend(map(float, words[1:]))
            continue
        is_name = False  # any words behind `solid` and `endsolid`
        for word in (word.lower() for word in words):
            if missing:
                positions.append(float(word))
                missing -= 1
            elif word in (b"solid", b"endsolid", b"facet"):
                is_name = word != b"facet"
            elif word == b"vertex" and not is_name:
                missing = 3
    if missing:
        raise ValueError(f"a vertex: wanted 3 coordinates, got {3 - missing}")
    return positions


def text_lines(content: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each non-empty line, without comments; lines may end in LF, CR LF or CR, also in one file.

    Raises:
        ValueError: there are too many lines, or a line is too long.
    """
    content = content.removeprefix(b"\xef\xbb\xbf")  # a mark that some editors write before text
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if content.count(b"\n") > _MAX_LINES:
        raise ValueError(f"wanted at most {_MAX_LINES} lines, got more; save it in a binary format")
    for line in io.BytesIO(content):
        if len(line) > _MAX_LINE:
            raise ValueError(f"a line: wanted at most {_MAX_LINE} bytes, got {len(line)}")
        words = (line.partition(b"#")[0] if b"#" in line else line).split()
        if words:
            yield words


def surface_of(positions: array, corners: array) -> Surface:
    """Return the vertices and faces that are stored one after another in two arrays."""
    return np.array(positions, np.float64).reshape(-1, 3), np.array(corners, np.int64).reshape(-1, 3)
