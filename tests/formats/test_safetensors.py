"""Files of safetensors, against the format's own library where it is installed."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from snarfcli.errors import UserError
from snarfcli.formats.safetensors import read_safetensors, safetensors_bytes, write_safetensors

ARRAYS = {
    "b": np.array([True, False, True]),
    "halves": np.linspace(-1, 1, 7, dtype=np.float16),
    "words": np.arange(6, dtype=np.int64).reshape(3, 2) - 3,
    "f": np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32),
    "nan": np.array([np.nan, -0.0, np.inf]),
    "scalar": np.array(5, np.int32),
    "empty": np.zeros((0, 3), np.float32),
    "strided": np.arange(20, dtype=np.float32).reshape(4, 5)[:, ::2],
    "big": np.arange(3, dtype=">i2"),
}


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(
        a[name].shape == b[name].shape and a[name].tobytes() == np.ascontiguousarray(b[name], a[name].dtype).tobytes()
        for name in a
    )


def with_header(header: object, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def test_arrays_come_back_bit_for_bit(tmp_path):
    write_safetensors(tmp_path / "a.safetensors", ARRAYS, {"format": "pt"})
    found, metadata = read_safetensors(tmp_path / "a.safetensors")
    assert same(found, ARRAYS)
    assert metadata == {"format": "pt"}
    assert all(array.flags.owndata or array.base is not None for array in found.values())
    found["f"][:] = 0  # they can be written to
    write_safetensors(tmp_path / "none.safetensors", {}, {})
    assert read_safetensors(tmp_path / "none.safetensors") == ({}, {})


def test_numbers_are_aligned():
    content = safetensors_bytes(ARRAYS, {})
    (length,) = struct.unpack_from("<Q", content)
    assert length % 8 == 0
    header = json.loads(content[8 : 8 + length])
    for name, entry in header.items():
        assert entry["data_offsets"][0] % ARRAYS[name].itemsize == 0


def test_the_format_s_own_library_reads_and_writes_the_same(tmp_path):
    library = pytest.importorskip("safetensors.numpy", reason="wants the package safetensors")
    plain = {name: np.array(array, array.dtype.newbyteorder("="), order="C") for name, array in ARRAYS.items()}
    assert same(library.load(safetensors_bytes(ARRAYS, {"format": "pt"})), plain)
    (tmp_path / "a.safetensors").write_bytes(library.save(plain, {"who": "the library"}))
    found, metadata = read_safetensors(tmp_path / "a.safetensors")
    assert same(found, plain)
    assert metadata == {"who": "the library"}


ENTRY = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
BROKEN = [
    (b"", "it is cut off, or no file of safetensors"),
    (struct.pack("<Q", 2**63) + b"{}", "the header has 9223372036854775808 bytes, the file 10"),
    (struct.pack("<Q", 3) + b"{}", "the header has 3 bytes, the file 10"),
    (with_header(b"{"), "Expecting property name"),
    (with_header(b"\xff\xff"), "invalid start byte"),
    (with_header(b"[" * 100_000), "nested too deeply"),
    (with_header([1]), "the header: wanted an object, got list"),
    (with_header(b'{"a":{"dtype":"U8","shape":[0],"data_offsets":[0,0]},"a":{}}'), "the header has a name twice"),
    (with_header({"__metadata__": {"a": 1}}), "__metadata__: wanted texts by name"),
    (with_header({"a": [1]}), "a: wanted dtype, shape and data_offsets"),
    (with_header({"a\n\x1b[2J": {**ENTRY, "more": 1}}, bytes(8)), r"a \[2J: wanted dtype, shape and data_offsets"),
    (with_header({"a": {**ENTRY, "dtype": "BF16"}}, bytes(8)), "a: wanted one of the types BOOL, U8"),
    (with_header({"a": {**ENTRY, "dtype": []}}, bytes(8)), "a: wanted one of the types BOOL, U8"),
    (with_header({"a": {**ENTRY, "shape": [-2]}}, bytes(8)), "a: wanted shape and data_offsets of whole numbers"),
    (with_header({"a": {**ENTRY, "shape": [True, 2]}}, bytes(8)), "a: wanted shape and data_offsets of whole numbers"),
    (with_header({"a": {**ENTRY, "shape": [1] * 9}}, bytes(4)), "a: wanted shape and data_offsets of whole numbers"),
    (with_header({"a": {**ENTRY, "shape": [2**62, 2**62]}}, bytes(8)), "a: its 8 bytes do not fit its shape"),
    (with_header({"a": {**ENTRY, "data_offsets": [8, 0]}}, bytes(8)), "a: its -8 bytes do not fit its shape"),
    (with_header({"a": ENTRY}, bytes(7)), "its arrays have 8 bytes, the file 7"),
    (with_header({"a": ENTRY}, bytes(9)), "its arrays have 8 bytes, the file 9"),
    (with_header({"a": ENTRY, "b": ENTRY}, bytes(8)), "its arrays overlap, or leave gaps"),
    (with_header({"a": {**ENTRY, "data_offsets": [4, 12]}}, bytes(12)), "its arrays overlap, or leave gaps"),
    (with_header({"a": {"dtype": "BOOL", "shape": [1], "data_offsets": [0, 1]}}, b"\2"), "a: wanted truth values"),
    (
        with_header({f"a{n}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for n in range(10_001)}),
        "at most 10000 arrays",
    ),
]


@pytest.mark.parametrize(("content", "message"), BROKEN, ids=range(len(BROKEN)))
def test_broken_files_are_named(tmp_path, content, message):
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message) as caught:
        read_safetensors(path, "avatar")
    assert str(caught.value).startswith(f"avatar {path} is damaged (")
    assert str(caught.value).isprintable()


def test_what_is_no_file(tmp_path):
    with pytest.raises(UserError, match="no avatar at"):
        read_safetensors(tmp_path / "none.safetensors", "avatar")
    with pytest.raises(UserError, match=r"is a folder; name a \.safetensors file"):
        read_safetensors(tmp_path, "avatar")


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(ValueError, match=r"a: wanted an array of BOOL, U8.*, got complex64"):
        write_safetensors(tmp_path / "a", {"a": np.zeros(1, np.complex64)}, {})
    with pytest.raises(ValueError, match="__metadata__: wanted an array"):
        write_safetensors(tmp_path / "a", {"__metadata__": np.zeros(1)}, {})
    assert list(Path(tmp_path).iterdir()) == []
