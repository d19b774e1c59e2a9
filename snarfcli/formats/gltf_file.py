"""Read the outer layers of glTF 2.0 files: container, JSON, buffers, and the arrays in them. Everything is checked.

Source: Khronos, glTF 2.0 specification (sections 3.6 binary data, 4 GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError

__all__ = ["GltfFile"]

_MAGIC = 0x46546C67  # "glTF"
_CHUNK_JSON, _CHUNK_BINARY = 0x4E4F534A, 0x004E4942
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_COMPRESSED = {"KHR_draco_mesh_compression": "Draco", **dict.fromkeys(_MESHOPT, "meshopt")}

# Together these limit any file to a few seconds and well under 1 GiB, independent of what it declares.
_MAX_BINARY = 2**29  # bytes, textures included
_MAX_JSON = 160 * 2**20  # bytes, embedded buffers included
_MAX_JSON_ITEMS = 2_000_000  # a parsed list or number takes up to 100 bytes
_MAX_ACCESSOR_VALUES = 2**24  # 128 MiB as float64
_MAX_VALUES = 2**26  # of all accessors; one that is used twice counts twice


class GltfFile:
    """Access to the parts of a `.glb` or `.gltf` file; damaged parts raise `UserError`."""

    def __init__(self, path: str | Path) -> None:
        """Open `path` and read its JSON.

        Raises:
            UserError: it is missing, not glTF 2.0, truncated, too large, or needs an extension that is not supported.
        """
        self.path = Path(path)
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._buffers: dict[int, bytes] = {}
        self._values = 0
        content = _read_limited(self.path, self.path, _MAX_BINARY)
        self._binary = b""
        text = self._unwrap(content) if content[:4] == b"glTF" else content
        self.root = self._parse(text)
        asset = self.root.get("asset")
        version = asset.get("version") if isinstance(asset, dict) else None
        if not isinstance(version, str) or not version.startswith("2"):
            self.fail(f"asset.version: wanted 2.0, got {_shown(version)}; export it as glTF 2.0")
        required = self.root.get("extensionsRequired", [])
        for name in required if isinstance(required, list) else []:
            if isinstance(name, str) and name in _COMPRESSED:
                self.fail(f"is compressed with {_COMPRESSED[name]}, which is not supported; export it without compression")

    def fail(self, message: str) -> NoReturn:
        """Raise a `UserError` that names the file."""
        raise UserError(f"glTF file {self.path}: {message}")

    def reason(self, error: UserError) -> str:
        """Return the message of `fail` without the name of the file, for a list of parts that were left out."""
        return str(error).removeprefix(f"glTF file {self.path}: ")

    def _unwrap(self, content: bytes) -> bytes:
        """Return the JSON of a GLB container, and keep its binary chunk."""
        if len(content) < 20:
            self.fail("is truncated; copy or download it again")
        _, version, length = struct.unpack_from("<III", content)
        if version != 2:
            self.fail(f"container version: wanted 2, got {version}; export it as glTF 2.0")
        if length > len(content):
            self.fail(f"wanted {length} bytes, got {len(content)}; copy or download it again")
        text, position = None, 12
        while position + 8 <= length:
            size, kind = struct.unpack_from("<II", content, position)
            position += 8
            if size > length - position:
                self.fail(f"a chunk of {size} bytes runs past the end; copy or download it again")
            if text is None:
                if kind != _CHUNK_JSON:
                    self.fail("does not begin with a JSON chunk; export it again")
                text = content[position : position + size]
            elif kind == _CHUNK_BINARY and not self._binary:
                self._binary = content[position : position + size]
            position += size
        return text if text is not None else self.fail("has no JSON chunk; export it again")

    def _parse(self, text: bytes) -> dict[str, Any]:
        if len(text) > _MAX_JSON or sum(map(text.count, (b",", b"[", b"{"))) > _MAX_JSON_ITEMS:
            self.fail("its JSON is too large; export it with a separate or embedded binary buffer, as .glb")
        try:
            root = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError):  # ValueError: bad UTF-8, bad JSON, a number of over 4300 digits
            self.fail("has no valid JSON; give a .glb or .gltf file, or export it again")
        return root if isinstance(root, dict) else self.fail("its JSON is not an object; export it again")

    def items(self, key: str) -> list[dict[str, Any]]:
        """Return the list of objects `key` at the top of the file; empty if it is missing."""
        if key not in self._lists:
            self._lists[key] = self.objects(self.root, key, "the file")
        return self._lists[key]

    def objects(self, owner: dict[str, Any], key: str, what: str) -> list[dict[str, Any]]:
        """Return the list of objects `owner[key]`; empty if it is missing."""
        found = owner.get(key, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            self.fail(f"{key} of {what} is not a list of objects; export it again")
        return found

    def index(self, owner: dict[str, Any], key: str, into: str, what: str) -> int | None:
        """Return `owner[key]`, an index into the list `into` of the file; None if it is missing."""
        if key not in owner:
            return None
        return self.checked_index(owner[key], into, f"{key} of {what}")

    def checked_index(self, value: Any, into: str, what: str) -> int:
        """Return `value` if it is an index into the list `into` of the file; else raise `UserError`."""
        count = len(self.items(into))
        if type(value) is not int or not 0 <= value < count:
            self.fail(f"{what} is {_shown(value)}, but there are {count} {into}; export it again")
        return value

    def has_extension(self, owner: dict[str, Any], *names: str) -> bool:
        """Return whether `owner` uses one of the extensions `names`."""
        return any(name in _extensions(owner) for name in names)

    def extension(self, name: str) -> dict[str, Any]:
        """Return the extension `name` of the whole file; empty if the file does not have it."""
        found = _extensions(self.root).get(name)
        return found if isinstance(found, dict) else {}

    def integer(self, owner: dict[str, Any], key: str, default: int | None, what: str) -> int:
        """Return the non-negative integer `owner[key]`; None for `default` makes it required."""
        value = owner.get(key, default)
        if type(value) is not int or value < 0:
            self.fail(f"{key} of {what}: wanted an integer of at least 0, got {_shown(value)}; export it again")
        return value

    def numbers(self, owner: dict[str, Any], key: str, default: tuple[float, ...], what: str) -> NDArray[np.float64]:
        """Return the finite numbers `owner[key]`, an array of the length of `default`."""
        value = owner.get(key, default)
        is_good = isinstance(value, (list, tuple)) and len(value) == len(default)
        if not is_good or not all(type(v) in (int, float) and abs(v) < 1e30 for v in value):  # nan compares false
            self.fail(f"{key} of {what}: wanted {len(default)} finite numbers, got others; export it again")
        return np.array(value, np.float64)

    def accessor_shape(self, index: int) -> tuple[int, str]:
        """Return the number of elements of an accessor, and their type, for example `VEC3`."""
        what = f"accessor {index}"
        accessor = self.items("accessors")[index]
        kind = accessor.get("type")
        return self.integer(accessor, "count", None, what), kind if isinstance(kind, str) else ""

    def accessor(self, index: int, wanted: tuple[str, ...], what: str) -> NDArray[np.float64] | NDArray[np.int64]:
        """Return the values [count, width] of an accessor: int64 for plain integers, else float64.

        Args:
            index: index of the accessor.
            wanted: accepted element types, for example `("VEC3",)`.
            what: name of the values, for messages.

        Raises:
            UserError: it is of another type, lies outside its buffer, is too large, or contains NaN or infinity.
        """
        count, kind = self.accessor_shape(index)
        accessor = self.items("accessors")[index]
        component = accessor.get("componentType")
        if kind not in wanted or type(component) is not int or component not in _DTYPES:
            self.fail(f"{what}: wanted {' or '.join(wanted)}, got {_shown(kind)} of component type {_shown(component)}")
        dtype, width = np.dtype(_DTYPES[component]), _WIDTHS[kind]
        self._values += count * width
        if count * width > _MAX_ACCESSOR_VALUES or self._values > _MAX_VALUES:
            self.fail(f"{what} has {count} elements, which is too many; simplify the mesh or the animation")
        if "bufferView" in accessor:
            values = self._view(accessor, dtype, count, width, what)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values.copy(), accessor["sparse"], what)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        if dtype.kind in "iu":
            return values.astype(np.int64)
        if not np.isfinite(values).all():
            self.fail(f"{what} has NaN or infinity; repair it or export it again")
        return values.astype(np.float64)

    def _with_sparse(self, values: NDArray, sparse: Any, what: str) -> NDArray:
        """Return `values` with some of its rows replaced by those that a sparse accessor stores."""
        if not isinstance(sparse, dict):
            self.fail(f"{what} has sparse values that are not an object; export it again")
        count = self.integer(sparse, "count", None, what)
        rows, replacements = sparse.get("indices"), sparse.get("values")
        if count > len(values) or not isinstance(rows, dict) or not isinstance(replacements, dict):
            self.fail(f"{what} has damaged sparse values; export it again")
        component = rows.get("componentType")
        if component not in (5121, 5123, 5125):
            self.fail(f"{what} has sparse indices of component type {_shown(component)}; export it again")
        indices = self._view(rows, np.dtype(_DTYPES[component]), count, 1, what)[:, 0].astype(np.int64)
        if count and indices.max() >= len(values):
            self.fail(f"{what} has a sparse index beyond its {len(values)} elements; export it again")
        values[indices] = self._view(replacements, values.dtype, count, values.shape[1], what)
        return values

    def _view(self, owner: dict[str, Any], dtype: np.dtype, count: int, width: int, what: str) -> NDArray:
        """Return the values [count, width] in the buffer view of an accessor, or of a part of a sparse accessor."""
        number = self.index(owner, "bufferView", "bufferViews", what)
        if number is None:
            self.fail(f"{what} has no buffer view; export it again")
        view, name = self.items("bufferViews")[number], f"buffer view {number}"
        if self.has_extension(view, *_MESHOPT) and not self._has_plain_data(view):
            self.fail(f"{what} is compressed with meshopt, which is not supported; export it without compression")
        buffer = self._buffer(self.index(view, "buffer", "buffers", name))
        start, length = self.integer(view, "byteOffset", 0, name), self.integer(view, "byteLength", None, name)
        offset = self.integer(owner, "byteOffset", 0, what)
        size = dtype.itemsize * width
        stride = self.integer(view, "byteStride", size, name)
        needed = offset + (count - 1) * stride + size if count else 0
        if stride < size or needed > length or start + length > len(buffer):
            self.fail(f"{what} ({count} elements) lies outside its buffer; copy, download or export the file again")
        return np.ndarray((count, width), dtype, buffer, start + offset if count else 0, (stride, dtype.itemsize))

    def _has_plain_data(self, view: dict[str, Any]) -> bool:
        """Return whether a buffer view that is compressed with meshopt also has its values without compression.

        For readers like this one, its buffer may hold them; a buffer that only states a length is marked as fallback and has no
        address. The compressed values are elsewhere.
        """
        number = self.index(view, "buffer", "buffers", "a buffer view")
        compressed = next((value for name in _MESHOPT if isinstance(value := _extensions(view).get(name), dict)), {})
        place = compressed.get("buffer"), compressed.get("byteOffset", 0)
        if number is None or type(place[0]) is not int or place == (number, view.get("byteOffset", 0)):
            return False
        buffer = self.items("buffers")[number]
        marks = [mark for name in _MESHOPT if isinstance(mark := _extensions(buffer).get(name), dict)]
        return "uri" in buffer or (number == 0 and bool(self._binary) and not any(mark.get("fallback") for mark in marks))

    def _buffer(self, number: int | None) -> bytes:
        if number is None:
            self.fail("a buffer view has no buffer; export it again")
        if number not in self._buffers:
            buffer = self.items("buffers")[number]
            uri = buffer.get("uri")
            if uri is None and number == 0:
                content = self._binary
            elif isinstance(uri, str):
                content = self._from_uri(uri, number)
            else:
                self.fail(f"buffer {number} has no data; export it again")
            length = self.integer(buffer, "byteLength", None, f"buffer {number}")
            if length > len(content):
                self.fail(f"buffer {number}: wanted {length} bytes, got {len(content)}; copy or download it again")
            if sum(map(len, self._buffers.values())) + length > _MAX_BINARY:
                self.fail(f"its buffers are larger than {_MAX_BINARY // 2**20} MiB; simplify the meshes")
            self._buffers[number] = content[:length]
        return self._buffers[number]

    def _from_uri(self, uri: str, number: int) -> bytes:
        if uri[:5].lower() == "data:":
            head, comma, body = uri.partition(",")
            try:
                if comma and head.lower().endswith(";base64"):
                    return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError):
                pass
            self.fail(f"buffer {number} is not valid base64; export it again")
        name = urllib.parse.unquote(uri)
        parts = name.split("/")
        if not name.isprintable() or any(letter in name for letter in "\\:") or {"", ".", ".."} & set(parts):
            self.fail(f"buffer {number}: wanted a file inside the same folder, got {_shown(uri)}; move it there")
        folder = self.path.parent.resolve()
        try:
            beside = folder.joinpath(*parts).resolve()
        except (OSError, RuntimeError):  # links that form a loop
            beside = Path("/")
        if not beside.is_relative_to(folder):
            self.fail(f"buffer {number}: wanted a file inside the same folder, got {_shown(uri)}; move it there")
        return _read_limited(beside, self.path, _MAX_BINARY)


def _read_limited(path: Path, owner: Path, limit: int) -> bytes:
    """Return the bytes of `path`: the glTF file `owner` itself, or one of its buffers."""
    what = f"glTF file {owner}" if path == owner else f"glTF file {owner}: its buffer {path.name!r:.80}"
    try:
        if not path.exists():
            none = f"no glTF file at {owner}; give the path of one"
            raise UserError(none if path == owner else f"{what} is missing; copy it beside the file")
        if not path.is_file():  # reading a pipe would block forever
            raise UserError(f"{what} is not a file; name a .glb or .gltf file")
        if path.stat().st_size > limit:
            raise UserError(f"{what} is larger than {limit // 2**20} MiB; export it without textures, or simplify the meshes")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{what} cannot be opened ({getattr(error, 'strerror', None) or 'its name is not valid'})") from None


def _extensions(owner: dict[str, Any]) -> dict[str, Any]:
    found = owner.get("extensions")
    return found if isinstance(found, dict) else {}


def _shown(value: Any) -> str:
    """Return a value from a file as short text for a message."""
    try:
        text = ascii(value) if isinstance(value, (str, int, float, type(None))) else type(value).__name__
    except ValueError:  # over 4300 digits
        text = "a huge number"
    return text if len(text) <= 60 else text[:57] + "..."
