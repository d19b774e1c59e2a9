"""Parse the triangles or the points of PLY files, text or binary, from their bytes; polygons are cut into fans.

`plain_meshes.py` says why trimesh does not read these files.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.plain_meshes import MAX_FACES, Surface, add_fan
from snarfcli.formats.ply_header import PlyElement, PlyHeader, read_ply_header

__all__ = ["PlyContent", "parse_ply", "read_ply"]

_INDICES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True, eq=False)
class PlyContent:
    """What is read of a file; the indices in faces are not yet checked."""

    vertices: NDArray[np.float64]
    """[V, 3]."""
    faces: NDArray[np.int64]
    """[F, 3]; F is 0 for a point cloud."""
    normals: NDArray[np.float64] | None
    """[V, 3], of any length; None if the file has none."""


class _Found:
    """What was read so far of vertices and faces."""

    def __init__(self) -> None:
        self.vertices: NDArray[np.float64] = np.zeros((0, 3))
        self.normals: NDArray[np.float64] | None = None
        self.positions = array("d")
        """Coordinates of vertices that also have lists, one after another."""
        self.corners = array("q")

    def add(self, element: PlyElement, values: Sequence[int]) -> None:
        """Add the corners of a polygon, or of strips of triangles that are separated by -1."""
        if element.name == "face":
            add_fan(self.corners, values)
            return
        start = 0
        for at in range(len(values)):
            if values[at] < 0:
                start = at + 1
            elif at >= start + 2:  # every second triangle of a strip has the other orientation
                swapped = (at - start) % 2
                add_fan(self.corners, (values[at - 2 + swapped], values[at - 1 - swapped], values[at]))

    def content(self) -> PlyContent:
        """Return all vertices and triangles."""
        vertices = np.array(self.positions).reshape(-1, 3) if self.positions else self.vertices
        return PlyContent(vertices, np.array(self.corners, np.int64).reshape(-1, 3), self.normals)


def parse_ply(content: bytes) -> Surface:
    """Parse a PLY file: x, y and z of `vertex`, and vertex_indices or vertex_index of `face` and `tristrips`.

    Raises:
        ValueError: the file is damaged; the message is a short reason.
    """
    read = read_ply(content)
    return read.vertices, read.faces


def read_ply(content: bytes) -> PlyContent:
    """Parse a PLY file as `parse_ply` does, and also the normals nx, ny and nz of `vertex` if it has no lists.

    Raises:
        ValueError: the file is damaged; the message is a short reason.
    """
    content = content.removeprefix(b"\xef\xbb\xbf")  # a mark that some editors write before text
    header = read_ply_header(content)
    found: list[PlyContent] = []
    problems: list[ValueError] = []
    for start in header.starts:
        try:
            read, end = _read_elements(content, header, start)
        except ValueError as error:
            problems.append(error)
            continue
        if end == len(content):
            return read
        found.append(read)
    if not found:
        raise problems[0]
    return found[0]


def _read_elements(content: bytes, header: PlyHeader, position: int) -> tuple[PlyContent, int]:
    """Return the content of the data from `position` on, and where the data of its elements end."""
    order, found = header.order, _Found()
    words = content[position:].split() if not order else []
    position = position if order else 0
    for element in header.elements:
        if not element.properties or not element.count:
            continue
        least = sum(struct.calcsize("=" + (p.count_code or p.code)) if order else 1 for p in element.properties)
        if element.count * least > (len(content) if order else len(words)) - position:
            raise ValueError(f"wanted {element.count} of {element.name}, but the file ends before")
        wanted = _columns(element)
        if not element.has_lists:
            position, table = _read_table(content, words, order, element, position, wanted)
            if element.name == "vertex":
                found.vertices, found.normals = table[:, :3], table[:, 3:] if table.shape[1] == 6 else None
        elif order:
            position = _read_binary_lists(content, order, element, position, wanted, found)
        else:
            position = _read_text_lists(words, element, position, wanted, found)
    return found.content(), position


def _columns(element: PlyElement) -> list[int]:
    """Return the indices of the properties that are read; none of other elements than vertices and faces."""
    names = [p.name for p in element.properties]
    if element.name == "vertex":
        columns = [names.index(axis) for axis in "xyz" if names.count(axis) == 1]
        if len(columns) < 3 or any(element.properties[column].count_code for column in columns):
            raise ValueError("its vertices: wanted x, y and z once each")
        if element.has_lists and columns != sorted(columns):
            raise ValueError("its vertices have lists: wanted x before y before z")
        normals = [names.index(axis) for axis in ("nx", "ny", "nz") if names.count(axis) == 1]
        has_normals = len(normals) == 3 and not element.has_lists
        return [*columns, *normals] if has_normals else columns
    if element.name not in ("face", "tristrips"):
        return []
    found = [i for i, p in enumerate(element.properties) if p.name in _INDICES and p.count_code and p.code not in "fd"]
    if len(found) != 1:
        raise ValueError(f"its faces do not have one list {_INDICES[0]} of integers")
    return found


def _read_table(
    content: bytes, words: list[bytes], order: str, element: PlyElement, position: int, wanted: list[int]
) -> tuple[int, NDArray[np.float64]]:
    """Return the end position of an element without lists, and its wanted columns [count, len(wanted)]."""
    count, width = element.count, len(element.properties)
    columns = []
    if order:
        dtype = np.dtype([(f"{i}", order + p.code) for i, p in enumerate(element.properties)])
        table = np.frombuffer(content, dtype, count, position)
        end = position + count * dtype.itemsize
        columns = [table[f"{i}"].astype(np.float64) for i in wanted]
    else:
        end = position + count * width
        columns = [np.fromiter(map(float, words[position + i : end : width]), np.float64, count) for i in wanted]
    return end, np.stack(columns, 1) if columns else np.zeros((count, 0))


def _read_text_lists(words: list[bytes], element: PlyElement, position: int, wanted: list[int], found: _Found) -> int:
    for _ in range(element.count):
        for number, column in enumerate(element.properties):
            if position >= len(words):
                raise ValueError(f"wanted {element.count} of {element.name}, but the file ends before")
            length = 1
            if column.count_code:
                length = int(words[position])
                position += 1
                if not 0 <= length <= len(words) - position:
                    raise ValueError(f"a list of {element.name} has {length} entries, but the file ends before")
                if number in wanted:
                    found.add(element, [int(word) for word in words[position : position + length]])
            elif number in wanted:
                found.positions.append(float(words[position]))
            position += length
    return position


def _read_binary_lists(content: bytes, order: str, element: PlyElement, position: int, wanted: list[int], found: _Found) -> int:
    if element.count > MAX_FACES:
        raise ValueError(f"wanted at most {MAX_FACES} of {element.name}, got {element.count}")
    end = _read_equal_lists(content, order, element, position, found) if element.name == "face" else None
    if end is not None:
        return end
    heads = [struct.Struct(order + c.count_code) if c.count_code else None for c in element.properties]
    steps = [(head, c.code, struct.calcsize("=" + c.code)) for head, c in zip(heads, element.properties, strict=True)]
    for _ in range(element.count):
        for number, (head, code, size) in enumerate(steps):
            length = 1
            if head:
                if position + head.size > len(content):
                    raise ValueError(f"wanted {element.count} of {element.name}, but the file ends before")
                (length,) = head.unpack_from(content, position)
                position += head.size
            if not 0 <= length * size <= len(content) - position:
                raise ValueError(f"a list of {element.name} has {length} entries, but the file ends before")
            if number in wanted:
                values = struct.unpack_from(f"{order}{length}{code}", content, position)
                if head:
                    found.add(element, values)
                else:
                    found.positions.append(values[0])
            position += length * size
    return position


def _read_equal_lists(content: bytes, order: str, element: PlyElement, position: int, found: _Found) -> int | None:
    """Read faces with one NumPy call if their only list has 3 entries in each row, as in most files; else return None."""
    if sum(bool(c.count_code) for c in element.properties) != 1:
        return None
    fields = []
    for c in element.properties:
        if c.count_code:
            fields += [("length", order + c.count_code), ("list", order + c.code, 3)]
        else:
            fields.append((f"{len(fields)}", order + c.code))
    dtype = np.dtype(fields)
    if element.count * dtype.itemsize > len(content) - position:
        return None
    table = np.frombuffer(content, dtype, element.count, position)
    if not (table["length"] == 3).all():
        return None
    found.corners.frombytes(np.ascontiguousarray(table["list"], np.int64).tobytes())
    return position + element.count * dtype.itemsize
