"""Compute the per-frame arrays of a sequence: poses, bone transforms and joints of the sampled frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from snarfcli.bodies import Skeleton, invert_rigid
from snarfcli.datasets.subjects import SequenceSpec
from snarfcli.errors import UserError

__all__ = ["frame_arrays", "frame_numbers"]


def frame_numbers(spec: SequenceSpec, frame_steps: Mapping[str, int]) -> np.ndarray:
    """Return the indices [T] of the frames to sample.

    Args:
        spec: the sequence.
        frame_steps: per split, the step between sampled frames; ignored if the data set has chosen the frames.
    """
    return spec.every(frame_steps[spec.split])


def frame_arrays(skeleton: Skeleton, spec: SequenceSpec, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays of `frames.npz` that depend on the motion only.

    Args:
        skeleton: skeleton of the subject.
        spec: the sequence.
        frames: [T], indices of the sampled frames.

    Returns:
        poses: [T, J, 3], float32, axis-angle, radians.
        translation: [T, 3], float32, metres.
        posed_from_canonical: [T, J, 4, 4], float32, bone transforms, metres.
        joints: [T, J, 3], float32, posed joints, metres.
        frame_numbers: [T], the frames.

    Raises:
        UserError: a value is not finite.
    """
    skeleton = skeleton.to(torch.float64)
    pose = torch.from_numpy(spec.motion.poses[frames])
    translation = torch.from_numpy(spec.motion.translation[frames])
    if spec.posed_from_rest is None:
        posed_from_rest = skeleton.posed_from_rest(pose, translation)
    else:
        posed_from_rest = torch.from_numpy(spec.posed_from_rest[frames])
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])
    joints = torch.einsum("tjrc,jc->tjr", posed_from_rest[..., :3, :3], skeleton.joints_rest) + posed_from_rest[..., :3, 3]
    arrays = {
        "poses": pose,
        "translation": translation,
        "posed_from_canonical": posed_from_rest @ invert_rigid(canonical_from_rest),
        "joints": joints,
    }
    for name, array in arrays.items():
        bad = np.flatnonzero(~array.isfinite().flatten(1).all(1).numpy())
        if len(bad):
            wanted = f"{spec.name}: {name}: wanted finite numbers"
            raise UserError(f"{wanted}, got NaN or infinity in frame {frames[bad[0]]}; repair its poses first")
    return {name: array.numpy().astype(np.float32) for name, array in arrays.items()} | {"frame_numbers": frames}
