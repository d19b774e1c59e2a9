"""The true posed meshes of a chosen motion, where there are any: to be shown beside the avatar's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.avatar import Avatar
from snarfcli.bodies import Skeleton, builtin_body
from snarfcli.commands.selection import AvatarSelection, MotionSelection, SelectedMotion
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.datasets.clothed import ClothedBody, ClothedMeshes
from snarfcli.datasets.posed_meshes import BodyMeshes
from snarfcli.errors import UserError
from snarfcli.motions.layouts import SMPL, layout_of
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore

__all__ = ["StoredMeshes", "ground_truth_meshes"]

_MADE_FOR = "the built-in subjects (data=builtin, data=clothed) and sequences of samples have one"
_JOINTS_APART_M = 1e-3  # rest joints of one skeleton that was stored in float32


class StoredMeshes:
    """The posed meshes of a sequence of samples, at the frames of a motion made of it. Files are opened at the first one.

    Args:
        sequence: the samples.
        frames: [T] numbers of the frames.
        shifts: [T, 3] metres, how far each is moved.
    """

    def __init__(self, sequence: SequenceSamples, frames: list[int], shifts: NDArray[np.float64]) -> None:
        self.folder, self.description, self.frames, self.shifts = sequence.folder, sequence.description, frames, shifts
        self._sequence: SequenceSamples | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_sequence": None}  # mapped files do not travel

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[NDArray, NDArray]:
        if self._sequence is None:
            self._sequence = SequenceSamples(Path(self.folder), self.description)
        frame = self.frames[index]
        return self._sequence.vertices(frame) + self.shifts[index].astype(np.float32), self._sequence.faces(frame)


def ground_truth_meshes(
    choice: AvatarSelection, motion: MotionSelection, avatar: Avatar, chosen: SelectedMotion, pose: str | None
) -> StoredMeshes | BodyMeshes | ClothedMeshes:
    """Return the true posed mesh of each frame of a chosen motion.

    The bodies of the built-in subjects, bare and clothed, are known in every pose; a subject of another data set only in
    the frames of its samples.

    Args:
        choice: whose avatar.
        motion: how the motion was chosen.
        avatar: knows on which data it was trained.
        chosen: the motion.
        pose: the motion's file, if it has one.

    Raises:
        UserError: there is no truth for this avatar and motion; the message says for what there is.
    """
    data, subject = avatar.facts.get("data", choice.data.name), str(avatar.facts.get("subject", choice.subject))
    poses, translation = chosen.motion.poses, chosen.motion.translation
    if data in ("builtin", "clothed") and subject in BUILTIN_SUBJECTS:
        bare = builtin_subject(subject)
        if not _same_joints(bare.skeleton, avatar.skeleton):
            raise UserError(
                f"beside=[truth]: the avatar of subject {subject} has other joints than the built-in body; leave truth out"
            )
        body = builtin_body()
        if data == "builtin":
            return BodyMeshes(body, bare.betas, poses, translation)
        clothed = ClothedBody(body, bare)
        assert len(clothed.mesh.faces)  # the clothes are made here, in some seconds, and travel to other processes
        return ClothedMeshes(clothed, poses, translation)
    is_stored = pose is None and layout_of(avatar.skeleton) != SMPL and choice.data.name != "builtin"
    if not is_stored:
        played = "pose files" if pose is not None else "built-in motions"
        raise UserError(f"beside=[truth]: there is no ground truth of {played} for data={data}; {_MADE_FOR}; leave truth out")
    if motion.frame_rate is not None:
        raise UserError("beside=[truth]: the samples have no meshes between their frames; leave out frame_rate, or truth")
    store = SampleStore.open(choice.data_root, choice.data.name, choice.subject)
    [sequence] = [one for one in store.all_sequences if one.name == chosen.whole.name]
    shifts = translation - chosen.whole.translation[chosen.numbers]
    return StoredMeshes(sequence, list(chosen.numbers), shifts)


def _same_joints(one: Skeleton, other: Skeleton) -> bool:
    if one.names != other.names:
        return False
    return float((one.joints_rest.double() - other.joints_rest.double()).abs().max()) < _JOINTS_APART_M
