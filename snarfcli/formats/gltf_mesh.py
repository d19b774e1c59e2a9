"""Triangles of glTF files, with the joints that each vertex follows.

Source: Khronos, glTF 2.0 specification, section 3.7 (geometry, skins).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile

__all__ = ["MeshReader", "Piece", "dense_weights", "join_pieces", "moved", "welded"]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_DRACO = "KHR_draco_mesh_compression"
_MAX_PRIMITIVES = 10_000
# Half a GiB and 3 s, with eight joints to each vertex.
_MAX_VERTICES = 500_000
_MAX_FACES = 1_000_000
_MAX_WEIGHTS = 40_000_000  # 320 MB


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles whose vertices follow up to K joints each."""

    vertices: NDArray[np.float64]
    """[V, 3]."""
    faces: NDArray[np.int64]
    """[F, 3]."""
    joints: NDArray[np.int64]
    """[V, K] which joints; K may be 0."""
    weights: NDArray[np.float64]
    """[V, K] how much: non-negative, rows sum to 1, sorted by joint, unused ones last with joint and weight 0."""


class MeshReader:
    """Reads meshes of one file, each once, and keeps count of what it hands out."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._pieces: dict[tuple[int, int | None], Piece] = {}
        self._vertices = self._faces = self._primitives = 0

    def read(self, number: int, skin_joints: int | None) -> Piece:
        """Read all triangles of mesh `number`, as stored; left out are points, lines, and vertices that no triangle uses.

        Args:
            number: which mesh.
            skin_joints: joints of the skin that moves it; None reads no joints, K is then 0.

        Raises:
            UserError: broken numbers, numbers out of range, far too many vertices, vertices without joints in a skinned mesh.
        """
        file, what = self._file, f"mesh {number}"
        if (number, skin_joints) not in self._pieces:
            primitives = file.objects(file.items("meshes")[number], "primitives", what)
            self._primitives += len(primitives)
            if self._primitives > _MAX_PRIMITIVES:
                file.fail(f"its meshes have over {_MAX_PRIMITIVES} parts; join them")
            pieces = []
            for primitive in primitives:
                piece = _read_primitive(file, primitive, skin_joints, what)
                if piece is not None:
                    self._count(piece)
                    pieces.append(piece)
            self._pieces[number, skin_joints] = join_pieces(pieces)
        else:
            self._count(self._pieces[number, skin_joints])
        return self._pieces[number, skin_joints]

    def _count(self, piece: Piece) -> None:
        self._vertices += len(piece.vertices)
        self._faces += len(piece.faces)
        if self._vertices > _MAX_VERTICES or self._faces > _MAX_FACES:
            self._file.fail(f"its meshes have over {_MAX_VERTICES} vertices or {_MAX_FACES} triangles; simplify them")


def _read_primitive(file: GltfFile, primitive: dict[str, Any], skin_joints: int | None, what: str) -> Piece | None:
    mode = file.integer(primitive, "mode", _TRIANGLES, what)
    attributes = primitive.get("attributes")
    if mode not in (_TRIANGLES, _STRIP, _FAN) or not isinstance(attributes, dict) or "POSITION" not in attributes:
        return None
    if file.has_extension(primitive, _DRACO):
        number = file.index(attributes, "POSITION", "accessors", what)
        if "bufferView" not in file.items("accessors")[number]:
            file.fail(f"{what} is compressed with Draco, which is not read; export it without compression")
    vertices = _attribute(file, attributes, "POSITION", ("VEC3",), None, what).astype(np.float64)
    indices = file.index(primitive, "indices", "accessors", what)
    if indices is None:
        corners = np.arange(len(vertices))
    else:
        if file.accessor_shape(indices)[0] > 3 * _MAX_FACES:
            file.fail(f"{what} has over {_MAX_FACES} triangles; simplify it")
        corners = file.accessor(indices, ("SCALAR",), f"indices of {what}")[:, 0]
        if corners.dtype.kind != "i" or (len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices)):
            file.fail(f"{what} has indices beyond its {len(vertices)} vertices; export it again")
    faces = _triangles(corners, mode)
    used, inverse = np.unique(faces, return_inverse=True)
    joints, weights = np.zeros((len(vertices), 0), np.int64), np.zeros((len(vertices), 0))
    if skin_joints is not None:
        joints, weights = _read_weights(file, attributes, skin_joints, len(vertices), what)
    return Piece(vertices[used], inverse.reshape(-1, 3).astype(np.int64), joints[used], weights[used])


def _attribute(
    file: GltfFile, attributes: dict[str, Any], name: str, wanted: tuple[str, ...], count: int | None, what: str
) -> NDArray:
    number = file.index(attributes, name, "accessors", what)
    if number is None:
        file.fail(f"{what} has no {name}, though a skin moves it; export it again")
    if file.accessor_shape(number)[0] > _MAX_VERTICES:
        file.fail(f"{what} has over {_MAX_VERTICES} vertices; simplify it")
    values = file.accessor(number, wanted, f"{name} of {what}")
    if count is not None and len(values) != count:
        file.fail(f"{what} has {count} vertices and {len(values)} of {name}; export it again")
    return values


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Return [F, 3], all with the same turn."""
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    count = max(0, len(corners) - 2)
    i = np.arange(count)
    if mode == _FAN:
        return np.stack([corners[i + 1], corners[i + 2], np.repeat(corners[:1], count)], 1)
    return np.stack([corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]], 1)


