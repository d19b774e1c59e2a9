"""Settings that several commands share: the avatar, and the frames of a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

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
from snarfcli.motions.rig_rest import check_rest
from snarfcli.motions.up_axis import UPS, Up
from snarfcli.precision import PRECISIONS
from snarfcli.runs import choose_device, find_avatar, run_folder, set_threads
from snarfcli.samples.stored_motion import stored_motion

__all__ = [
    "BUILTIN_MOTIONS",
    "AvatarSelection",
    "MotionSelection",
    "SelectedMotion",
    "check_motion_selection",
    "load_selected_avatar",
    "select_frames",
    "select_motion",
]

_MOTION = "jumping_jacks"
BUILTIN_MOTIONS = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)
"""Names of the motions that need no file."""
_FRAME_RATES = (1.0, 1000.0)


@dataclass
class AvatarSelection:
    """Settings that select an avatar and the device it runs on."""

    subject: str = MISSING
    """Subject of the avatar, such as 50002."""
    data: DataConfig = MISSING
    """Data set that the avatar was trained on."""
    data_root: str = MISSING
    """Folder of processed samples; their motions are used for skeletons other than SMPL."""
    output_root: str = MISSING
    """Folder with the runs; the avatar is <output_root>/<data>/<subject>/<run>/avatar.pt."""
    run: str = MISSING
    """Name of the run."""
    ckpt: str | None = MISSING
    """Avatar file, or folder of a run or of Avatar.save_pretrained, to use instead; results are written beside it."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null keeps PyTorch's choice."""
    precision: str = "high"
    """Precision of the shape network on a GPU: highest (float32), high or medium (TF32: vertices move by at most 0.05 mm on
    average) or bfloat16 (0.4 mm). On a CPU the native library computes in float32."""


@dataclass
class MotionSelection:
    """Settings that say how a motion is read, and which frames of it are used."""

    up: str = MISSING
    """Up axis of the pose file: auto, y, z, x, or -y (the frame of a camera), -z, -x."""
    hands: str = MISSING
    """SMPL's hand joints if the pose file has fingers: rest (straight), or released (as in the papers' code)."""
    rest: str = MISSING
    """For files with joints of their own (.bvh, .glb, .vrm, SAM 3D Body): rest pose to compare with the avatar's: auto, file,
    clip (all frames), or the number of a frame."""
    mapping: str | None = MISSING
    """For such files: JSON file {joint of the avatar: joint of the pose file}; null matches common joint names."""
    clip: str | None = MISSING
    """Name or number of the animation (.bvh, .glb), or of the person in a video's results; null for the first."""
    motion_seed: int = MISSING
    """Seed of the built-in motion; each seed gives another variant."""
    motion_frame_rate: float = MISSING
    """Frames per second of the built-in motion."""
    start: int = MISSING
    """First frame."""
    stop: int | None = MISSING
    """Frame after the last one; null for the end."""
    step: int = MISSING
    """Keep every n-th frame; playback speed is unchanged."""
    frame_rate: float | None = MISSING
    """Resample to this number of frames per second, at the same playback speed; null keeps the frames."""
    max_frames: int | None = MISSING
    """Maximum number of frames; null for all."""
    in_place: bool = MISSING
    """Keep the body in one place: the root moves up and down only."""


@dataclass(frozen=True, eq=False)
class SelectedMotion:
    """The selected frames of a motion."""

    motion: Motion
    """The selected frames, y up, resampled and in place if requested."""
    whole: Motion
    """All frames that were read."""
    first: int
    """Number of the first selected frame in the whole motion."""
    numbers: list[int]
    """Number of each frame in the whole motion; if resampled, in the resampled one."""
    bone_transforms: NDArray[np.float32] | None = None
    """[T, J, 4, 4], canonical to posed, metres, if joints stretch (which poses cannot express); otherwise None."""


def load_selected_avatar(choice: AvatarSelection) -> tuple[Avatar, Path]:
    """Load the selected avatar on its device; return it and its file. Sets the number of threads.

    Raises:
        UserError: the avatar does not exist or cannot be used, the device does not exist, or the precision is unknown.
    """
    check_choice("precision", choice.precision, PRECISIONS)
    trained_on = choice.data.avatars or choice.data.name
    subject_folder = run_folder(choice.output_root, trained_on, choice.subject, choice.run).parent
    unknown = choice.data.name == "builtin" and choice.subject not in BUILTIN_SUBJECTS
    if unknown and choice.ckpt is None and not subject_folder.exists():
        builtin_subject(choice.subject)  # raises, with the most similar name
    path = find_avatar(choice.output_root, trained_on, choice.subject, choice.run, choice.ckpt)
    device = choose_device(choice.device)
    set_threads(choice.threads)
    return Avatar.load(path, device).with_precision(choice.precision), path


