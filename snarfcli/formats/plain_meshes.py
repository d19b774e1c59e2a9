"""Parse the triangles of OBJ, OFF and STL files from their bytes; polygons are cut into fans.

All parsers raise ValueError with a short reason. They use memory in proportion to the bytes given, not to declared counts.

trimesh 5.2, a dependency already, does not replace them or `ply.py`. Measured on a grid of 500,000 triangles (seconds, ours and
trimesh): OBJ 2.9 and 1.9, OFF 1.2 and 3.4, PLY 0.01 and 0.17, PLY as text 2.3 and 3.0, STL 0.06 and 0.88. It also reads some
valid files differently, even with `process=False, maintain_order=True`:

- OBJ: relative numbers count from the end of the file, not from the line of the face, so they name other vertices; a comment
  after a face or line ends of a lone CR raise; `usemtl` splits a mesh and duplicates its vertices.
- OFF and PLY: triangles come before quads and larger polygons, so the order of the faces changes, and quads start elsewhere.
- PLY, binary: polygons of different sizes, or bytes after the data, raise ("unexpected length").
- STL, binary: with bytes after the triangles it returns no triangles and no error.
- On 2,000 damaged OBJ files, 22 led to meshes that the checks of `read_surface` do not expect (vertices of 1 or 2 numbers).
"""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_FACES", "Surface", "add_fan", "parse_obj", "parse_off", "parse_stl"]

Surface = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices [V, 3] and faces [F, 3]; the indices in faces are not yet checked."""

MAX_FACES = 1_000_000  # an STL file of this size is read and merged in about 3 s
_MAX_LINES = 2_000_000  # about 5 s
_MAX_LINE = 2**20  # bytes; splitting a line into words takes up to thirty times its size
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
    for words in _lines(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        if words[0] == b"v":
            if len(words) < 4:
                raise ValueError(f"a vertex: wanted 3 coordinates, got {len(words) - 1}")
            positions.extend(map(float, words[1:4]))
        elif words[0] == b"f":
            count = len(positions) // 3
            polygon = [int(word.partition(b"/")[0]) for word in words[1:]]
            # 1 is the first vertex of the file, -1 the last vertex before this line; 0 is invalid.
            add_fan(corners, [i - 1 if i > 0 else count + i if i < 0 else -1 for i in polygon])
    return _surface(positions, corners)


def parse_off(content: bytes) -> Surface:
    """Parse an OFF file in text form; colours and normals are skipped."""
    lines = _lines(content)
    words = next(lines, [b""])
    if not words[0].upper().endswith(b"OFF"):
        raise ValueError("it does not begin with OFF")
    words = words[1:] or next(lines, [])
    if len(words) < 2:
        raise ValueError("the numbers of vertices and faces are missing")
    num_vertices, num_faces = int(words[0]), int(words[1])
    positions, corners = array("d"), array("q")
    for _ in range(num_vertices):
        words = next(lines, [])
        if len(words) < 3:
            raise ValueError(f"wanted {num_vertices} vertices, got {len(positions) // 3}")
        positions.extend(map(float, words[:3]))
    for number in range(num_faces):
        words = next(lines, [])
        if not words:
            raise ValueError(f"wanted {num_faces} faces, got {number}")
        count = int(words[0])
        if not 0 <= count < len(words):
            raise ValueError(f"a face: wanted {count} corners, got {len(words) - 1}")
        add_fan(corners, [int(word) for word in words[1 : 1 + count]])
    return _surface(positions, corners)


def parse_stl(content: bytes) -> Surface:
    """Parse an STL file, binary or text, all solids as one mesh; each triangle gets three separate vertices."""
    count = int.from_bytes(content[80:84], "little")
    end = 84 + _STL_FACE.itemsize * count
    # Binary files may begin with "solid" too, so the length decides. Some writers add bytes at the end.
    is_text = content.lstrip()[:5].lower() == b"solid" and b"vertex" in content.lower()
    if len(content) >= 84 and (end == len(content) or (end <= len(content) and not is_text)):
        vertices = np.frombuffer(content, _STL_FACE, count, 84)["corners"].astype(np.float64).reshape(-1, 3)
    elif is_text:
        positions = array("d")
        for words in _lines(content):
            if words[0].lower() == b"vertex":
                if len(words) != 4:
                    raise ValueError(f"a vertex: wanted 3 coordinates, got {len(words) - 1}")
                positions.extend(map(float, words[1:]))
        vertices = np.array(positions).reshape(-1, 3)
        if len(vertices) % 3:
            raise ValueError("its last triangle is incomplete")
    else:
        raise ValueError(f"wanted {end} bytes, got {len(content)}")
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _lines(content: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each non-empty line, without comments."""
    content = content if b"\n" in content else content.replace(b"\r", b"\n")
    if content.count(b"\n") > _MAX_LINES:
        raise ValueError(f"wanted at most {_MAX_LINES} lines, got more; save it in a binary format")
    for line in io.BytesIO(content):
        if len(line) > _MAX_LINE:
            raise ValueError(f"a line: wanted at most {_MAX_LINE} bytes, got {len(line)}")
        words = (line.partition(b"#")[0] if b"#" in line else line).split()
        if words:
            yield words


def _surface(positions: array, corners: array) -> Surface:
    return np.array(positions, np.float64).reshape(-1, 3), np.array(corners, np.int64).reshape(-1, 3)
