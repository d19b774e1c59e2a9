"""What every stage gets: device, sizes, packed files, time, and where results go."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from gpu_checks.report import Section
from gpu_checks.scene_cases import Scenes
from gpu_checks.timing import Clock
from snarfcli.avatar import Avatar

__all__ = ["AVATARS", "PRECISIONS", "Context"]

AVATARS = ("quick", "paper")
"""Avatars of the pack, by the preset whose networks they have."""
PRECISIONS = {"highest": "float32", "high": "TF32", "bfloat16": "bfloat16"}
"""Precisions of the shape network, and what they are on a GPU."""


@dataclass
class Context:
    """One stage's surroundings."""

    device: torch.device
    tiny: bool
    """Whether sizes are such that a CPU runs everything in a minute."""
    pack: Path
    """Folder made by pack_gpu_check.py."""
    work: Path
    """Folder for runs, kept between stages and calls."""
    section: Section
    seconds: float
    """Time limit of the stage."""
    resume: bool = False
    """Whether a training run that was stopped continues."""
    started: float = field(default_factory=time.monotonic)

    @cached_property
    def clock(self) -> Clock:
        """Measures on the device."""
        return Clock(self.device)

    @cached_property
    def scenes(self) -> Scenes:
        """The packed scenes on the device."""
        return Scenes.load(self.pack / "scenes.pt", self.device)

    @cached_property
    def subject(self) -> str:
        """Name of the packed subject, the only one in the pack."""
        return next(path.parent.name for path in (self.pack / "data").glob("processed/builtin/*/manifest.json"))

    @property
    def left(self) -> float:
        """Seconds until the time limit."""
        return self.seconds - (time.monotonic() - self.started)

    def size(self, number: int, tiny: int) -> int:
        """Return a size: `number`, or `tiny` in a dry run."""
        return tiny if self.tiny else number

    def avatar(self, name: str) -> Avatar:
        """Return one of the packed avatars, `AVATARS`, on the device."""
        return Avatar.load(self.pack / "avatars" / f"{name}.pt", self.device)