def check_motion_selection(choice: MotionSelection) -> None:
    """Check the settings of a motion before any work starts.

    Raises:
        UserError: a setting cannot be used.
    """
    for name, choices in (("up", UPS), ("hands", HANDS)):
        check_choice(name, getattr(choice, name), choices)
    check_rest(choice.rest)
    for name, least in (("step", 1), ("max_frames", 1), ("motion_seed", 0)):
        check_number(name, getattr(choice, name), least)
    for name in ("motion_frame_rate", "frame_rate"):
        check_number(name, getattr(choice, name), *_FRAME_RATES)


def select_motion(
    choice: MotionSelection, avatar: AvatarSelection, skeleton: Skeleton, pose: str | None, motion: str | None
) -> SelectedMotion:
    """Read a motion and select frames, see `select_frames`.

    Args:
        choice: how to read it, and which frames.
        avatar: selects the samples that hold motions for skeletons other than SMPL.
        skeleton: the skeleton of the avatar, which the poses are made for.
        pose: motion file, or folder of frames; None for the built-in `motion`.
        motion: name of a built-in motion (SMPL) or of a sequence of the samples (other skeletons); None for jumping_jacks
            or the held-out sequence.

    Raises:
        UserError: the motion does not exist, does not fit the skeleton, or no frame is left.
    """
    return select_frames(choice, *_read(choice, avatar, skeleton, pose, motion))


def select_frames(
    choice: MotionSelection, whole: Motion, transforms: NDArray[np.float32] | None = None, *, up: str = "y"
) -> SelectedMotion:
    """Select frames of a motion: start, stop and step are applied first, then frame_rate, then max_frames.

    Args:
        choice: which frames.
        whole: all frames.
        transforms: [T, J, 4, 4], canonical to posed, if joints stretch; otherwise None.
        up: up axis of the motion, y or z, for in_place.

    Raises:
        UserError: no frame is left, or the motion cannot be resampled.
    """
    numbers = list(range(*slice(choice.start, choice.stop, choice.step).indices(whole.num_frames)))
    if not numbers:
        stop = "null" if choice.stop is None else choice.stop
        raise UserError(
            f"start={choice.start}, stop={stop} leave no frame; {whole.name} has frames 0 to {whole.num_frames - 1}"
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
            raise UserError(f"frame_rate: wanted a motion whose joints do not stretch, got {whole.name}; leave frame_rate out")
        taken = taken.resampled(choice.frame_rate)
        numbers = list(range(taken.num_frames))
    taken, numbers = taken.slice(stop=choice.max_frames), numbers[: choice.max_frames]
    transforms = None if transforms is None else transforms[: len(numbers)]
    if choice.in_place:
        way = taken.translation * ((1.0, 0.0, 1.0) if up == "y" else (1.0, 1.0, 0.0))
        taken = replace(taken, translation=taken.translation - way)
        if transforms is not None:
            moved = transforms.copy()
            moved[:, :, :3, 3] -= way[:, None].astype(np.float32)
            transforms = moved
    return SelectedMotion(taken, whole, first, numbers, transforms)


def _read(
    choice: MotionSelection, avatar: AvatarSelection, skeleton: Skeleton, pose: str | None, name: str | None
) -> tuple[Motion, NDArray[np.float32] | None]:
    """Return the whole motion, y up, and its bone transforms if joints stretch."""
    if pose is not None:
        if not Path(pose).exists():
            raise UserError(f"no pose file at {pose}; give the path of one, or motion=NAME for a motion that needs no file")
        motion = read_motion(
            pose,
            skeleton,
            up=cast(Up, choice.up),
            hands=choice.hands,
            rest=choice.rest,
            mapping=choice.mapping,
            clip=choice.clip,
        )
        return motion, None
    is_smpl = layout_of(skeleton) == SMPL
    if not is_smpl and avatar.data.name != "builtin" and name not in BUILTIN_MOTIONS:
        return stored_motion(avatar.data_root, avatar.data.name, avatar.subject, name, skeleton)
    motion = builtin_motion(name or _MOTION, choice.motion_seed, frame_rate=choice.motion_frame_rate)
    if not is_smpl:
        raise UserError(
            f"motion: wanted one for the avatar's {skeleton.num_joints} joints, got {motion.name}, which is for SMPL's 24; "
            "give a motion file by --pose FILE, such as .bvh, .glb or .npz"
        )
    return motion, None
