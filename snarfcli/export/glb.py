"""Build the container of a binary glTF 2.0 file from JSON objects and arrays.

Source: Khronos, glTF 2.0 specification, 3.6 (accessors and their alignment) and 4 (the binary container).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

import snarfcli
from snarfcli.files import atomic_path

__all__ = ["ARRAY_BUFFER", "ELEMENT_ARRAY_BUFFER", "GlbBuilder"]

ARRAY_BUFFER = 34962
"""Target of a buffer view with vertex attributes."""
ELEMENT_ARRAY_BUFFER = 34963
"""Target of a buffer view with triangle indices."""

_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_LARGEST = 2**32 - 1  # lengths are 32-bit numbers


class GlbBuilder:
    """Collects the objects and arrays of one file. `root` is the JSON to be written; `add` creates its lists.

    Args:
        facts: content of `asset.extras`.
    """

    def __init__(self, **facts: Any) -> None:
        self.root: dict[str, Any] = {"asset": {"version": "2.0", "generator": f"snarf {snarfcli.__version__}"}}
        if facts:
            self.root["asset"]["extras"] = facts
        self._binary = bytearray()

    def add(self, collection: str, **item: Any) -> int:
        """Append an object to a list of the root, such as `nodes`; return its index. Properties that are None are left out."""
        items = self.root.setdefault(collection, [])
        items.append({name: value for name, value in item.items() if value is not None})
        return len(items) - 1

    def array(
        self, values: np.ndarray, dtype: str = "float32", *, target: int | None = None, bounds: bool = False, **more: Any
    ) -> int:
        """Add an accessor with its own buffer view; return its index.

        Args:
            values: [N] numbers, [N, 2..4] vectors, or [N, 4, 4] matrices, which glTF stores by columns.
            dtype: int8, uint8, int16, uint16, uint32 or float32.
            target: use of the buffer view by graphics cards, for vertex attributes and triangle indices. Rows of vertex
                attributes start at multiples of 4 bytes, as the format asks for.
            bounds: whether minimum and maximum are written, which positions and times need.
            more: further properties, such as `normalized`.

        Raises:
            ValueError: the shape is another one, or a number is not finite.
        """
        values = np.asarray(values).astype(dtype)
        if not values.size or not np.isfinite(values).all():
            got = f"shape {list(values.shape)}" if not values.size else "NaN or infinity"
            raise ValueError(f"values: wanted at least one row of finite numbers, got {got}")
        if values.ndim == 3 and values.shape[1:] == (4, 4):
            kind, rows = "MAT4", values.transpose(0, 2, 1).reshape(-1, 16)
        elif values.ndim in (1, 2) and (1 if values.ndim == 1 else values.shape[1]) in _KINDS:
            rows = values.reshape(len(values), -1)
            kind = _KINDS[rows.shape[1]]
        else:
            raise ValueError(f"values: wanted shape [N], [N, 2 to 4] or [N, 4, 4], got {list(values.shape)}")
        stride = None
        stored = rows
        if target == ARRAY_BUFFER and (row := rows.shape[1] * rows.itemsize) % 4:
            stride = row + -row % 4
            stored = np.zeros((len(rows), stride // rows.itemsize), rows.dtype)
            stored[:, : rows.shape[1]] = rows
        self._binary.extend(b"\0" * (-len(self._binary) % 4))
        content = np.ascontiguousarray(stored, rows.dtype.newbyteorder("<")).tobytes()
        place = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        view = self.add("bufferViews", **place, byteStride=stride, target=target)
        self._binary.extend(content)
        limits = {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()} if bounds else {}
        return self.add(
            "accessors", bufferView=view, componentType=_COMPONENTS[dtype], count=len(rows), type=kind, **limits, **more
        )

    def to_bytes(self) -> bytes:
        """Return the content of the file.

        Raises:
            ValueError: it is larger than the format allows, or a number in the JSON is not finite.
        """
        binary = bytes(self._binary) + b"\0" * (-len(self._binary) % 4)
        root = {**self.root, "buffers": [{"byteLength": len(binary)}]}
        text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(binary)
        if length > _LARGEST:
            raise ValueError(f".glb file: wanted at most 4 GiB, got {length / 2**30:.1f} GiB; give fewer triangles or motions")
        head = struct.pack("<III", _MAGIC, 2, length) + struct.pack("<II", len(text), _JSON)
        return head + text + struct.pack("<II", len(binary), _BINARY) + binary

    def write(self, path: str | Path) -> int:
        """Write the file, whole or not at all; return its size in bytes."""
        content = self.to_bytes()
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
        return len(content)
