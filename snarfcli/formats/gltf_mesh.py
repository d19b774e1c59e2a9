"""Read the triangles of glTF files, with the joints and weights of each vertex.

Source: Khronos, glTF 2.0 specification, section 3.7 (geometry, skins).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile

__all__ = ["MeshReader", "Piece", "dense_weights", "join_pieces", "moved", "welded"]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_DRACO = "KHR_draco_mesh_compression"
_MAX_PRIMITIVES = 10_000
# 512 MiB and 3 s, with eight joints per vertex; with more joints, fewer vertices.
_MAX_VERTICES = 500_000
_MAX_INFLUENCES = 8 * _MAX_VERTICES  # vertices times the joints that one of them follows
_MAX_FACES = 1_000_000
_MAX_WEIGHTS = 40_000_000  # 320 MB


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles whose vertices follow at most K joints each."""

    vertices: NDArray[np.float64]
    """[V, 3], positions."""
    faces: NDArray[np.int64]
    """[F, 3], triangles."""
    joints: NDArray[np.int64]
    """[V, K], indices of joints; K may be 0."""
    weights: NDArray[np.float64]
    """[V, K], weights of these joints: non-negative, rows sum to 1, sorted by joint; unused entries are 0 and come last."""


class MeshReader:
    """Reader of the meshes of one file; reads each once, and limits the total size of the results."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._pieces: dict[tuple[int, int | None], Piece] = {}
        self._vertices = self._faces = self._primitives = self._most_joints = 0

    def read(self, number: int, skin_joints: int | None) -> Piece:
        """Read all triangles of a mesh, as stored. Points, lines, and vertices that no triangle uses are left out.

        Args:
            number: index of the mesh.
            skin_joints: number of joints of the skin that moves it; None reads no joints, and K is 0.

        Raises:
            UserError: values are damaged or out of range, there are too many vertices, or vertices of a skinned mesh have no
                joints.
        """
        file, what = self._file, f"mesh {number}"
        if (number, skin_joints) not in self._pieces:
            primitives = file.objects(file.items("meshes")[number], "primitives", what)
            self._primitives += len(primitives)
            if self._primitives > _MAX_PRIMITIVES:
                file.fail(f"wanted at most {_MAX_PRIMITIVES} parts of meshes, got more; join them")
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
        self._most_joints = max(self._most_joints, piece.joints.shape[1])
        _check_influences(self._file, self._vertices, self._most_joints)
        if self._vertices > _MAX_VERTICES or self._faces > _MAX_FACES:
            self._file.fail(
                f"wanted meshes of at most {_MAX_VERTICES} vertices and {_MAX_FACES} triangles, got more; simplify them"
            )


def _read_primitive(file: GltfFile, primitive: dict[str, Any], skin_joints: int | None, what: str) -> Piece | None:
    mode = file.integer(primitive, "mode", _TRIANGLES, what)
    attributes = primitive.get("attributes")
    if mode not in (_TRIANGLES, _STRIP, _FAN) or not isinstance(attributes, dict) or "POSITION" not in attributes:
        return None
    if file.has_extension(primitive, _DRACO) and not _has_plain_values(file, primitive, attributes, what):
        file.fail(f"{what} is compressed with Draco, which is not supported; export it without compression")
    vertices = _attribute(file, attributes, "POSITION", ("VEC3",), None, what).astype(np.float64)
    indices = file.index(primitive, "indices", "accessors", what)
    if indices is None:
        corners = np.arange(len(vertices))
    else:
        if file.accessor_shape(indices)[0] > 3 * _MAX_FACES:
            file.fail(f"{what}: wanted at most {_MAX_FACES} triangles, got more; simplify it")
        corners = file.accessor(indices, ("SCALAR",), f"indices of {what}")[:, 0]
        if corners.dtype.kind != "i" or (len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices)):
            file.fail(f"{what} has indices beyond its {len(vertices)} vertices; export it again")
    faces = _triangles(corners.astype(np.int64, copy=False), mode)
    used, inverse = np.unique(faces, return_inverse=True)
    joints, weights = np.zeros((len(vertices), 0), np.int64), np.zeros((len(vertices), 0))
    if skin_joints is not None:
        joints, weights = _read_weights(file, attributes, skin_joints, len(vertices), what)
    return Piece(vertices[used], inverse.reshape(-1, 3).astype(np.int64), joints[used], weights[used])


def _has_plain_values(file: GltfFile, primitive: dict[str, Any], attributes: dict[str, Any], what: str) -> bool:
    """Return whether all values that are read of a compressed primitive are also there without compression."""
    read = [attributes[name] for name in attributes if name.startswith(("POSITION", "JOINTS_", "WEIGHTS_"))]
    read += [primitive["indices"]] if "indices" in primitive else []
    numbers = [file.checked_index(number, "accessors", f"an attribute of {what}") for number in read]
    return all("bufferView" in file.items("accessors")[number] for number in numbers)


def _attribute(
    file: GltfFile, attributes: dict[str, Any], name: str, wanted: tuple[str, ...], count: int | None, what: str
) -> NDArray:
    number = file.index(attributes, name, "accessors", what)
    if number is None:
        file.fail(f"{what} has no {name}, but a skin moves it; export it again")
    if file.accessor_shape(number)[0] > _MAX_VERTICES:
        file.fail(f"{what}: wanted at most {_MAX_VERTICES} vertices, got more; simplify it")
    values = file.accessor(number, wanted, f"{name} of {what}")
    if count is not None and len(values) != count:
        file.fail(f"{what}: wanted {count} values of {name}, one per vertex, got {len(values)}; export it again")
    return values


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Return the triangles [F, 3] of a list, strip or fan of corners, all with the same orientation."""
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
    sets = next(n for n in itertools.count(1) if f"JOINTS_{n}" not in attributes or f"WEIGHTS_{n}" not in attributes)
    _check_influences(file, count, 4 * sets)
    parts = [_attribute(file, attributes, f"JOINTS_{n}", ("VEC4",), count, what) for n in range(sets)]
    joints = np.concatenate(parts, 1)
    parts = [_attribute(file, attributes, f"WEIGHTS_{n}", ("VEC4",), count, what) for n in range(sets)]
    weights = np.maximum(np.concatenate(parts, 1).astype(np.float64), 0.0)
    joints = np.where(weights > 0, joints, 0)
    if joints.dtype.kind != "i" or (joints.size and not 0 <= joints.min() <= joints.max() < skin_joints):
        file.fail(f"{what} refers to a joint beyond the {skin_joints} of its skin; export it again")
    # Sorted, so that vertices split along a seam have bitwise equal rows and sums.
    order = np.argsort(np.where(weights > 0, joints, skin_joints), axis=1, kind="stable")
    width = max(1, int((weights > 0).sum(1).max(initial=0)))
    order = order[:, :width]
    joints, weights = np.take_along_axis(joints, order, 1), np.take_along_axis(weights, order, 1)
    total = weights.sum(1, keepdims=True)
    weights[:, :1] = np.where(total > 0, weights[:, :1], 1.0)  # vertices without weights follow the first joint, as in viewers
    return joints, weights / np.where(total > 0, total, 1.0)


