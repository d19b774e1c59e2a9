"""Parse the triangles of OFF files in text form from their bytes; polygons are cut into fans.

The format lets values continue in the next line, and allows colours behind the corners of a face, whose number only the end of
the line tells. In nearly all files a line is one vertex or one face, with anything behind the numbers that count.
If there are fewer lines than that, vertices or faces share lines, and nothing may be behind them.

`plain_meshes.py` says why trimesh does not read these files.

Source: Geomview manual, OFF files.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from itertools import chain, islice

from snarfcli.formats.plain_meshes import MAX_FACES, Surface, add_fan, surface_of, text_lines

__all__ = ["parse_off"]

_HEADER = re.compile(rb"(?P<kind>\S*?)OFF(?P<vertices>[0-9]*)", re.IGNORECASE)
# Numbers behind x, y and z: texture, colour (by lines, also 3: many leave out the opacity), normal, fourth coordinate.
_EXTRAS = {b"ST": 2, b"C": 4, b"N": 3, b"4": 1}


def parse_off(content: bytes) -> Surface:
    """Parse an OFF file in text form; colours, normals and texture coordinates are skipped.

    Raises:
        ValueError: the file is damaged; the message is a short reason.
    """
    lines = text_lines(content)
    kind, num_vertices, num_faces, rest, lines_taken = _read_header(lines)
    num_lines = sum(1 for _ in text_lines(content)) - lines_taken
    words = chain(rest, chain.from_iterable(lines)) if num_lines < num_vertices + num_faces else None
    width = 3
    if words or num_lines >= 2 * num_vertices + num_faces:  # else each vertex has a line of its own
        width += sum(count for name, count in _EXTRAS.items() if name in kind) - (b"C" in kind and not words)

    def fill(record: list[bytes], least: int) -> list[bytes]:
        """Extend a record to so many words, or by whole lines until it has them; it stays shorter at the end of the file."""
        if words:
            record += islice(words, least - len(record))
        while not words and len(record) < least and (line := next(lines, None)):
            record += line
        return record

    positions, corners = array("d"), array("q")
    for number in range(num_vertices):
        vertex = fill([], width)
        if len(vertex) < width:
            raise ValueError(f"wanted {num_vertices} vertices, got {number}")
        positions.extend(map(float, vertex[:3]))
    for number in range(num_faces):
        face = fill([], 1)
        if not face:
            raise ValueError(f"wanted {num_faces} faces, got {number}")
        count = int(face[0])
        if not 0 <= count <= MAX_FACES:
            raise ValueError(f"a face: wanted at most {MAX_FACES} corners, got {count}")
        if len(fill(face, 1 + count)) <= count:
            raise ValueError(f"a face: wanted {count} corners, got {len(face) - 1}")
        add_fan(corners, [int(word) for word in face[1 : 1 + count]])
    if words and next(words, None):
        raise ValueError(f"there are more numbers than {num_vertices} vertices and {num_faces} faces need")
    return surface_of(positions, corners)


def _read_header(lines: Iterator[list[bytes]]) -> tuple[bytes, int, int, list[bytes], int]:
    """Return what precedes OFF, such as CN, the numbers of vertices and faces, and the rest of the last line that was read.

    The last value is the number of lines that were read.
    """
    first = next(lines, [b""])
    header = _HEADER.fullmatch(first[0])
    if header is None:
        raise ValueError("it does not begin with OFF")
    if first[1:2] == [b"BINARY"]:
        raise ValueError("it is a binary OFF file; save it as text, or as PLY")
    if header["kind"].endswith(b"n") and first[0].endswith(b"OFF"):
        raise ValueError("its vertices may have any number of coordinates (nOFF); save them with three")
    counts = ([header["vertices"]] if header["vertices"] else []) + first[1:]  # some data sets have OFF8 12 0
    taken = 1
    # The number of edges is the third. Some writers leave it out, others give each number its own line.
    wanted = 2 if len(counts) != 1 else 3
    while len(counts) < wanted and (line := next(lines, None)):
        wanted = 3 if len(counts) + len(line) == 1 else wanted
        counts += line
        taken += 1
    if len(counts) < 2:
        raise ValueError("the numbers of vertices and faces are missing")
    num_vertices, num_faces = int(counts[0]), int(counts[1])
    if min(num_vertices, num_faces) < 0:
        raise ValueError(f"wanted numbers of vertices and faces of at least 0, got {num_vertices} and {num_faces}")
    return header["kind"].upper(), num_vertices, num_faces, counts[3:], taken
