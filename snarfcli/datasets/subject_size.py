"""Measure how large a subject is in a mesh that may also show its surroundings, such as the floor of a scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.segments import segment_distances

__all__ = ["near_bones", "subject_length"]

# Shares of the skeleton's longest side. Skirts and wings of built-in and rigged subjects lie within 0.2 of a bone.
_REACH = 0.25
_FITS = 0.8  # a mesh around the bones is about as long as the skeleton
_SURROUNDED = 1.25  # a mesh this much longer than its part near the bones shows more than the subject
_MEASURED = 20_000  # vertices


def near_bones(vertices: NDArray, joints: NDArray, parents: Sequence[int]) -> NDArray[np.bool_]:
    """Return whether each vertex [V] is within reach of a bone: a quarter of the longest side of the skeleton.

    The last joint of a chain reaches as far as its bone is long, since the part behind it has no bone.

    Args:
        vertices: [V, 3].
        joints: [J, 3], posed joints, in the same frame.
        parents: J parents, -1 for a root.
    """
    reach = _REACH * float(np.ptp(joints, axis=0).max())
    starts = [parent if parent >= 0 else joint for joint, parent in enumerate(parents)]
    segments = torch.from_numpy(np.stack([joints[starts], joints], 1))
    points = torch.from_numpy(np.asarray(vertices, np.float64))
    is_near: NDArray[np.bool_] = (segment_distances(points, segments).amin(1) <= reach).numpy()
    for joint in set(range(len(parents))) - set(parents):
        length = np.linalg.norm(joints[joint] - joints[starts[joint]])
        is_near |= np.linalg.norm(vertices - joints[joint], axis=1) <= length
    return is_near


def subject_length(vertices: NDArray, joints: NDArray, parents: Sequence[int]) -> tuple[float, float]:
    """Return the longest side of the subject, and that of the whole mesh, which is larger if it shows more than the subject.

    Args:
        vertices: [V, 3], vertices of a posed mesh.
        joints: [J, 3], posed joints, in the same frame.
        parents: J parents, -1 for a root.
    """
    whole = float(np.ptp(vertices, axis=0).max())
    bones = float(np.ptp(joints, axis=0).max())
    if not np.isfinite(joints).all() or not 0 < bones * _SURROUNDED < whole:
        return whole, whole
    some = vertices[:: 1 + len(vertices) // _MEASURED]
    near = some[near_bones(some, joints, parents)]
    length = float(np.ptp(near, axis=0).max()) if len(near) else 0.0
    # If the mesh is not around the bones, their units or places differ, and the skeleton says nothing.
    return (length if _FITS * bones <= length and length * _SURROUNDED < whole else whole), whole
