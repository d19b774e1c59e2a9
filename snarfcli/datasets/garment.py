"""A garment fitted to a body: shirt and trousers, long or short, as one closed surface together with the visible skin.

In the canonical pose the cloth fills the space closer to the body than its stand-off (smoothed, since cloth spans hollows), up
to collar, cuffs and hem. An exact boolean union joins that solid with the body and removes the hidden skin. A vertex of cloth
follows the mean of nearby body vertices, a vertex of skin follows itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from snarfcli.errors import UserError
from snarfcli.extras.meshlab import INSTALL_MESHLAB, why_no_meshlab
from snarfcli.sampling import winding_numbers
from snarfcli.sampling.occupancy import count_boundary_edges

__all__ = ["ClothedMesh", "Outfit", "dress"]

_CELL_M = 0.012  # folds are at least 5 cm long; half of it gives four times as many vertices
_BAND_M = 0.03  # cloth spans hollows narrower than about twice this
_LEAST_STAND_OFF_M = 0.012
_SAME_M = 1e-5  # the union moves vertices by at most the rounding of single precision
_NEIGHBOURS = 400  # of 6,890 body vertices
_LEAF_SIZE = 16
_LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class Outfit:
    """Measures of a shirt and trousers."""

    sleeve: float
    """Length of the sleeves, as a share of the arm from shoulder to wrist."""
    leg: float
    """Length of the trousers, as a share of the leg from hip to ankle."""
    shirt_length: float
    """Height of the hem, as a share of the distance from the lowest joint of the spine to the hips; above 1: below the hips."""
    stand_off_m: float
    """Distance of the cloth from the body at the chest, metres."""
    flare_m: float
    """Additional distance at cuffs and hems, metres."""


@dataclass(frozen=True, eq=False)
class ClothedMesh:
    """A closed mesh of cloth and skin in the canonical pose, and the body vertices that each vertex follows."""

    vertices: NDArray[np.float64]
    """[V, 3], metres."""
    faces: NDArray[np.int64]
    """[F, 3], vertex numbers, outward."""
    stand_off_m: NDArray[np.float64]
    """[V], distance from the body, metres; 0 for skin."""
    shares: csr_matrix
    """[V, B], weights with which each vertex follows the body vertices; rows sum to 1."""

    def follow(self, values: NDArray) -> NDArray[np.float64]:
        """Return the values [V, C] of the vertices from values [B, C] of the body vertices."""
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
    # The grid is symmetric, and so are the clothes.
    axes = [_CELL_M * np.arange(np.floor(a / _CELL_M), np.ceil(b / _CELL_M) + 1) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3)
    exact = _distance(vertices, faces, flat)
    near = exact < 3 * reach  # points further away are outside
    inside = np.zeros(len(flat), bool)
    inside[near] = winding_numbers(vertices, faces, flat[near]) > 0.5
    exact = np.where(inside, -exact, exact).reshape(points.shape[:3])
    rounded = gaussian_filter(exact, _BAND_M / _CELL_M, mode="nearest")
    shirt = _shirt(points, exact, rounded, joints, outfit)
    field = np.minimum(shirt, _trousers(points, exact, rounded, joints, outfit))
    field = np.pad(field, 1, constant_values=reach)
    field[np.abs(field) < 1e-6] = 1e-6  # a surface through a node has triangles of zero area
    surface, triangles, _, _ = marching_cubes(field.astype(np.float64), 0.0, gradient_direction="descent")
    return surface.astype(np.float64) * _CELL_M + [axis[0] - _CELL_M for axis in axes], triangles.astype(np.int64)


def _shirt(points: NDArray, exact: NDArray, rounded: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> NDArray:
    """Return the values [X, Y, Z] of a function that is negative inside the shirt; near its border a distance, metres."""
    spine, hip, neck = joints["spine1"], joints["l_hip"], joints["neck"]
    shoulder, wrist = joints["l_shoulder"], joints["l_wrist"]
    cuff = shoulder[0] + outfit.sleeve * (wrist[0] - shoulder[0])
    hem = spine[1] + outfit.shirt_length * (hip[1] - spine[1])
    along_sleeve = _ramp(np.abs(points[..., 0]), shoulder[0], cuff)
    below_chest = _ramp(points[..., 1], joints["spine3"][1], hem)
    below_neck = _ramp(points[..., 1], neck[1] + 0.03, neck[1] - 0.06)
    wide = outfit.flare_m * np.maximum(along_sleeve, below_chest) + (outfit.stand_off_m - _LEAST_STAND_OFF_M) * below_neck
    body = _stand_off(exact, rounded, wide)
    # The collar is lower in front; sin and cos of 25 degrees.
    collar = 0.906 * (points[..., 1] - neck[1] - 0.015) + 0.423 * (points[..., 2] - neck[2])
    return _cut(body, np.abs(points[..., 0]) - cuff, hem - points[..., 1], collar)


def _trousers(points: NDArray, exact: NDArray, rounded: NDArray, joints: dict[str, NDArray], outfit: Outfit) -> NDArray:
    """Return the values [X, Y, Z] of a function that is negative inside the trousers; near its border a distance, metres."""
    hip, ankle = joints["l_hip"], joints["l_ankle"]
    length = np.linalg.norm(ankle - hip)
    mirrored = np.concatenate([np.abs(points[..., :1]), points[..., 1:]], axis=-1)
    down = (mirrored - hip) @ ((ankle - hip) / length)
    end = outfit.leg * length
    wide = outfit.stand_off_m - _LEAST_STAND_OFF_M + outfit.flare_m * _ramp(down, 0, end)
    waist = points[..., 1] - joints["spine1"][1]
    return _cut(_stand_off(exact, rounded, wide), down - end, waist)


def _stand_off(exact: NDArray, rounded: NDArray, wider: NDArray) -> NDArray:
    """Return the distance to cloth that exceeds the least stand-off from a smoothed body by `wider`, metres."""
    return np.minimum(rounded - wider, exact) - _LEAST_STAND_OFF_M


def _cut(field: NDArray, *others: NDArray) -> NDArray:
    """Return the maximum of functions, rounded where two meet, since a sharp edge between grid nodes would become jagged."""
    for other in others:
        share = np.maximum(1 - np.abs(field - other) / (1.5 * _CELL_M), 0)
        field = np.maximum(field, other) + 0.375 * _CELL_M * share * share
    return field


def _ramp(x: NDArray, start: float, end: float) -> NDArray:
    """Return 0 before `start`, 1 after `end`, and a smooth step between."""
    share = np.clip((x - start) / (end - start), 0, 1)
    return share * share * (3 - 2 * share)


def _union(one: tuple[NDArray, NDArray], other: tuple[NDArray, NDArray]) -> tuple[NDArray, NDArray]:
    """Return the outer surface of two closed meshes.

    Raises:
        UserError: MeshLab cannot be used.
    """
    reason = why_no_meshlab()
    if reason is not None:
        raise UserError(f"data=clothed joins body and garment with MeshLab, but {reason}; install it with: {INSTALL_MESHLAB}")
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]  # its stub lists no classes
    for vertices, faces in (one, other):
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces))  # pyright: ignore[reportAttributeAccessIssue]
    meshes.generate_boolean_union(first_mesh=0, second_mesh=1)
    joined = meshes.current_mesh()
    vertices, faces = joined.vertex_matrix(), joined.face_matrix().astype(np.int64)
    if not len(faces) or count_boundary_edges(faces):
        raise ValueError(f"body and garment: wanted a closed surface, got an open one of {len(faces)} faces")
    return vertices, faces


def _distance(vertices: NDArray, faces: NDArray, points: NDArray) -> NDArray[np.float64]:
    """Return the distance of points [N, 3] from a surface, metres."""
    import igl

    return np.sqrt(np.asarray(igl.point_mesh_squared_distance(points, vertices, faces)[0]).reshape(-1))


def _shares(vertices: NDArray, faces: NDArray, joined: NDArray, stand_off: NDArray) -> csr_matrix:
    """Return the weights [V, B] with which each vertex of the joined mesh follows the body vertices."""
    import igl

    # The size of the leaves decides between vertices at the same distance, as on both sides of the plane of symmetry.
    distance, followed = map(np.asarray, KDTree(vertices, leafsize=_LEAF_SIZE).query(joined, k=_NEIGHBOURS))
    # The further from the body, the more of its vertices count.
    width = 0.02 + 0.8 * np.maximum(stand_off, 0)[:, None]
    shares = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / width**2)
    shares /= shares.sum(axis=1, keepdims=True)
    # On the skin: the corners of the triangle that contains the vertex; for an original body vertex, that vertex alone.
    skin = np.flatnonzero(stand_off < _SAME_M)
    _, face, closest = igl.point_mesh_squared_distance(joined[skin], vertices, faces)
    corners = faces[np.asarray(face)]
    a, b, c = (np.ascontiguousarray(vertices[corners[:, i]]) for i in range(3))
    followed[skin, :3], shares[skin] = corners, 0
    shares[skin, :3] = _barycentric(np.asarray(closest), a, b, c)
    shares[shares < _LEAST_SHARE] = 0
    shares /= shares.sum(axis=1, keepdims=True)
    row, column = np.nonzero(shares)
    return csr_matrix((shares[row, column], (row, followed[row, column])), shape=(len(joined), len(vertices)))


def _barycentric(points: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float64]:
    """Return the barycentric coordinates [N, 3] of points [N, 3] in their triangles a, b, c [N, 3]."""
    normal = np.cross(b - a, c - a)
    area = np.maximum((normal * normal).sum(1), 1e-30)
    first = (np.cross(c - b, points - b) * normal).sum(1) / area
    second = (np.cross(a - c, points - c) * normal).sum(1) / area
    shares = np.clip(np.stack([first, second, 1 - first - second], axis=1), 0, 1)
    return shares / shares.sum(axis=1, keepdims=True)
