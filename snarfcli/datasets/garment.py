"""A garment made to measure for a body: a shirt and trousers, long or short, as one closed surface with the skin that shows.

In the canonical pose the cloth fills everything nearer to the body than its stand-off (rounded, as cloth spans hollows), up to
collar, cuffs and hem. That solid is joined with the body by an exact boolean union, so that nothing hidden is left below. A
vertex of cloth follows the mean of the body's vertices near it, a vertex of skin its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from snarfcli.sampling import winding_numbers

__all__ = ["ClothedMesh", "Outfit", "dress"]

_CELL_M = 0.012  # folds are 5 cm long and more; half of it gives four times the vertices
_BAND_M = 0.03  # cloth spans hollows narrower than about twice this
_LEAST_STAND_OFF_M = 0.012
_SAME_M = 1e-5  # the union moves no vertex further than its files' single precision does
_NEIGHBOURS = 400  # of 6,890 body vertices
_LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class Outfit:
    """What somebody wears."""

    sleeve: float
    """Length of the sleeves, as a share of the arm from shoulder to wrist."""
    leg: float
    """Length of the trousers, as a share of the leg from hip to ankle."""
    shirt_length: float
    """Where the shirt ends, as a share of the way from the lowest joint of the spine to the hips; more than 1: below."""
    stand_off_m: float
    """How far the cloth is from the body at the chest, metres."""
    flare_m: float
    """How much further at cuffs and hems, metres."""


@dataclass(frozen=True, eq=False)
class ClothedMesh:
    """A closed mesh of cloth and skin in the canonical pose, and what each vertex follows."""

    vertices: NDArray[np.float64]
    """[V, 3], metres."""
    faces: NDArray[np.int64]
    """[F, 3], vertex numbers, outward."""
    stand_off_m: NDArray[np.float64]
    """[V], distance from the body; 0 for skin."""
    shares: csr_matrix
    """[V, B], how much each vertex follows each of the body's; rows sum to 1."""

    def follow(self, values: NDArray) -> NDArray[np.float64]:
        """Return what the vertices have [V, C] of what the body's have [B, C]."""
        return self.shares @ np.asarray(values, np.float64)


