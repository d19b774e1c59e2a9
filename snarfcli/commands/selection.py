"""What several commands let people choose: whose avatar, and which frames of a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from snarfcli.avatar import Avatar
from snarfcli.bodies import Skeleton
from snarfcli.checks import check_choice, check_number
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, Motion, builtin_motion, read_motion
from snarfcli.motions.layouts import HANDS, SMPL, layout_of
from snarfcli.motions.up_axis import UPS
from snarfcli.runs import choose_device, find_avatar, run_folder, set_threads
from snarfcli.samples.stored_motion import stored_motion

__all__ = [
    "BUILTIN_MOTIONS",
    "AvatarSelection",
    "MotionSelection",
    "SelectedMotion",
    "check_motion_selection",
    "load_selected_avatar",
    "select_motion",
]

_MOTION = "jumping_jacks"
BUILTIN_MOTIONS = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)
"""Names of the motions that need no file."""
_FRAME_RATES = (1.0, 1000.0)


@dataclass
class AvatarSelection:
    """Whose avatar, and where it computes."""

    subject: str = MISSING
    """Whose avatar, such as 50002."""
    data: DataConfig = MISSING
    """Which data the avatar was trained on."""
    data_root: str = MISSING
    """Folder with the processed samples, whose motions are for skeletons that the built-in ones do not fit."""
    output_root: str = MISSING
    """Folder with the runs; the avatar is <output_root>/<data>/<subject>/<run>/avatar.pt."""
    run: str = MISSING
    """Name of the run."""
    ckpt: str | None = MISSING
    """Avatar file or run folder to use instead; results go beside it."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null leaves PyTorch's choice."""


@dataclass
class MotionSelection:
    """How a motion is read, and which part of it is taken."""

    up: str = MISSING
    """Which way is up in the pose file: auto, y or z."""
    hands: str = MISSING
    """SMPL's hand joints where the pose file has fingers: rest (straight) or released (as the released code took them)."""
    mapping: str | None = MISSING
    """For .bvh and .glb: JSON file {joint of the avatar: joint of the pose file}; null goes by the usual names."""
    clip: str | None = MISSING
    """For .bvh and .glb: name or number of the animation; null for the first."""
    motion_seed: int = MISSING
    """Variant of the built-in motion."""
    motion_frame_rate: float = MISSING
    """Frames a second of the built-in motion."""
    start: int = MISSING
    """First frame."""
    stop: int | None = MISSING
    """Frame to stop before; null for the end."""
    step: int = MISSING
    """Take every so many frames; the pace stays."""
    frame_rate: float | None = MISSING
    """Resample what was taken to so many frames a second, at the same pace; null leaves the frames as they are."""
    max_frames: int | None = MISSING
    """Stop after so many frames; null for all."""
    in_place: bool = MISSING
    """Whether the body stays over one spot: the root keeps its height, but does not travel."""


@dataclass(frozen=True, eq=False)
class SelectedMotion:
    """The part of a motion that was asked for."""

    motion: Motion
    """Its frames, y up, resampled and in place if so wished."""
    whole: Motion
    """All that was read."""
    first: int
    """Number of the first frame in the whole motion."""
    numbers: list[int]
    """Number of each frame in the whole motion; of a resampled one, in what was made of it."""
    bone_transforms: NDArray[np.float32] | None = None
    """[T, J, 4, 4] canonical to posed, metres, where joints stretch so that the poses do not say it all; else None."""


def load_selected_avatar(choice: AvatarSelection) -> tuple[Avatar, Path]:
    """Load the avatar of a choice, on its device and with its threads; return it and its file.

    Raises:
        UserError: there is none, it cannot be used, or the device is not there; the message says what to do.
    """
    trained_on = choice.data.avatars or choice.data.name
    subject_folder = run_folder(choice.output_root, trained_on, choice.subject, choice.run).parent
    unknown = choice.data.name == "builtin" and choice.subject not in BUILTIN_SUBJECTS
    if unknown and choice.ckpt is None and not subject_folder.exists():
        builtin_subject(choice.subject)  # says which name is near
    path = find_avatar(choice.output_root, trained_on, choice.subject, choice.run, choice.ckpt)
    device = choose_device(choice.device)
    set_threads(choice.threads)
    return Avatar.load(path, device), path


