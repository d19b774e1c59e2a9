"""What can be chosen about a data set."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING

__all__ = ["DataConfig"]


@dataclass
class DataConfig:
    """Which data, and how densely it is taken."""

    name: str = MISSING
    """Name of the data set: builtin, clothed, dfaust, poseprior, cape, meshes or stick2d."""
    frame_step: int = MISSING
    """Every how many frames of a training sequence one is taken."""
    test_frame_step: int = MISSING
    """The same for the held-out sequences."""
    ood_frame_step: int = MISSING
    """The same for the out-of-distribution sequences."""
    folder: str | None = None
    """Folder with the files; null: they are looked for below data_root."""
    avatars: str | None = None
    """Data set whose avatars are evaluated on this one; null: its own."""
    test: list[str] = field(default_factory=list)
    """Names or patterns (such as walk*) of held-out sequences; empty: the data set's own split (cape, meshes)."""
    ood: list[str] = field(default_factory=list)
    """Names or patterns of out-of-distribution sequences; empty: the data set's own (cape, meshes)."""
    hands: str = "rest"
    """SMPL's two hand joints from SMPL-H poses: rest (straight), or released (columns 66 to 72, as in the papers' code)."""
    scale: str = "auto"
    """Metres a unit of the files, for meshes; auto: 1 for a subject as large as a person, else so that it becomes as large."""
    up: str = "auto"
    """Which way is up in the files of meshes: auto, y or z."""
    canonical: str = "auto"
    """Canonical pose, for meshes: rest, legs_apart (T-pose at rest: SNARF's), or auto: the skeleton file's, else rest."""
