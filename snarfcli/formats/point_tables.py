"""Parse points, one a line, from the bytes of text files and from arrays; columns that hold normals are found by their length.

Text files of points have no standard: x, y and z come first, then colours, intensities or normals in any order. The parsers
raise ValueError with a short reason.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.plain_meshes import obj_lines, text_lines

__all__ = ["parse_obj_points", "parse_point_text", "points_of_table"]

Array = NDArray[np.float64]
Points = tuple[Array, Array | None]
"""Points [P, 3] and normals [P, 3], None if there are none."""

_MAX_COLUMNS = 16
_UNIT_TOLERANCE = 0.02  # of the length of normals; files have three digits or more
_UNIT_SHARE = 0.98  # of the rows; a few normals are zero or NaN
_SEPARATORS = bytes.maketrans(b",;\t", b"   ")


def parse_point_text(content: bytes) -> Points:
    """Parse lines of x, y, z and further numbers, which are separated by spaces, tabs, commas or semicolons.

    Lines before the first of three numbers, such as a title, a count or names of columns, are skipped, and so are comments
    (`#` or `//`). All lines of points have the same number of columns.
    """
    values, width = array("d"), 0
    for words in text_lines(content.translate(_SEPARATORS)):
        if words[0].startswith(b"//"):
            continue
        numbers = _numbers(words)
        if numbers is None or (not width and len(numbers) < 3):
            if width:
                raise ValueError(f"a line: wanted {width} numbers, got {b' '.join(words)[:40]!a}")
            continue
        width = width or len(numbers)
        if len(numbers) != width or width > _MAX_COLUMNS:
            raise ValueError(f"a line: wanted {min(width, _MAX_COLUMNS)} numbers, got {len(numbers)}")
        values.extend(numbers)
    return points_of_table(np.array(values, np.float64).reshape(-1, width or 3))


def _numbers(words: list[bytes]) -> list[float] | None:
    """Return the numbers of a line; None if a word is none."""
    try:
        return [float(word) for word in words[: _MAX_COLUMNS + 1]]
    except ValueError:
        return None


def points_of_table(table: Array) -> Points:
    """Return the points and normals of a table [P, C]: x, y and z first, normals in the next or the last three columns."""
    if table.ndim != 2 or not 3 <= table.shape[1] <= _MAX_COLUMNS:
        raise ValueError(f"wanted an array [P, 3] of points, got {list(table.shape)[:6]}")
    for columns in _columns_of_normals(table.shape[1]):
        normals = table[:, columns]
        with np.errstate(all="ignore"):
            is_unit = np.abs(np.square(normals).sum(axis=1) - 1) < 2 * _UNIT_TOLERANCE
        if len(table) and is_unit.mean() >= _UNIT_SHARE:
            return table[:, :3], normals
    return table[:, :3], None


def _columns_of_normals(count: int) -> Iterator[slice]:
    for start in dict.fromkeys((3, 4, 6, count - 3)):
        if start >= 3 and start + 3 <= count:
            yield slice(start, start + 3)


def parse_obj_points(content: bytes) -> Points:
    """Parse the `v` lines of an OBJ file, and its `vn` lines if there are as many."""
    positions, normals = array("d"), array("d")
    for words in obj_lines(content):
        rows = {b"v": positions, b"vn": normals}.get(words[0])
        if rows is None:
            continue
        if len(words) < 4:
            raise ValueError(f"a vertex or normal: wanted 3 coordinates, got {len(words) - 1}")
        rows.extend(map(float, words[1:4]))
    points = np.array(positions, np.float64).reshape(-1, 3)
    return points, np.array(normals, np.float64).reshape(-1, 3) if len(normals) == len(positions) else None