def check_motion_selection(choice: MotionSelection) -> None:
    """Refuse, before any work starts, settings of a motion that cannot be used.

    Raises:
        UserError: for the first one.
    """
    for name, choices in (("up", UPS), ("hands", HANDS)):
        check_choice(name, getattr(choice, name), choices)
    for name, least in (("step", 1), ("max_frames", 1), ("motion_seed", 0)):
        check_number(name, getattr(choice, name), least)
    for name in ("motion_frame_rate", "frame_rate"):
        check_number(name, getattr(choice, name), *_FRAME_RATES)


def select_motion(
    choice: MotionSelection, avatar: AvatarSelection, skeleton: Skeleton, pose: str | None, motion: str | None
) -> SelectedMotion:
    """Read a motion and take the part of it that was asked for: first the frames, then their rate, then their number.

    Args:
        choice: how to read it, and which part.
        avatar: whose samples hold motions, for skeletons that the built-in ones do not fit.
        skeleton: whose poses are wanted.
        pose: motion file, or folder of frames; None for the built-in `motion`.
        motion: name of a built-in motion of SMPL's joints, or of a sequence of the samples of any other skeleton; None for
            jumping_jacks, or for the held-out sequence.

    Raises:
        UserError: there is no such motion, it does not fit the skeleton, or nothing of it is left.
    """
    whole, transforms = _read(choice, avatar, skeleton, pose, motion)
    numbers = list(range(*slice(choice.start, choice.stop, choice.step).indices(whole.num_frames)))
    if not numbers:
        stop = "null" if choice.stop is None else choice.stop
        raise UserError(
            f"start={choice.start}, stop={stop} leave no frame: {whole.name} has frames 0 to {whole.num_frames - 1}"
        )
    taken = replace(
        whole,
        poses=whole.poses[numbers],
        translation=whole.translation[numbers],
        frame_rate=whole.frame_rate / choice.step,
    )
    transforms = None if transforms is None else transforms[numbers]
    first = numbers[0]
    if choice.frame_rate is not None:
        if transforms is not None:
            raise UserError(f"frame_rate is for motions whose joints do not stretch, those of {whole.name} do; leave it out")
        taken = taken.resampled(choice.frame_rate)
        numbers = list(range(taken.num_frames))
    taken, numbers = taken.slice(stop=choice.max_frames), numbers[: choice.max_frames]
    transforms = None if transforms is None else transforms[: len(numbers)]
    if choice.in_place:
        way = taken.translation * (1.0, 0.0, 1.0)
        taken = replace(taken, translation=taken.translation - way)
        if transforms is not None:
            transforms = transforms.copy()
            transforms[:, :, :3, 3] -= way[:, None].astype(np.float32)
    return SelectedMotion(taken, whole, first, numbers, transforms)


def _read(
    choice: MotionSelection, avatar: AvatarSelection, skeleton: Skeleton, pose: str | None, name: str | None
) -> tuple[Motion, NDArray[np.float32] | None]:
    """Return the whole motion, with y up, and its bone transforms where the poses do not say it all."""
    if pose is not None:
        motion = read_motion(pose, skeleton, up=choice.up, hands=choice.hands, mapping=choice.mapping, clip=choice.clip)
        return motion, None
    is_smpl = layout_of(skeleton) == SMPL
    if not is_smpl and avatar.data.name != "builtin" and name not in BUILTIN_MOTIONS:
        return stored_motion(avatar.data_root, avatar.data.name, avatar.subject, name, skeleton)
    motion = builtin_motion(name or _MOTION, choice.motion_seed, frame_rate=choice.motion_frame_rate)
    if not is_smpl:
        raise UserError(
            f"motion {motion.name} is for SMPL's 24 joints, the avatar has {skeleton.num_joints} of another kind;"
            " give a motion of its own by --pose FILE, such as .bvh, .glb or .npz"
        )
    return motion, None
