from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from snarfcli.export.glb import ARRAY_BUFFER, GlbBuilder


def chunks(content: bytes) -> tuple[dict, bytes]:
    """Take a file apart after the specification, chapter 4."""
    assert struct.unpack_from("<III", content) == (0x46546C67, 2, len(content))
    length, kind = struct.unpack_from("<II", content, 12)
    assert kind == 0x4E4F534A
    assert length % 4 == 0
    rest, kind = struct.unpack_from("<II", content, 20 + length)
    assert kind == 0x004E4942
    assert rest % 4 == 0
    assert 28 + length + rest == len(content)
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def test_arrays_are_aligned_and_described():
    builder = GlbBuilder(made="by a test")
    numbers = builder.array(np.arange(3), "uint8")
    places = builder.array([[1.0, 2, 3], [-1, 5, 2.5]], target=ARRAY_BUFFER, bounds=True)
    matrices = builder.array(np.arange(16.0).reshape(1, 4, 4))
    shares = builder.array([[65535, 0]], "uint16", normalized=True)
    root, binary = chunks(builder.to_bytes())
    assert root["asset"]["version"] == "2.0"
    assert root["asset"]["extras"] == {"made": "by a test"}
    assert root["buffers"] == [{"byteLength": len(binary)}]
    views, accessors = root["bufferViews"], root["accessors"]
    assert all(view["byteOffset"] % 4 == 0 for view in views)
    assert accessors[numbers] == {"bufferView": 0, "componentType": 5121, "count": 3, "type": "SCALAR"}
    assert accessors[places]["min"] == [-1, 2, 2.5]
    assert accessors[places]["max"] == [1, 5, 3]
    assert views[places]["target"] == 34962
    assert "target" not in views[numbers]
    assert accessors[shares]["type"] == "VEC2"
    assert accessors[shares]["normalized"] is True
    start = views[matrices]["byteOffset"]
    columns = np.frombuffer(binary, "<f4", 16, start)  # 3.6.2.4: matrices by columns
    np.testing.assert_array_equal(columns.reshape(4, 4).T, np.arange(16).reshape(4, 4))


@pytest.mark.parametrize(("dtype", "stride"), [("int8", 4), ("int16", 8), ("float32", None)])
def test_rows_of_vertex_attributes_start_at_multiples_of_4_bytes(dtype, stride):
    builder = GlbBuilder()
    builder.array([[-1, 2, 3], [4, -5, 6]], dtype, target=ARRAY_BUFFER, bounds=True, normalized=dtype != "float32")
    root, binary = chunks(builder.to_bytes())
    (view,), (accessor,) = root["bufferViews"], root["accessors"]
    assert view.get("byteStride") == stride
    assert accessor["min"] == [-1, -5, 3]  # 3.6.2.5: as they are stored
    wanted, size = np.dtype(dtype).newbyteorder("<"), np.dtype(dtype).itemsize
    rows = np.ndarray((2, 3), wanted, binary, view["byteOffset"], (stride or 3 * size, size))
    assert rows.tolist() == [[-1, 2, 3], [4, -5, 6]]


def test_objects_leave_out_what_is_none():
    builder = GlbBuilder()
    assert builder.add("nodes", name="a", children=None) == 0
    assert builder.add("nodes", name="b") == 1
    assert builder.root["nodes"] == [{"name": "a"}, {"name": "b"}]
    assert "extras" not in builder.root["asset"]


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (np.zeros((2, 5)), {}, r"wanted shape \[N\], \[N, 2 to 4\] or \[N, 4, 4\], got \[2, 5\]"),
        (np.zeros((0, 3)), {}, "at least one row"),
        ([[np.nan, 0, 0]], {}, "wanted at least one row of finite numbers"),
    ],
)
def test_what_cannot_be_stored(values, options, message):
    with pytest.raises(ValueError, match=message):
        GlbBuilder().array(values, **options)


def test_numbers_of_json_are_numbers():
    builder = GlbBuilder()
    builder.add("nodes", translation=[float("nan")] * 3)
    with pytest.raises(ValueError, match="not JSON compliant"):
        builder.to_bytes()
