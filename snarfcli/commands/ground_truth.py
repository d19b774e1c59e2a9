"""The ground-truth meshes of a selected motion, which `snarf animate beside=[truth]` shows."""

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

_AVAILABLE = "only built-in subjects (data=builtin, data=clothed) and sequences of samples have one"
_JOINTS_APART_M = 1e-3  # tolerance for rest joints stored in float32


class StoredMeshes:
    """The posed meshes of a stored sequence, at the frames of a motion. Files are opened on first use.

    Args:
        sequence: the samples.
        frames: [T], numbers of the frames in the sequence.
        shifts: [T, 3], metres, translation added to each mesh.
    """

    def __init__(self, sequence: SequenceSamples, frames: list[int], shifts: NDArray[np.float64]) -> None:
        self.folder, self.description, self.frames, self.shifts = sequence.folder, sequence.description, frames, shifts
        self._sequence: SequenceSamples | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_sequence": None}  # memory-mapped files cannot be pickled

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
    """Return the ground-truth mesh of each frame of a selected motion.

    The built-in subjects, bare and clothed, have one in every pose; subjects of other data sets only in the frames of their
    samples.

    Args:
        choice: settings that selected the avatar.
        motion: settings that selected the motion.
        avatar: the avatar, which records its training data.
        chosen: the motion.
        pose: the motion file, if there is one.

    Raises:
        UserError: this avatar and motion have no ground truth.
    """
    data, subject = avatar.facts.get("data", choice.data.name), str(avatar.facts.get("subject", choice.subject))
    poses, translation = chosen.motion.poses, chosen.motion.translation
    if data in ("builtin", "clothed") and subject in BUILTIN_SUBJECTS:
        bare = builtin_subject(subject)
        if not _same_joints(bare.skeleton, avatar.skeleton):
            raise UserError(
                f"beside=[truth]: the skeleton of avatar {subject} is not that of the built-in body; leave truth out"
            )
        body = builtin_body()
        if data == "builtin":
            return BodyMeshes(body, bare.betas, poses, translation)
        clothed = ClothedBody(body, bare)
        assert len(clothed.mesh.faces)  # makes the clothes now (some seconds), so that they are pickled for other processes
        return ClothedMeshes(clothed, poses, translation)
    is_stored = pose is None and layout_of(avatar.skeleton) != SMPL and choice.data.name != "builtin"
    if not is_stored:
        played = "pose files" if pose is not None else "built-in motions"
        raise UserError(f"beside=[truth]: {played} have no ground truth with data={data}: {_AVAILABLE}; leave truth out")
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
