"""Two-dimensional shapes: upright prisms around the plane z = 0, sampled on that plane only."""

from __future__ import annotations

import numpy as np

from snarfcli.errors import UserError
from snarfcli.sampling.triangles import area_normals, random_points_in

__all__ = ["in_turned_over", "outline_samples", "with_plane_on_cells"]

_UPRIGHT = 1e-3  # largest share of a wall's normal along z; float32 leaves 1e-6
_PAIRS_AT_ONCE = 1 << 20  # pairs of a point and a triangle; bounds the memory


def with_plane_on_cells(cube_lower: np.ndarray, cube_size: np.float32, levels: int) -> np.ndarray:
    """Return the lower corner [3] of a cube, float32, metres, moved along z so that z = 0 is exactly the centre of a cell.

    Args:
        cube_lower: [3] float32, metres; the plane halves the cube.
        cube_size: metres.
        levels: number of cells along a side.
    """
    moved = cube_lower.copy()
    moved[2] = -(np.float32(levels // 2) + np.float32(0.5)) * (np.float32(cube_size) / np.float32(levels))
    return moved


def outline_samples(vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return points spread evenly along the outline of a prism: one in each of `count` equal shares of its walls.

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3], vertex indices.
        count: number of points.
        generator: source of random numbers.

    Returns:
        [count, 3] float64, metres, z = 0, wall after wall.

    Raises:
        UserError: the mesh has no upright wall.
    """
    corners = vertices.astype(np.float64)[faces]
    normals = area_normals(corners)
    lengths = np.linalg.norm(normals, axis=1)
    areas = np.where(np.abs(normals[:, 2]) < _UPRIGHT * lengths, lengths, 0.0)
    if not areas.sum() > 0:
        raise UserError("mesh of a planar subject has no upright wall, so it has no outline; it must be a prism along z")
    ends = np.cumsum(areas)
    places = (np.arange(count) + generator.random(count)) * (ends[-1] / max(1, count))
    chosen = np.minimum(np.searchsorted(ends, places, side="right"), np.flatnonzero(areas)[-1])
    points = random_points_in(corners[chosen], generator)
    points[:, 2] = 0.0
    return points


def in_turned_over(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points lie in a part of a moved prism that the motion has turned over, [N] bool.

    At a sharp bend linear blend skinning folds the inner side over. The winding number counts such a part as -1, so at the edge
    of the fold it calls points outside although inside points move there. Adding this test makes them inside, as in the
    union over all correspondences (SNARF Eq. 9).

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3], vertex indices; the triangles above the plane z = 0 are the top, outward where nothing is turned over.
        points: [N, 3], on the plane, metres.
    """
    corners = vertices.astype(np.float64)[faces]
    top = corners[(corners[..., 2] > 0).all(1)][..., :2]
    turned = top[_cross(top[:, 1] - top[:, 0], top[:, 2] - top[:, 0]) < 0]
    inside = np.zeros(len(points), bool)
    if not len(turned):
        return inside
    flat = points[:, :2].astype(np.float64)
    near = np.flatnonzero(((flat >= turned.min((0, 1))) & (flat <= turned.max((0, 1)))).all(1))
    for part in np.array_split(near, 1 + len(near) * len(turned) // _PAIRS_AT_ONCE):
        sides = [_cross(turned[:, (k + 1) % 3] - turned[:, k], flat[part, None] - turned[:, k]) <= 0 for k in range(3)]
        inside[part] = np.logical_and.reduce(sides).any(1)
    return inside


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the z component of the cross product of vectors [..., 2]."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
