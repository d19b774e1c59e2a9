"""Vertices, weights and rotations as numbers of 8 and 16 bits.

Source: Khronos, KHR_mesh_quantization, and glTF 2.0, 3.6.2.2 (normalised integers: an int16 i is the number i / 32767).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.export.character import Character

__all__ = ["QUANTIZATION", "StoredCube", "shares", "signed_bytes", "signed_shares"]

QUANTIZATION = "KHR_mesh_quantization"
"""Name of the extension that allows these types for vertices."""

_INT8, _INT16, _UINT16 = 127, 32767, 65535


@dataclass(frozen=True, eq=False)
class StoredCube:
    """The cube in which places are stored: each coordinate is from -1 to 1 in it, in steps of 1/32767."""

    middle: NDArray[np.float64]
    """[3] metres."""
    half_m: float
    """Half of its edge, metres. A step of 1 m / 32767 is 0.03 mm."""

    @classmethod
    def around(cls, character: Character) -> StoredCube:
        """Return the cube that holds the vertices of a character, and is as large as their moves."""
        low, high = character.mesh.vertices.min(0).astype(np.float64), character.mesh.vertices.max(0).astype(np.float64)
        moves = np.abs(character.shapes.targets).max() if len(character.shapes.targets) else 0.0
        return cls((low + high) / 2, float(max((high - low).max() / 2, moves, 1e-6)))

    @property
    def metres_from_stored(self) -> NDArray[np.float64]:
        """[4, 4] transform from numbers of the file to metres. Skinned vertices need it in their inverse bind matrices."""
        matrix = np.diag([self.half_m, self.half_m, self.half_m, 1.0])
        matrix[:3, 3] = self.middle
        return matrix

    def places(self, vertices: NDArray) -> NDArray[np.int16]:
        """Return places [V, 3], metres, as they are stored."""
        return signed_shares((vertices - self.middle) / self.half_m)

    def moves(self, vectors: NDArray) -> NDArray[np.int16]:
        """Return differences of places [V, 3], metres, as they are stored."""
        return signed_shares(vectors / self.half_m)


def signed_shares(values: NDArray) -> NDArray[np.int16]:
    """Return numbers from -1 to 1 in 16 bits."""
    return np.rint(np.clip(values, -1, 1) * _INT16).astype(np.int16)


def signed_bytes(values: NDArray) -> NDArray[np.int8]:
    """Return numbers from -1 to 1 in 8 bits, enough for directions: a step is half a degree. Larger ones are cut."""
    return np.rint(np.clip(values, -1, 1) * _INT8).astype(np.int8)


def shares(weights: NDArray) -> NDArray[np.uint16]:
    """Return weights [V, K], whose rows sum to 1, in 16 bits: rows sum to 65535; the largest weight takes the rounding."""
    stored = np.rint(weights.astype(np.float64).clip(0, 1) * _UINT16).astype(np.int64)
    rows = np.arange(len(stored))
    stored[rows, stored.argmax(1)] += _UINT16 - stored.sum(1)
    return stored.astype(np.uint16)
