"""Meshes with a colour at each vertex, as bytes of a small .glb: viser's own meshes have one colour only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.export.glb import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbBuilder
from snarfcli.meshing.colors import from_srgb

__all__ = ["colored_glb"]


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
    rgba = np.full((len(vertices), 4), 65535, dtype=np.uint16)  # not 8 bits: linear colours, as glTF has them, are dark
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
