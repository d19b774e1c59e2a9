"""The motion of a sequence of processed samples, to animate an avatar with that has no motions of its own."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError, nearest
from snarfcli.motions import Motion
from snarfcli.samples.store import SampleStore, SequenceSamples

__all__ = ["stored_motion"]

_APART = 1e-3  # of a bone transform's numbers, metres and turns: poses that come nearer say the same


def stored_motion(
    root: str, data: str, subject: str, name: str | None, skeleton: Skeleton
) -> tuple[Motion, NDArray[np.float32] | None]:
    """Return the motion of one sequence: poses and, where they do not say it all, bone transforms.

    Args:
        root: the data folder.
        data, subject: whose samples.
        name: which sequence; None for the first that is held out, or else the first.
        skeleton: the avatar's.

    Returns:
        The motion, and its bone transforms [T, J, 4, 4], canonical to posed, metres, if the joints stretch; else None.

    Raises:
        UserError: there are no samples, they are of another skeleton, or have no sequence of this name.
    """
    try:
        store = SampleStore.open(root, data, subject)
    except UserError as error:
        raise UserError(f"no motion for this skeleton ({error}); or give a motion of its own by --pose FILE") from None
    if (store.skeleton.names, store.skeleton.parents) != (skeleton.names, skeleton.parents):
        raise UserError(f"the samples in {store.folder} are of another skeleton than the avatar; give a motion by --pose FILE")
    sequence = _choose(store, name)
    steps = np.diff(sequence.frame_numbers)
    rate = sequence.frame_rate / (float(np.median(steps)) if len(steps) else 1.0)
    poses, translation = sequence.poses.astype(np.float64), sequence.translation.astype(np.float64)
    again = skeleton.posed_from_canonical(torch.from_numpy(poses), torch.from_numpy(translation)).numpy()
    apart = np.abs(again - sequence.bone_transforms).max()
    return Motion(sequence.name, poses, translation, rate), sequence.bone_transforms if apart > _APART else None


def _choose(store: SampleStore, name: str | None) -> SequenceSamples:
    """Return a sequence by its name, or the first one of the held-out ones, the others, those for training."""
    sequences = sorted(store.all_sequences, key=lambda sequence: ("test", "ood", "train").index(sequence.split))
    if name is None:
        return sequences[0]
    known = [sequence.name for sequence in sequences]
    if name not in known:
        raise UserError(f"the samples have no sequence '{name}'{nearest(name, known)}; there is {', '.join(known)}")
    return sequences[known.index(name)]
