"""Settings of the fit of a subject."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from snarfcli.scanned_subjects.fitter import BodyChoice

__all__ = ["FitOptions"]


@dataclass(frozen=True)
class FitOptions:
    """Settings of a fit."""

    body: BodyChoice
    """Which body."""
    scale: str = "auto"
    """Metres per unit of the files: auto, or a number."""
    up: str = "auto"
    """Up axis of the files: auto, y or z."""
    clothes_m: float = 0.0
    """How far the body may be below the surface of the scans, metres."""
    points_per_frame: int = 4000
    """Maximum number of points of a frame."""
    ordered: str = "auto"
    """Whether neighbouring frames show a motion: auto, true or false."""
    frame_rate: float = 30.0
    """Frames per second, as the pose files say."""
    seed: int = 0
    """Of the points that are chosen."""
    workers: int = 1
    """Number of processes."""
    overwrite: bool = False
    """Replace existing skeleton and pose files."""
    skip_broken: bool = False
    """Frames that cannot be read become frames that are not trusted, instead of an error."""
    wait: bool = False
    """Wait while another process works on the subject."""

    def recorded(self) -> dict[str, Any]:
        """Return the settings that the poses depend on."""
        return {
            "body": self.body.body,
            "gender": self.body.gender,
            "skeleton": self.body.skeleton,
            "scale": self.scale,
            "up": self.up,
            "clothes_m": self.clothes_m,
            "points_per_frame": self.points_per_frame,
            "ordered": self.ordered,
            "frame_rate": self.frame_rate,
            "seed": self.seed,
        }
