"""Meshes with a colour at each vertex, as bytes of a small .glb: viser's own meshes have one colour only."""

from __future__ import annotations

import json
import struct

import numpy as np
from numpy.typing import NDArray

__all__ = ["colored_glb"]

_ARRAY, _INDICES = 34962, 34963  # glTF 2.0: bufferView.target
_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123  # accessor.componentType


def colored_glb(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], colors: NDArray[np.uint8], opacity: float = 1.0
) -> bytes:
    """Return a binary glTF of one mesh; whoever draws it finds the normals.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        colors: [V, 3] sRGB.
        opacity: 0 to 1.
    """
    share = colors.astype(np.float64) / 255  # glTF's vertex colours are linear
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    rgba = np.full((len(vertices), 4), 65535, dtype="<u2")
    rgba[:, :3] = np.rint(65535 * linear)
    parts = [vertices.astype("<f4").tobytes(), rgba.tobytes(), faces.astype("<u4").tobytes()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    low, high = (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else (np.zeros(3), np.zeros(3))
    material = {
        "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, opacity], "metallicFactor": 0, "roughnessFactor": 0.8},
        "alphaMode": "OPAQUE" if opacity >= 1 else "BLEND",
    }
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [material],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(vertices), "type": "VEC3",
             "min": low.tolist(), "max": high.tolist()},
            {"bufferView": 1, "componentType": _UINT16, "normalized": True, "count": len(vertices), "type": "VEC4"},
            {"bufferView": 2, "componentType": _UINT32, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
            for start, part, target in zip(starts, parts, (_ARRAY, _ARRAY, _INDICES), strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts)  # every part is a multiple of four bytes long
    length = 12 + 8 + len(text) + 8 + len(data)
    return b"".join([
        struct.pack("<4sII", b"glTF", 2, length),
        struct.pack("<I4s", len(text), b"JSON"), text,
        struct.pack("<I4s", len(data), b"BIN\0"), data,
    ])  # fmt: skip
