"""A rough canonical shape of a subject, estimated from its training frames."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from snarfcli.bodies.extent import unpose_by_nearest_bone
from snarfcli.errors import UserError
from snarfcli.samples.store import SampleStore

__all__ = ["rough_canonical_points"]

_FRAMES = 8  # number of training frames used
_POINTS = 1024  # number of points on the surface, and of points inside


def rough_canonical_points(store: SampleStore) -> Tensor:
    """Return points of the body and its joints, [K, 3], canonical frame, metres, exact to a few centimetres.

    No template and no skinning weights are used: in the training frames nearest to the canonical pose the vertices of the mesh,
    and the samples inside it, are moved back rigidly by their nearest bone. Vertices alone would omit the middle of a large
    part with few vertices. The outermost points along each axis are kept, the others thinned out.

    Raises:
        UserError: the samples have no training frames.
    """
    skeleton = store.skeleton.to(torch.float32)
    frames = [(s, int(frame)) for s in store.sequences("train") for frame in s.train_frames]
    if not frames:
        raise UserError('the samples have no training frames; run "snarf preprocess" with the training sequences')
    poses = np.stack([sequence.poses[frame] for sequence, frame in frames])
    distance = np.abs(poses[:, 1:] - skeleton.canonical_pose.numpy()[None, 1:]).sum((1, 2))
    surface, inside = [], []
    for index in np.argsort(distance, kind="stable")[:_FRAMES]:
        sequence, frame = frames[index]
        vertices = torch.as_tensor(np.array(sequence.vertices(frame)), dtype=torch.float32)
        transforms = torch.as_tensor(np.array(sequence.bone_transforms[frame]), dtype=torch.float32)
        surface.append(unpose_by_nearest_bone(vertices, transforms, skeleton))
        uniform = np.arange(sequence.num_uniform)
        samples = torch.as_tensor(sequence.points(frame, uniform)[sequence.occupancies(frame, uniform)])
        inside.append(unpose_by_nearest_bone(samples, transforms, skeleton))
    thinned = [part[:: max(1, len(part) // _POINTS)] for part in (torch.cat(surface), torch.cat(inside))]
    points = torch.cat([*surface, *inside])
    outermost = points[torch.cat([points.argmin(0), points.argmax(0)])]
    return torch.cat([*thinned, outermost, skeleton.canonical_joints])
