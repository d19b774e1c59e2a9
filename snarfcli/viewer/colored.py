"""Meshes with a colour per vertex as .glb bytes: the mesh nodes of viser have one colour only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.export.glb import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbBuilder
from snarfcli.meshing.colors import from_srgb

__all__ = ["colored_glb"]


def colored_glb(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], colors: NDArray[np.uint8], opacity: float = 1.0
) -> bytes:
    """Return a binary glTF of one mesh without normals, which the browser computes.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        colors: [V, 3] sRGB.
        opacity: 0 to 1.
    """
    rgba = np.full((len(vertices), 4), 65535, dtype=np.uint16)  # 8 bits are too few for dark linear colours
    rgba[:, :3] = np.rint(65535 * from_srgb(colors))
    builder = GlbBuilder()
    attributes = {
        "POSITION": builder.array(vertices, target=ARRAY_BUFFER, bounds=True),
        "COLOR_0": builder.array(rgba, "uint16", target=ARRAY_BUFFER, normalized=True),
    }
    indices = builder.array(faces.reshape(-1), "uint32", target=ELEMENT_ARRAY_BUFFER)
    material = builder.add(
        "materials",
        pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, opacity], "metallicFactor": 0, "roughnessFactor": 0.8},
        alphaMode="OPAQUE" if opacity >= 1 else "BLEND",
    )
    mesh = builder.add("meshes", primitives=[{"attributes": attributes, "indices": indices, "material": material}])
    builder.root["scene"] = builder.add("scenes", nodes=[builder.add("nodes", mesh=mesh)])
    return builder.to_bytes()
