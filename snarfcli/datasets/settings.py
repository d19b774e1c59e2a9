"""What can be chosen about a data set."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

__all__ = ["DataConfig"]


@dataclass
class DataConfig:
    """Which motions, and how densely they are taken."""

    name: str = MISSING
    """Name of the data set; builtin ships with the package."""
    frame_step: int = MISSING
    """Every how many frames of a training sequence one is taken."""
    test_frame_step: int = MISSING
    """The same for the held-out sequences."""
    ood_frame_step: int = MISSING
    """The same for the out-of-distribution sequences."""
