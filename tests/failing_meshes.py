"""Meshes for tests of broken sequences, in a module of few imports: worker processes import it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError

if TYPE_CHECKING:
    from snarfcli.datasets.posed_meshes import PosedMeshes


class FailingMeshes:
    """Meshes of which one cannot be read, as when its file is damaged."""

    def __init__(self, meshes: PosedMeshes, bad: int, frames: NDArray[np.integer] | None = None) -> None:
        self.meshes, self.bad = meshes, bad
        self.frames = np.arange(len(meshes)) if frames is None else frames  # of all meshes

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[NDArray[np.floating], NDArray[np.integer]]:
        if self.frames[index] == self.bad:
            raise UserError(f"mesh {self.bad:06d}.obj is damaged")
        return self.meshes[index]

    def chosen(self, frames: NDArray[np.integer]) -> FailingMeshes:
        return FailingMeshes(self.meshes.chosen(frames), self.bad, self.frames[frames])

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""
