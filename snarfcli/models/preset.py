"""Preset skinning weights, read from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from snarfcli.array_files import read_npz
from snarfcli.deformer import CanonicalGrid, PresetWeights
from snarfcli.errors import UserError

__all__ = ["read_preset_weights"]


def read_preset_weights(path: str | Path, grid: CanonicalGrid, shape: tuple[int, int, int], num_bones: int) -> PresetWeights:
    """Read the skinning weights of a mesh and diffuse them into the grid.

    Args:
        path: .npz file with `vertices` [V, 3], canonical pose of the subject, metres, and `weights` [V, J].
        grid: canonical box around the body, metres.
        shape: number of grid nodes (D, H, W), along z, y and x.
        num_bones: J, number of bones.

    Raises:
        UserError: the file is missing or damaged, or an array is missing or does not fit the subject.
    """
    arrays = read_npz(path, "weights file")
    for name, size in (("vertices", 3), ("weights", num_bones)):
        if name not in arrays:
            found = ", ".join(sorted(arrays)) or "none"
            raise UserError(f"weights file {path}: wanted the arrays vertices and weights, got {found}")
        array = arrays[name]
        if array.ndim != 2 or array.shape[1] != size or array.dtype.kind not in "fiu":
            raise UserError(f"weights file {path}: {name}: wanted numbers [V, {size}], got {array.dtype} {list(array.shape)}")
    vertices, weights = (torch.as_tensor(arrays[name].astype(np.float64)) for name in ("vertices", "weights"))
    try:
        return PresetWeights.from_vertices(vertices, weights, grid, shape)
    except ValueError as error:
        raise UserError(f"weights file {path}: {error}") from None