def dress(vertices: NDArray, faces: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> ClothedMesh:
    """Put an outfit on a body.

    Args:
        vertices: [B, 3], the body in the canonical pose (arms sideways, legs apart), metres, y up, facing +z.
        faces: [F, 3], its closed surface, outward.
        joints: its joints by SMPL's names, [3] each, metres.
        outfit: what to wear.

    Raises:
        ValueError: the union of body and garment is not a closed surface.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    cloth = _cloth(vertices, faces, joints, outfit)
    joined, joined_faces = _union((vertices, faces), cloth)
    stand_off = _distance(vertices, faces, joined)
    return ClothedMesh(joined, joined_faces, stand_off, _shares(vertices, faces, joined, stand_off))


def _cloth(vertices: NDArray, faces: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> tuple[NDArray, NDArray]:
    """Return the closed surface of the cloth, filled down to the middle of the body: vertices and outward faces."""
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    reach = outfit.stand_off_m + outfit.flare_m + 4 * _CELL_M
    wide, lowest = np.abs(vertices[:, 0]).max(), joints["l_ankle"][1]
    low = np.array([-wide, lowest, vertices[:, 2].min()]) - reach
    high = np.array([wide, joints["head"][1], vertices[:, 2].max()]) + reach
    # A grid that is its own mirror image: nobody's clothes hang to one side.
    axes = [_CELL_M * np.arange(np.floor(a / _CELL_M), np.ceil(b / _CELL_M) + 1) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3)
    exact = _distance(vertices, faces, flat)
    near = exact < 3 * reach  # what is farther is outside whatever is near
    inside = np.zeros(len(flat), bool)
    inside[near] = winding_numbers(vertices, faces, flat[near]) > 0.5
    exact = np.where(inside, -exact, exact).reshape(points.shape[:3])
    rounded = gaussian_filter(exact, _BAND_M / _CELL_M, mode="nearest")
    shirt = _shirt(points, exact, rounded, joints, outfit)
    field = np.minimum(shirt, _trousers(points, exact, rounded, joints, outfit))
    field = np.pad(field, 1, constant_values=reach)
    field[np.abs(field) < 1e-6] = 1e-6  # a surface through a node has triangles without area
    surface, triangles, _, _ = marching_cubes(field.astype(np.float64), 0.0, gradient_direction="descent")
    return surface.astype(np.float64) * _CELL_M + [axis[0] - _CELL_M for axis in axes], triangles.astype(np.int64)


def _shirt(points: NDArray, exact: NDArray, rounded: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> NDArray:
    """Return a function that is negative in the shirt, metres near its border; `points` [X, Y, Z, 3]."""
    spine, hip, neck = joints["spine1"], joints["l_hip"], joints["neck"]
    shoulder, wrist = joints["l_shoulder"], joints["l_wrist"]
    cuff = shoulder[0] + outfit.sleeve * (wrist[0] - shoulder[0])
    hem = spine[1] + outfit.shirt_length * (hip[1] - spine[1])
    along_sleeve = _ramp(np.abs(points[..., 0]), shoulder[0], cuff)
    below_chest = _ramp(points[..., 1], joints["spine3"][1], hem)
    below_neck = _ramp(points[..., 1], neck[1] + 0.03, neck[1] - 0.06)
    wide = outfit.flare_m * np.maximum(along_sleeve, below_chest) + (outfit.stand_off_m - _LEAST_STAND_OFF_M) * below_neck
    body = _stand_off(exact, rounded, wide)
    # The collar lies lower in front; sin and cos of 25 degrees.
    collar = 0.906 * (points[..., 1] - neck[1] - 0.015) + 0.423 * (points[..., 2] - neck[2])
    return _cut(body, np.abs(points[..., 0]) - cuff, hem - points[..., 1], collar)


def _trousers(points: NDArray, exact: NDArray, rounded: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> NDArray:
    """Return a function that is negative in the trousers, metres near its border."""
    hip, ankle = joints["l_hip"], joints["l_ankle"]
    length = np.linalg.norm(ankle - hip)
    mirrored = np.concatenate([np.abs(points[..., :1]), points[..., 1:]], axis=-1)
    down = (mirrored - hip) @ ((ankle - hip) / length)
    end = outfit.leg * length
    wide = outfit.stand_off_m - _LEAST_STAND_OFF_M + outfit.flare_m * _ramp(down, 0, end)
    waist = points[..., 1] - joints["spine1"][1]
    return _cut(_stand_off(exact, rounded, wide), down - end, waist)


def _stand_off(exact: NDArray, rounded: NDArray, wider: NDArray) -> NDArray:
    """Return the distance to cloth that is `wider` than its least stand-off from a rounded body, and never nearer than that."""
    return np.minimum(rounded - wider, exact) - _LEAST_STAND_OFF_M


def _cut(field: NDArray, *others: NDArray) -> NDArray:
    """Return the greatest of functions, rounded off where two meet: a sharp edge between grid nodes would come out as teeth."""
    for other in others:
        share = np.maximum(1 - np.abs(field - other) / (1.5 * _CELL_M), 0)
        field = np.maximum(field, other) + 0.375 * _CELL_M * share * share
    return field


def _ramp(x: NDArray, start: float, end: float) -> NDArray:
    """Return 0 before `start`, 1 after `end`, and a smooth step between."""
    share = np.clip((x - start) / (end - start), 0, 1)
    return share * share * (3 - 2 * share)


def _union(one: tuple[NDArray, NDArray], other: tuple[NDArray, NDArray]) -> tuple[NDArray, NDArray]:
    """Return the outer surface of two closed meshes."""
    import pymeshlab

    from snarfcli.sampling.occupancy import count_boundary_edges

    meshes = pymeshlab.MeshSet(verbose=False)
    for vertices, faces in (one, other):
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.generate_boolean_union(first_mesh=0, second_mesh=1)
    joined = meshes.current_mesh()
    vertices, faces = joined.vertex_matrix(), joined.face_matrix().astype(np.int64)
    if not len(faces) or count_boundary_edges(faces):
        raise ValueError(f"body and garment: wanted a closed surface, got {len(faces)} faces, open or none")
    return vertices, faces


def _distance(vertices: NDArray, faces: NDArray, points: NDArray) -> NDArray[np.float64]:
    """Return the distance of points [N, 3] from a surface, metres."""
    import igl

    return np.sqrt(np.asarray(igl.point_mesh_squared_distance(points, vertices, faces)[0]).reshape(-1))


def _shares(vertices: NDArray, faces: NDArray, joined: NDArray, stand_off: NDArray) -> csr_matrix:
    """Return how much each vertex of the joined mesh follows each of the body's, [V, B]."""
    import igl
    from scipy.spatial import cKDTree

    distance, followed = cKDTree(vertices).query(joined, k=_NEIGHBOURS)
    # The farther from the body, the more of it counts.
    width = 0.02 + 0.8 * np.maximum(stand_off, 0)[:, None]
    shares = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / width**2)
    shares /= shares.sum(axis=1, keepdims=True)
    # On the skin: the corners of the triangle that the vertex lies in, which for the body's own vertices is that vertex.
    skin = np.flatnonzero(stand_off < _SAME_M)
    _, face, closest = igl.point_mesh_squared_distance(joined[skin], vertices, faces)
    corners = faces[face]
    a, b, c = (np.ascontiguousarray(vertices[corners[:, i]]) for i in range(3))
    followed[skin, :3], shares[skin] = corners, 0
    shares[skin, :3] = _barycentric(np.asarray(closest), a, b, c)
    shares[shares < _LEAST_SHARE] = 0
    shares /= shares.sum(axis=1, keepdims=True)
    row, column = np.nonzero(shares)
    return csr_matrix((shares[row, column], (row, followed[row, column])), shape=(len(joined), len(vertices)))


def _barycentric(points: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float64]:
    """Return the shares [N, 3] of the corners in points of their triangles."""
    normal = np.cross(b - a, c - a)
    area = np.maximum((normal * normal).sum(1), 1e-30)
    first = (np.cross(c - b, points - b) * normal).sum(1) / area
    second = (np.cross(a - c, points - c) * normal).sum(1) / area
    shares = np.clip(np.stack([first, second, 1 - first - second], axis=1), 0, 1)
    return shares / shares.sum(axis=1, keepdims=True)
