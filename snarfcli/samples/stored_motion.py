"""Read the motion of a sequence of processed samples, for avatars whose skeleton the built-in motions do not fit."""

from __future__ import annotations

import logging

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError, nearest
from snarfcli.motions import Motion
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.texts import one_line

__all__ = ["stored_motion"]

log = logging.getLogger(__name__)

_LISTED, _LONGEST_NAME = 12, 60
_TOLERANCE = 1e-3  # of the entries of a bone transform (metres, rotation): poses within it reproduce the transforms


def stored_motion(
    root: str, data: str, subject: str, name: str | None, skeleton: Skeleton
) -> tuple[Motion, NDArray[np.float32] | None]:
    """Return the motion of one sequence: poses and, if they do not reproduce them, bone transforms.

    Args:
        root: the data folder.
        data: name of the data set.
        subject: name of the subject.
        name: name of the sequence; None for the first held-out one, or the first of all.
        skeleton: skeleton of the avatar.

    Returns:
        motion: poses and translation.
        bone_transforms: [T, J, 4, 4], canonical to posed, metres, if the joints stretch; else None.

    Raises:
        UserError: the samples are missing, have another skeleton, or no sequence of this name.
    """
    try:
        store = SampleStore.open(root, data, subject)
    except UserError as error:
        raise UserError(f"no motion for this skeleton ({error}); or give a motion by --pose FILE") from None
    if (store.skeleton.names, store.skeleton.parents) != (skeleton.names, skeleton.parents):
        raise UserError(f"the samples in {store.folder} are of another skeleton than the avatar; give a motion by --pose FILE")
    sequence = _choose(store, name)
    steps = np.diff(sequence.frame_numbers)
    rate = sequence.frame_rate / (float(np.median(steps)) if len(steps) else 1.0)
    poses, translation = sequence.poses.astype(np.float64), sequence.translation.astype(np.float64)
    again = skeleton.posed_from_canonical(torch.from_numpy(poses), torch.from_numpy(translation)).numpy()
    apart = np.abs(again - sequence.bone_transforms).max()
    return Motion(sequence.name, poses, translation, rate), sequence.bone_transforms if apart > _TOLERANCE else None


def _choose(store: SampleStore, name: str | None) -> SequenceSamples:
    """Return the sequence of a name; None for the first in the order test, ood, train."""
    sequences = sorted(store.all_sequences, key=lambda sequence: ("test", "ood", "train").index(sequence.split))
    known = [sequence.name for sequence in sequences]
    if name is None:
        if others := known[1:]:
            more = f" and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
            listed = ", ".join(one_line(other, _LONGEST_NAME) for other in others[:_LISTED])
            log.info("motion=%s is taken; there are also %s%s", one_line(known[0], _LONGEST_NAME), listed, more)
        return sequences[0]
    if name not in known:
        raise UserError(f"the samples have no sequence '{name}'{nearest(name, known)}; there is {', '.join(known)}")
    return sequences[known.index(name)]
