"""Settings of a data set."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field

from omegaconf import MISSING

__all__ = ["DataConfig", "command_settings"]

_USUAL_ROOT = "data"  # in conf/


@dataclass
class DataConfig:
    """Name of the data set, folders, and sampling of frames."""

    name: str = MISSING
    """Name of the data set: builtin, clothed, amass, dfaust, poseprior, cape, meshes or stick2d."""
    frame_step: int = MISSING
    """Use every n-th frame of a training sequence."""
    test_frame_step: int = MISSING
    """Use every n-th frame of a held-out sequence."""
    ood_frame_step: int = MISSING
    """Use every n-th frame of an out-of-distribution sequence."""
    folder: str | None = None
    """Folder with the files; null searches below data_root."""
    avatars: str | None = None
    """Data set whose avatars are evaluated on this one; null for this data set."""
    test: list[str] = field(default_factory=list)
    """Names or patterns (such as walk*) of held-out sequences; empty for the split of the data set (amass, cape, meshes)."""
    ood: list[str] = field(default_factory=list)
    """Names or patterns of out-of-distribution sequences; empty for those of the data set (amass, cape, meshes)."""
    hands: str = "rest"
    """SMPL's hand joints for files with SMPL-H poses: rest (zero), or released (columns 66 to 72, as in the papers' code)."""
    scale: str = "auto"
    """Metres per unit of the files, for meshes; auto: 1 for a subject of a person's size, else what gives it that size."""
    up: str = "auto"
    """Up axis of the files: auto, y or z, for amass and meshes; also x, -x, -y or -z, for amass."""
    untrusted: bool = False
    """Use also frames whose pose file says that their poses are not to be trusted (snarf fit), for meshes."""
    canonical: str = "auto"
    """Canonical pose, for meshes: rest; legs_apart (SNARF's, if rest is a T-pose); auto (from the skeleton file, else rest)."""


def command_settings(data: DataConfig, subject: str, data_root: str) -> str:
    """Return the settings that name a subject on a command line, for messages that say what to do next."""
    words = [f"data={data.name}", f"subject={subject}"]
    usual = DataConfig()
    for name in ("folder", "scale", "up", "canonical", "untrusted"):
        if (value := getattr(data, name)) != getattr(usual, name):
            words.append(f"data.{name}={str(value).lower() if isinstance(value, bool) else value}")
    words += [f"data_root={data_root}"] if data_root != _USUAL_ROOT else []
    return shlex.join(words)
