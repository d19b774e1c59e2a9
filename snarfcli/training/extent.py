"""Where the body of a subject lies in the canonical frame, judged from its training frames."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from snarfcli.datasets.store import SampleStore
from snarfcli.errors import UserError
from snarfcli.models.extent import unpose_by_nearest_bone

__all__ = ["rough_canonical_surface"]

_FRAMES = 8
_POINTS = 1024


def rough_canonical_surface(store: SampleStore) -> Tensor:
    """Return surface points [K, 3] in the canonical frame, metres, right to a few centimetres, and the joints.

    No template and no skinning weights are used: the training frames nearest to the canonical pose are taken back rigidly,
    bone by bone. The first and last points along each axis are kept, the others thinned out.

    Raises:
        UserError: the samples hold no training frames.
    """
    skeleton = store.skeleton.to(torch.float32)
    frames = [(s, int(frame)) for s in store.sequences("train") for frame in s.train_frames]
    if not frames:
        raise UserError('the samples hold no training frames; run "snarf preprocess" with the training sequences')
    poses = np.stack([sequence.poses[frame] for sequence, frame in frames])
    distance = np.abs(poses[:, 1:] - skeleton.canonical_pose.numpy()[None, 1:]).sum((1, 2))
    parts = []
    for index in np.argsort(distance, kind="stable")[:_FRAMES]:
        sequence, frame = frames[index]
        vertices = torch.as_tensor(np.array(sequence.vertices(frame)), dtype=torch.float32)
        transforms = torch.as_tensor(np.array(sequence.bone_transforms[frame]), dtype=torch.float32)
        parts.append(unpose_by_nearest_bone(vertices, transforms, skeleton))
    points = torch.cat(parts)
    thinned = points[:: max(1, len(points) // _POINTS)]
    outermost = points[torch.cat([points.argmin(0), points.argmax(0)])]
    return torch.cat([thinned, outermost, skeleton.canonical_joints])
