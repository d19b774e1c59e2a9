"""Work that is done many times, to see whether the memory and the open files of the process grow.

Each function does its work `count` times, in a folder, and calls `tick` after each time.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from snarfcli import Avatar
from snarfcli.cli.main import main
from snarfcli.commands import animate
from snarfcli.datasets import builtin
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.models.fast_snarf import FoundRoots
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.writing import SequenceWriter
from snarfcli.sampling import SamplingSettings

__all__ = ["WORK", "Usage", "count_handles", "resident_bytes", "watch"]

AVATAR = Path(__file__).parent / "golden" / "avatar.pt"
_SHARES = (0.1, 0.5, 1.0)

Work = Callable[[int, Path, Callable[[], None]], None]


@dataclass(frozen=True)
class Usage:
    """What a process uses after a share of its work."""

    share: float
    memory: int
    """Resident memory, bytes."""
    handles: int
    """Number of open files."""


def count_handles() -> int:
    """Return the number of open files of this process."""
    folder = "/proc/self/fd" if Path("/proc/self/fd").is_dir() else "/dev/fd"
    return len(os.listdir(folder)) - 1  # one is open on the folder itself


def resident_bytes() -> int:
    """Return the memory of this process that is in use, bytes; Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def watch(work: Work, count: int, folder: Path, shares: tuple[float, ...] = _SHARES) -> list[Usage]:
    """Do the work and return what the process used after shares of it."""
    done, seen = 0, []
    wanted = {max(1, round(share * count)): share for share in shares}

    def tick() -> None:
        nonlocal done
        done += 1
        if done in wanted:
            gc.collect()
            seen.append(Usage(wanted[done], resident_bytes(), count_handles()))

    work(count, folder, tick)
    assert len(seen) == len(wanted), f"ticked {done} times instead of {count}"
    return seen


def preprocess(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Frames of the built-in subject 50002, at most 5,760, with 80 points each."""
    subject = builtin.load("50002", Request(DataConfig("builtin", 1, 1, 1), folder))
    names, frames = [], 0
    for spec in subject.sequences:
        if frames < count:
            names.append(spec.name)
            frames += len(spec.motion.poses)
    write = SequenceWriter.write_frame

    def counted(*arguments: Any) -> None:
        write(*arguments)
        tick()

    steps: dict[str, int] = dict.fromkeys(("train", "test", "ood"), frames // count)
    with mock.patch.object(SequenceWriter, "write_frame", counted):
        preprocess_subject(subject, folder, SamplingSettings(80, 0.01, 0.1, "winding", 0), steps, sequences=names)


def animation(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Frames of `snarf animate`, with meshes of 24 voxels and a video of 64 pixels."""
    joints = Avatar.load(AVATAR).skeleton.num_joints
    swing = np.sin(np.arange(count) / 10)[:, None] * np.linspace(0, 0.5, 3 * joints)
    np.savez(folder / "swing.npz", poses=swing, trans=np.zeros((count, 3)), mocap_framerate=30.0, up="y")
    pictures = animate.make_pictures

    def counted(*arguments: Any, **more: Any) -> Iterator[np.ndarray | None]:
        for picture in pictures(*arguments, **more):
            yield picture
            tick()

    settings = {"ckpt": AVATAR, "pose": folder / "swing.npz", "output": folder / "animation", "resolution": 24}
    settings |= {"video_size": 64, "processes": 1, "keep_share": 0}
    with mock.patch.object(animate, "make_pictures", counted):
        code = main(["animate", *(f"{name}={value}" for name, value in settings.items())])
    assert code == 0


def occupancies(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Calls of `Avatar.occupancy` with 100 points, in changing poses."""
    avatar = Avatar.load(AVATAR)
    generator = torch.Generator().manual_seed(0)
    for _ in range(count):
        avatar.occupancy(torch.randn(1, 100, 3, generator=generator), _pose(avatar, generator))
        tick()


def million_points(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Calls of `Avatar.occupancy` with a million points."""
    avatar = Avatar.load(AVATAR)
    generator = torch.Generator().manual_seed(0)
    for _ in range(count):
        avatar.occupancy(torch.rand(1, 1_000_000, 3, generator=generator) - 0.5, _pose(avatar, generator))
        tick()


def meshes(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Calls of `Avatar.mesh` with 16 voxels, by turns for both surfaces."""
    avatar = Avatar.load(AVATAR)
    generator = torch.Generator().manual_seed(0)
    for number in range(count):
        avatar.mesh(_pose(avatar, generator)[0], resolution=16, surface=("field", "skinned")[number % 2])
        tick()


def searches(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Searches for the correspondences of 100 points, with gradients."""
    avatar = Avatar.load(AVATAR)
    generator = torch.Generator().manual_seed(0)
    avatar.model.train()
    for _ in range(count):
        transforms = avatar.bone_transforms(_pose(avatar, generator))
        found = avatar.model.find(torch.randn(1, 100, 3, generator=generator), transforms, _pose(avatar, generator))
        assert isinstance(found, FoundRoots)
        found.roots.canonical.sum().backward()
        tick()


def loading(count: int, folder: Path, tick: Callable[[], None]) -> None:
    """Avatars that are loaded and saved."""
    for _ in range(count):
        Avatar.load(AVATAR).save(folder / "avatar.pt")
        tick()


def _pose(avatar: Avatar, generator: torch.Generator) -> torch.Tensor:
    return 0.2 * torch.randn(1, avatar.skeleton.num_joints, 3, generator=generator)


WORK: dict[str, tuple[Work, int]] = {
    "preprocess": (preprocess, 5_000),
    "animate": (animation, 2_000),
    "million points": (million_points, 20),
    "occupancy": (occupancies, 10_000),
    "mesh": (meshes, 1_000),
    "search": (searches, 10_000),
    "load": (loading, 1_000),
}
"""The kinds of work by name, with how often `tools/trust_memory.py` does them."""
