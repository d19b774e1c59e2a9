"""Parse the triangles of PLY files, text or binary, from their bytes; polygons are cut into fans.

`plain_meshes.py` says why trimesh does not read these files.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import struct
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.plain_meshes import MAX_FACES, Surface, add_fan

__all__ = ["parse_ply"]

_TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H", "uint16": "H",
    "int": "i", "int32": "i", "uint": "I", "uint32": "I", "int64": "q", "uint64": "Q",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 2**16
_INDICES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Property:
    name: str
    code: str
    """Type of the values, as a format character of `struct`."""
    count_code: str
    """Type of the length of a list, as a format character of `struct`; empty for a single value."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.count_code for p in self.properties)


def parse_ply(content: bytes) -> Surface:
    """Parse the elements `vertex` (x, y, z) and `face` (vertex_indices or vertex_index) of a PLY file; others are skipped.

    Raises:
        ValueError: the file is damaged; the message is a short reason.
    """
    order, elements, position = _read_header(content)
    vertices: NDArray[np.float64] = np.zeros((0, 3))
    corners = array("q")
    words = content[position:].split() if not order else []
    position = position if order else 0
    for element in elements:
        if not element.properties or not element.count:
            continue
        least = sum(struct.calcsize("=" + (p.count_code or p.code)) if order else 1 for p in element.properties)
        if element.count * least > (len(content) if order else len(words)) - position:
            raise ValueError(f"wanted {element.count} of {element.name}, but the file ends before")
        wanted = _column(element) if element.name in ("vertex", "face") else None
        if not element.has_lists:
            position, table = _read_table(content, words, order, element, position, wanted)
            vertices = table if element.name == "vertex" else vertices
        elif order:
            position = _read_binary_lists(content, order, element, position, wanted, corners)
        else:
            position = _read_text_lists(words, element, position, wanted, corners)
    return vertices, np.array(corners, np.int64).reshape(-1, 3)


def _read_header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order (empty for text), the elements, and where the data begins."""
    head, mark, _ = content[:_MAX_HEADER].partition(b"end_header")
    start = content.find(b"\n", len(head)) + 1 if mark else 0
    if not content.startswith(b"ply") or not start:
        raise ValueError("it has no PLY header")
    order, elements = None, []
    for line in head.decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) > 1 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append(_Property(words[2], _TYPES[words[1]], ""))
        elif words[:2] == ["property", "list"] and elements and len(words) == 5 and {words[2], words[3]} <= _TYPES.keys():
            if _TYPES[words[2]] in "fd":
                raise ValueError("the length of a list is not an integer")
            elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
        else:
            raise ValueError(f"its header has a line that is not understood: {line[:60]!a}")
    if order is None:
        raise ValueError("its header has no format line")
    if len({element.name for element in elements}) < len(elements):
        raise ValueError("its header names an element twice")
    return order, elements, start


def _column(element: _Element) -> list[int]:
    """Return the indices of the properties of `vertex` or `face` that are read."""
    names = [p.name for p in element.properties]
    if element.name == "vertex":
        if element.has_lists or not all(names.count(axis) == 1 for axis in "xyz"):
            raise ValueError("its vertices: wanted x, y and z once each and no lists")
        return [names.index(axis) for axis in "xyz"]
    found = [i for i, p in enumerate(element.properties) if p.name in _INDICES and p.count_code and p.code not in "fd"]
    if len(found) != 1:
        raise ValueError(f"its faces do not have one list {_INDICES[0]} of integers")
    return found


def _read_table(
    content: bytes, words: list[bytes], order: str, element: _Element, position: int, wanted: list[int] | None
) -> tuple[int, NDArray[np.float64]]:
    """Return the end position of an element without lists, and its wanted columns [count, len(wanted)]."""
    count, width = element.count, len(element.properties)
    columns = []
    if order:
        dtype = np.dtype([(f"{i}", order + p.code) for i, p in enumerate(element.properties)])
        table = np.frombuffer(content, dtype, count, position)
        end = position + count * dtype.itemsize
        columns = [table[f"{i}"].astype(np.float64) for i in wanted or []]
    else:
        end = position + count * width
        columns = [np.fromiter(map(float, words[position + i : end : width]), np.float64, count) for i in wanted or []]
    return end, np.stack(columns, 1) if columns else np.zeros((count, 0))


def _read_text_lists(words: list[bytes], element: _Element, position: int, wanted: list[int] | None, corners: array) -> int:
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
                if wanted and number in wanted:
                    add_fan(corners, [int(word) for word in words[position : position + length]])
            position += length
    return position


def _read_binary_lists(
    content: bytes, order: str, element: _Element, position: int, wanted: list[int] | None, corners: array
) -> int:
    if element.count > MAX_FACES:
        raise ValueError(f"wanted at most {MAX_FACES} of {element.name}, got {element.count}")
    end = _read_equal_lists(content, order, element, position, wanted, corners)
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
            if head and wanted and number in wanted:
                add_fan(corners, struct.unpack_from(f"{order}{length}{code}", content, position))
            position += length * size
    return position


def _read_equal_lists(
    content: bytes, order: str, element: _Element, position: int, wanted: list[int] | None, corners: array
) -> int | None:
    """Read an element with one NumPy call if its only list has 3 entries in each row, as in most files; else return None."""
    if sum(bool(c.count_code) for c in element.properties) != 1 or not wanted:
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
    corners.frombytes(np.ascontiguousarray(table["list"], np.int64).tobytes())
    return position + element.count * dtype.itemsize
