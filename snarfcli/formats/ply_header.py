"""Parse the headers of PLY files: the elements, and where their data begin.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

__all__ = ["PlyElement", "PlyHeader", "PlyProperty", "read_ply_header"]

_TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H", "uint16": "H",
    "int": "i", "int32": "i", "uint": "I", "uint32": "I", "int64": "q", "uint64": "Q",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 2**16
_END = re.compile(rb"(?:\r\n|\r|\n)[ \t]*end_header[^\r\n]*(\r\n|\r|\n)")


@dataclass(frozen=True)
class PlyProperty:
    """One value, or one list of values, of each entry of an element."""

    name: str
    """Name in the header."""
    code: str
    """Type of the values, as a format character of `struct`."""
    count_code: str
    """Type of the length of a list, as a format character of `struct`; empty for a single value."""


@dataclass(frozen=True)
class PlyElement:
    """A table of the file, such as `vertex` or `face`."""

    name: str
    """Name in the header."""
    count: int
    """Number of entries."""
    properties: list[PlyProperty]
    """The values of an entry, in the order of the file."""

    @property
    def has_lists(self) -> bool:
        """Whether entries differ in size."""
        return any(p.count_code for p in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """The description of the data of a PLY file."""

    order: str
    """Byte order as a format character of `struct`; empty for text."""
    elements: list[PlyElement]
    """The tables, in the order of the file."""
    starts: list[int]
    """Where the data may begin, the most likely first: a byte 10 behind a line end of CR may be part of the data."""


def read_ply_header(content: bytes) -> PlyHeader:
    """Parse the header of a PLY file; its lines may end in LF, CR LF or CR.

    Raises:
        ValueError: it is missing or damaged; the message is a short reason.
    """
    end = _END.search(content[:_MAX_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise ValueError("it has no PLY header")
    head = content[: end.start(1)]
    order, elements = _read_lines(re.split(r"\r\n|\r|\n", head.decode("latin-1"))[1:-1])
    starts = [end.end()]
    if order and end[1] == b"\r\n":
        starts.insert(1 if b"\n" in head else 0, end.end() - 1)
    return PlyHeader(order, elements, starts)


def _read_lines(lines: list[str]) -> tuple[str, list[PlyElement]]:
    """Return the byte order (empty for text) and the elements."""
    order: str | None = None
    elements: list[PlyElement] = []
    for line in lines:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) > 1 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(PlyElement(words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append(PlyProperty(words[2], _TYPES[words[1]], ""))
        elif words[:2] == ["property", "list"] and elements and len(words) == 5 and {words[2], words[3]} <= _TYPES.keys():
            if _TYPES[words[2]] in "fd":
                raise ValueError("the length of a list is not an integer")
            elements[-1].properties.append(PlyProperty(words[4], _TYPES[words[3]], _TYPES[words[2]]))
        else:
            raise ValueError(f"its header has a line that is not understood: {line[:60]!a}")
    if order is None:
        raise ValueError("its header has no format line")
    if len({element.name for element in elements}) < len(elements):
        raise ValueError("its header names an element twice")
    return order, elements