def _read_weights(
    file: GltfFile, attributes: dict[str, Any], skin_joints: int, count: int, what: str
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    sets = 2 if "JOINTS_1" in attributes and "WEIGHTS_1" in attributes else 1
    parts = [_attribute(file, attributes, f"JOINTS_{n}", ("VEC4",), count, what) for n in range(sets)]
    joints = np.concatenate(parts, 1)
    parts = [_attribute(file, attributes, f"WEIGHTS_{n}", ("VEC4",), count, what) for n in range(sets)]
    weights = np.maximum(np.concatenate(parts, 1).astype(np.float64), 0.0)
    joints = np.where(weights > 0, joints, 0)
    if joints.dtype.kind != "i" or (joints.size and not 0 <= joints.min() <= joints.max() < skin_joints):
        file.fail(f"{what} names a joint beyond the {skin_joints} of its skin; export it again")
    # Sorted, so that vertices that were split for a seam have the same sums and rows, to the last bit.
    order = np.argsort(np.where(weights > 0, joints, skin_joints), axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, 1), np.take_along_axis(weights, order, 1)
    total = weights.sum(1, keepdims=True)
    weights[:, :1] = np.where(total > 0, weights[:, :1], 1.0)  # follows nothing: hold on to the first joint, as viewers do
    return joints, weights / np.where(total > 0, total, 1.0)


def join_pieces(pieces: list[Piece]) -> Piece:
    """Return all pieces as one."""
    counts = [len(piece.vertices) for piece in pieces]
    width = max((piece.joints.shape[1] for piece in pieces), default=0)
    starts = np.cumsum([0, *counts])

    def padded(array: NDArray) -> NDArray:
        return np.pad(array, ((0, 0), (0, width - array.shape[1])))

    return Piece(
        np.concatenate([np.zeros((0, 3)), *(piece.vertices for piece in pieces)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(p.faces + s for p, s in zip(pieces, starts[:-1], strict=True))]),
        np.concatenate([np.zeros((0, width), np.int64), *(padded(piece.joints) for piece in pieces)]),
        np.concatenate([np.zeros((0, width)), *(padded(piece.weights) for piece in pieces)]),
    )


def moved(piece: Piece, matrix: NDArray[np.float64]) -> Piece:
    """Return the piece moved by an affine matrix [4, 4]; one that mirrors turns the triangles round, so outside stays out."""
    faces = piece.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else piece.faces
    return replace(piece, vertices=piece.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces=faces)


def welded(piece: Piece) -> Piece:
    """Merge vertices that have the same position and weights, and drop the triangles that lose their area by it.

    glTF splits vertices where a normal or a texture coordinate jumps; welded, a closed surface is closed again. What lies in
    the same place but follows other joints (two parts that touch) stays apart.
    """
    rows = np.concatenate([piece.vertices, piece.joints, piece.weights], 1) + 0.0  # + 0.0 makes -0.0 the same as 0.0
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    faces = first[inverse.reshape(-1)][piece.faces]
    faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
    used, faces = np.unique(faces, return_inverse=True)  # in the order of the file
    faces = faces.reshape(-1, 3).astype(np.int64)
    return Piece(piece.vertices[used], faces, piece.joints[used], piece.weights[used])


def dense_weights(file: GltfFile, piece: Piece, num_joints: int) -> NDArray[np.float64]:
    """Return the weights as [V, J].

    Raises:
        UserError: that would be far too many.
    """
    count = len(piece.vertices)
    if count * num_joints > _MAX_WEIGHTS:
        file.fail(f"has {count} vertices and {num_joints} joints, more than can be read together; simplify the mesh")
    dense = np.zeros((count, num_joints))
    rows = np.arange(count)
    for column in range(piece.joints.shape[1]):
        dense[rows, piece.joints[:, column]] += piece.weights[:, column]
    return dense
