"""Write glTF files byte by byte, for tests; no code is shared with the reader."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

__all__ = ["BOX", "GltfBuilder", "two_bones"]

BOX = trimesh.creation.box((0.2, 1.0, 0.2))
_HALF = np.sqrt(0.5)

_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


class GltfBuilder:
    """Collect arrays; `root` is the JSON, which the test fills in."""

    def __init__(self, **root: Any) -> None:
        self.root: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], **root}
        self.binary = bytearray()

    def view(self, content: bytes, **more: Any) -> int:
        """Add a buffer view."""
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        self.root["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content), **more})
        self.binary.extend(content)
        return len(self.root["bufferViews"]) - 1

    def array(self, values: Any, dtype: str = "float32", **more: Any) -> int:
        """Add an accessor: [N] SCALAR, [N, 3] VEC3, [N, 4, 4] MAT4 (stored by columns), and so on."""
        values = np.asarray(values, dtype)
        if values.ndim == 3:
            values, kind = values.transpose(0, 2, 1), "MAT4"
        else:
            kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor = {"componentType": _COMPONENTS[dtype], "count": len(values), "type": kind, **more}
        accessor.setdefault("bufferView", self.view(values.astype(f"<{values.dtype.str[1:]}").tobytes()))
        self.root["accessors"].append(accessor)
        return len(self.root["accessors"]) - 1

    def glb(self) -> bytes:
        """Return a binary file."""
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        text = json.dumps({**self.root, "buffers": [{"byteLength": len(binary)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks

    def gltf(self, uri: str | None = None) -> bytes:
        """Return a text file whose buffer is at `uri`, by default in the file itself."""
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        return json.dumps({**self.root, "buffers": [{"byteLength": len(self.binary), "uri": uri}]}).encode()


def two_bones(indices: bool = True, **more: Any) -> GltfBuilder:
    """A box that stands on the floor below an armature of scale 0.01 with z up, and bends in the middle.

    Nodes: 0 armature, 1 upper bone, 2 something between, 3 lower bone, 4 mesh (moved, which counts for nothing).
    """
    builder = GltfBuilder()
    positions = np.float32(BOX.vertices @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T * 100)  # cm, z up
    positions = positions + np.float32([0, 0, 50])
    above = positions[:, 2:] > 50
    corners = BOX.faces.ravel()
    attributes = {
        "POSITION": builder.array(positions if indices else positions[corners]),
        "JOINTS_0": builder.array((np.where(above, 0, 1) * [[1, 0, 0, 0]])[slice(None) if indices else corners], "uint8"),
        "WEIGHTS_0": builder.array(([[255, 0, 0, 0]] * 8 if indices else [[255, 0, 0, 0]] * 36), "uint8", normalized=True),
    }
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[:, 2, 3] = -50, 0
    times = builder.array([1.0, 2.0])
    spin = [[0, 0, 0, 1], [0, 0, _HALF, _HALF]]
    builder.root.update(
        nodes=[
            {"name": "armature", "scale": [0.01] * 3, "rotation": [-_HALF, 0, 0, _HALF], "children": [1]},
            {"name": "bone", "translation": [0, 0, 50], "children": [2]},
            {"translation": [0, 0, -20], "children": [3]},
            {"name": "bone", "translation": [0, 0, -30]},
            {"mesh": 0, "skin": 0, "translation": [7, 7, 7]},
        ],
        scenes=[{"nodes": [0, 4]}],
        skins=[{"joints": [3, 1], "inverseBindMatrices": builder.array(inverse[::-1])}],
        meshes=[{"primitives": [{"attributes": attributes}]}],
        animations=[
            {
                "samplers": [{"input": times, "output": builder.array(spin)}],
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
            }
        ],
    )
    if indices:
        builder.root["meshes"][0]["primitives"][0]["indices"] = builder.array(corners, "uint16")
    builder.root.update(more)
    return builder
