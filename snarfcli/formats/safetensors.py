"""Files of safetensors: a header in JSON, and the bytes of arrays behind it; nothing in them can be executed.

Source: the format's description, https://github.com/huggingface/safetensors (README, "Format"). A file has 8 bytes with the
length of the header, little-endian; the header, an object from names to dtype, shape and data_offsets, and __metadata__ with
texts; and the bytes of the arrays by rows, little-endian, without gaps.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from snarfcli.errors import UserError, raise_system_error
from snarfcli.files import atomic_path, check_regular
from snarfcli.texts import one_line

__all__ = ["read_safetensors", "safetensors_bytes", "write_safetensors"]

_MAX_HEADER_BYTES = 1 << 23
_MOST_ARRAYS = 10_000
_MOST_AXES = 8
_METADATA = "__metadata__"
_ALIGNMENT = 8  # of the first array, and of the largest numbers, as the format's own library writes
_DTYPES = {
    "BOOL": "?", "U8": "<u1", "I8": "<i1", "U16": "<u2", "I16": "<i2", "U32": "<u4", "I32": "<i4", "U64": "<u8", "I64": "<i8",
    "F16": "<f2", "F32": "<f4", "F64": "<f8",
}  # fmt: skip
_NAMES = {np.dtype(dtype): name for name, dtype in _DTYPES.items()}


def read_safetensors(path: str | Path, what: str = "file") -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read all arrays of a file. The result is as large as the file.

    Args:
        path: the file.
        what: name of the kind of file, for messages.

    Returns:
        The arrays by name, which own their memory, and the metadata.

    Raises:
        UserError: the file is missing, damaged or of another format, or has numbers of another type, such as BF16.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    check_regular(path, what, "a .safetensors")
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            header, begin = _read_header(file, size)
            metadata = header.pop(_METADATA, {})
            if not isinstance(metadata, dict) or not all(type(text) is str for text in metadata.values()):
                raise ValueError(f"{_METADATA}: wanted texts by name, got something else")
            places = {name: _Place.of(name, entry) for name, entry in header.items()}
            _check_gaps(places, size - begin)
            return {name: place.read(file, begin, name) for name, place in places.items()}, metadata
    except UserError:
        raise
    except ValueError as error:  # also of JSON and UTF-8
        raise UserError(f"{what} {path} is damaged ({one_line(error, 200)}); copy or download it again") from None
    except RecursionError:
        raise UserError(f"{what} {path} is damaged (nested too deeply); copy or download it again") from None
    except Exception as error:
        raise_system_error(error, path)
        raise


def write_safetensors(path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Write arrays, whole or not at all.

    Raises:
        ValueError: an array has a type that the format has not.
        OSError: the file cannot be written.
    """
    content = safetensors_bytes(arrays, metadata)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def safetensors_bytes(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> bytes:
    """Return the content of a file: the arrays with the largest numbers first, so that all are aligned.

    Raises:
        ValueError: an array has a type that the format has not, or the name of the metadata.
    """
    header: dict[str, Any] = {_METADATA: dict(metadata)} if metadata else {}
    parts: list[bytes] = []
    end = 0
    for name, array in sorted(arrays.items(), key=lambda item: (-item[1].itemsize, item[0])):
        dtype = array.dtype.newbyteorder("<")
        if dtype not in _NAMES or name == _METADATA:
            raise ValueError(f"{name}: wanted an array of {', '.join(_DTYPES)}, got {array.dtype}")
        parts.append(np.ascontiguousarray(array, dtype).tobytes())
        begin, end = end, end + len(parts[-1])
        header[name] = {"dtype": _NAMES[dtype], "shape": list(array.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    return b"".join([struct.pack("<Q", len(text)), text, *parts])


def _read_header(file: IO[bytes], size: int) -> tuple[dict[str, Any], int]:
    """Return the header of a file, and where the arrays begin.

    Raises:
        ValueError: it is none.
    """
    start = file.read(8)
    if len(start) < 8:
        raise ValueError("it is cut off, or no file of safetensors")
    (length,) = struct.unpack("<Q", start)
    if length > min(_MAX_HEADER_BYTES, size - 8):
        raise ValueError(f"the header has {length} bytes, the file {size}; the most is {_MAX_HEADER_BYTES}")
    header = json.loads(file.read(length).decode("utf-8"), object_pairs_hook=_unique)
    if not isinstance(header, dict):
        raise ValueError(f"the header: wanted an object, got {type(header).__name__}")
    if len(header) > _MOST_ARRAYS:
        raise ValueError(f"wanted at most {_MOST_ARRAYS} arrays, got {len(header)}")
    return header, 8 + length


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of JSON, whose names must differ."""
    if len({name for name, _ in pairs}) < len(pairs):
        raise ValueError("the header has a name twice")
    return dict(pairs)


class _Place:
    """Where an array is in a file, and what it is."""

    def __init__(self, dtype: np.dtype, shape: tuple[int, ...], begin: int, end: int) -> None:
        self.dtype, self.shape, self.begin, self.end = dtype, shape, begin, end

    @classmethod
    def of(cls, name: str, entry: Any) -> _Place:
        """Return the place that an entry of the header describes.

        Raises:
            ValueError: it describes none.
        """
        shown = one_line(name, 60)
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
            raise ValueError(f"{shown}: wanted dtype, shape and data_offsets, got something else")
        shape, offsets = entry["shape"], entry["data_offsets"]
        if type(entry["dtype"]) is not str or entry["dtype"] not in _DTYPES:
            raise ValueError(f"{shown}: wanted one of the types {', '.join(_DTYPES)}, got another")
        if not _are_counts(shape) or len(shape) > _MOST_AXES or not _are_counts(offsets) or len(offsets) != 2:
            raise ValueError(f"{shown}: wanted shape and data_offsets of whole numbers, got others")
        dtype = np.dtype(_DTYPES[entry["dtype"]])
        if offsets[1] - offsets[0] != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{shown}: its {offsets[1] - offsets[0]} bytes do not fit its shape")
        return cls(dtype, tuple(shape), *offsets)

    def read(self, file: IO[bytes], begin: int, name: str) -> np.ndarray:
        """Return the array.

        Raises:
            ValueError: the file is cut off, or a truth value is none.
        """
        file.seek(begin + self.begin)
        stored = np.empty(self.end - self.begin, np.uint8)
        if file.readinto(stored) != len(stored):  # pyright: ignore[reportAttributeAccessIssue]
            raise ValueError("it is cut off")
        if self.dtype.kind == "b" and len(stored) and stored.max() > 1:
            raise ValueError(f"{one_line(name, 60)}: wanted truth values, got other numbers")
        return stored.view(self.dtype).reshape(self.shape).astype(self.dtype.newbyteorder("="), copy=False)


def _are_counts(values: Any) -> bool:
    return isinstance(values, list) and all(type(value) is int and value >= 0 for value in values)


def _check_gaps(places: Mapping[str, _Place], size: int) -> None:
    """Check that arrays cover all bytes behind the header, and none twice.

    Raises:
        ValueError: they do not.
    """
    at = 0
    for place in sorted(places.values(), key=lambda place: (place.begin, place.end)):
        if place.begin != at:
            raise ValueError("its arrays overlap, or leave gaps")
        at = place.end
    if at != size:
        raise ValueError(f"its arrays have {at} bytes, the file {size}")
