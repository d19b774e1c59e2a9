"""What a sequence is fitted from, and what is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.matches import Agreement
from snarfcli.registration.scan_points import ScanPoints

__all__ = ["Finder", "FittedSequence", "Found", "Scans"]

Array = NDArray[np.float64]


class Scans(Protocol):
    """The scans of one sequence, loaded frame by frame."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> ScanPoints: ...


class Found(Protocol):
    """A state, and how well it agrees with its scan."""

    @property
    def state(self) -> BodyState: ...
    @property
    def agreement(self) -> Agreement: ...


class Finder(Protocol):
    """Fits single frames, as `PoseFinder` does."""

    def find(
        self, scan: ScanPoints, *, betas: Array | None = None, clothes_m: float = 0.0, near: Sequence[BodyState] = ()
    ) -> Found: ...
    def recover(self, scan: ScanPoints, state: BodyState, *, clothes_m: float = 0.0) -> Found: ...


@dataclass(frozen=True)
class FittedSequence:
    """A body in all frames of a sequence."""

    poses: Array
    """[T, J, 3], axis-angle, radians."""
    translation: Array
    """[T, 3], metres."""
    betas: Array
    """[S], shape parameters."""
    residual_m: Array
    """[T], mean distance between body and points, metres, as in `Agreement`; between pairs of vertices for one topology."""
    objective: Array
    """[T], as in `Agreement`."""
    is_trusted: NDArray[np.bool_]
    """[T]."""
    reasons: tuple[str, ...]
    """Why a frame is not trusted; "" if it is."""
    unseen: NDArray[np.bool_]
    """[T, J], joints that the scan does not show; their rotations are what is usual."""