def _check_influences(file: GltfFile, vertices: int, joints: int) -> None:
    if vertices * joints > _MAX_INFLUENCES:
        file.fail(f"{vertices} vertices follow up to {joints} joints each, which is too many; export it with fewer influences")


def join_pieces(pieces: list[Piece]) -> Piece:
    """Return all pieces as one piece."""
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
    """Return the piece moved by an affine matrix [4, 4]; a mirroring matrix reverses the triangles, so normals stay outward."""
    faces = piece.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else piece.faces
    return replace(piece, vertices=piece.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces=faces)


def welded(piece: Piece) -> Piece:
    """Merge vertices of equal position and weights, and drop the triangles that become degenerate.

    glTF splits vertices where a normal or a texture coordinate is discontinuous; welding closes the surface again. Vertices at
    the same position that follow different joints (two parts that touch) are not merged.
    """
    rows = np.concatenate([piece.vertices, piece.joints, piece.weights], 1) + 0.0  # + 0.0 turns -0.0 into 0.0
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    faces = first[inverse.reshape(-1)][piece.faces]
    faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
    used, faces = np.unique(faces, return_inverse=True)  # in the order of the file
    faces = faces.reshape(-1, 3).astype(np.int64)
    return Piece(piece.vertices[used], faces, piece.joints[used], piece.weights[used])


def dense_weights(file: GltfFile, piece: Piece, num_joints: int) -> NDArray[np.float64]:
    """Return the weights of all joints, [V, J].

    Raises:
        UserError: the array would be too large.
    """
    count = len(piece.vertices)
    if count * num_joints > _MAX_WEIGHTS:
        file.fail(f"wanted at most {_MAX_WEIGHTS} weights, got {count} vertices times {num_joints} joints; simplify the mesh")
    dense = np.zeros((count, num_joints))
    rows = np.arange(count)
    for column in range(piece.joints.shape[1]):
        dense[rows, piece.joints[:, column]] += piece.weights[:, column]
    return dense
