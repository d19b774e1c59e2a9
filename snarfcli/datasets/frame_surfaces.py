"""The surface of a frame: that of its file, or if the file has points only, the closed surface around them.

Worker processes import this module, see `posed_meshes.py`; it does without PyTorch.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.point_clouds import PointFile, bone_normals, check_normals, close_surface, read_frame

__all__ = ["read_frame_surface", "read_frame_vertices"]

_MOST_POINTS = 30_000  # of a surface that is closed; more make it hardly better, but take longer


def read_frame_surface(path: Path, joints: NDArray, parents: Sequence[int]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices [V, 3] and faces [F, 3] of a frame, units and axes of the file.

    Args:
        path: the file.
        joints: [J, 3], joints inside the surface in this frame, units and axes of the file; they say which side of points
            without usable normals is outside.
        parents: J parents, -1 for a root.

    Raises:
        UserError: the file cannot be read, or its points enclose nothing.
    """
    frame = read_frame(path)
    if not isinstance(frame, PointFile):
        return frame
    points, normals = frame.points, frame.normals
    if len(points) > _MOST_POINTS:
        chosen = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
        points, normals = points[chosen], None if normals is None else normals[chosen]
    try:
        checked = None if normals is None else check_normals(points, normals)
        if checked is None or checked.is_estimated:
            return close_surface(points, bone_normals(points, joints, parents))
        return close_surface(points, checked.normals)
    except ValueError as error:
        raise UserError(f"no surface can be closed around the points of {path} ({error}); leave this frame out") from None


def read_frame_vertices(path: Path) -> tuple[NDArray[np.float64], bool]:
    """Return the vertices or points [V, 3] of a frame, units and axes of the file, and whether they are points only.

    Raises:
        UserError: the file cannot be read.
    """
    frame = read_frame(path)
    return (frame.points, True) if isinstance(frame, PointFile) else (frame[0], False)
