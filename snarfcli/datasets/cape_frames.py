"""Read the registered meshes of CAPE, one file per frame. Worker processes import this file, so it does not import PyTorch."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import read_npz
from snarfcli.errors import UserError

__all__ = ["CapeMeshes", "read_cape_frame"]

_CHECKSUMS = 1024  # bytes; an .npz ends with the names, sizes and checksums of its arrays
_FRAME_SHAPES = {"v_posed": (None, 3), "pose": (72,), "transl": (3,)}


@dataclass(frozen=True, eq=False)
class CapeMeshes:
    """The registered meshes of one sequence at the origin, without the recorded translation."""

    paths: Sequence[Path]
    """T files, one per frame."""
    faces: NDArray[np.int32]
    """[F, 3], faces of SMPL."""

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> tuple[NDArray, NDArray]:
        frame = read_cape_frame(self.paths[index], int(self.faces.max()) + 1)
        return frame["v_posed"] - frame["transl"], self.faces

    def chosen(self, frames: NDArray[np.int64]) -> CapeMeshes:
        return CapeMeshes([self.paths[frame] for frame in frames], self.faces)

    def source(self, index: int) -> str:
        return str(self.paths[index])

    def fingerprint(self) -> str:
        digest = hashlib.sha256()
        for path in self.paths:
            with path.open("rb") as file:
                file.seek(max(0, path.stat().st_size - _CHECKSUMS))
                digest.update(path.name.encode() + file.read(_CHECKSUMS))
        return digest.hexdigest()[:16]


def read_cape_frame(path: Path, num_vertices: int) -> dict[str, NDArray[np.float64]]:
    """Return `v_posed` [V, 3] and `transl` [3], metres, and `pose` [72], radians, of one frame.

    Raises:
        UserError: the file cannot be read, lacks an array, or one does not fit.
    """
    arrays = read_npz(path, "CAPE frame", only=_FRAME_SHAPES)
    for name, wanted in _FRAME_SHAPES.items():
        shape = tuple(num_vertices if size is None else size for size in wanted)
        if name not in arrays:
            raise UserError(f"CAPE frame {path} has no '{name}'; wanted {', '.join(_FRAME_SHAPES)}; unpack the archive again")
        array = arrays[name]
        if array.dtype.kind not in "fiu" or array.shape != shape or not np.isfinite(array).all():
            wanted = f"finite numbers of shape {list(shape)}"
            raise UserError(f"CAPE frame {path}: {name}: wanted {wanted}, got {list(array.shape)}; unpack the archive again")
    return {name: arrays[name].astype(np.float64) for name in _FRAME_SHAPES}
