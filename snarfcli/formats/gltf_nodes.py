"""Read the node tree of a glTF file: parents, and the transform of each node at rest and over time.

Source: Khronos, glTF 2.0 specification, sections 3.5.2 and 3.5.3 (node hierarchy, transformations).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.formats.gltf_file import GltfFile

__all__ = ["NodeTree", "ShownMesh", "compose"]

_MAX_NODES = 10_000
_ZERO = 1e-12
_HIDDEN_SCALE = 1e-4  # small enough to hide a part of a body, large enough to be inverted


class ShownMesh(NamedTuple):
    """A mesh in the default scene, as indices into the lists of the file."""

    node: int
    """The node that holds the mesh."""
    mesh: int
    skin: int | None
    """The skin that moves the mesh; None if the node does."""


def compose(translation: NDArray[np.float64], rotation: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices T @ R @ S [..., 4, 4].

    Args:
        translation: [..., 3].
        rotation: [..., 4], unit quaternions (x, y, z, w).
        scale: [..., 3].
    """
    shape = np.broadcast_shapes(translation.shape[:-1], rotation.shape[:-1], scale.shape[:-1])
    x, y, z, w = np.moveaxis(rotation, -1, 0)
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    matrix[..., 2, 0], matrix[..., 2, 1], matrix[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    matrix[..., :3, :3] *= scale[..., None, :]
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1
    return matrix


class NodeTree:
    """The nodes of a file: a forest, since every node has at most one parent."""

    def __init__(self, file: GltfFile) -> None:
        """Read the hierarchy and the transforms at rest.

        Raises:
            UserError: a node is its own ancestor or has two parents, an index is out of range, or a quaternion is zero.
        """
        self._file = file
        self.nodes: list[dict[str, Any]] = file.items("nodes")
        if len(self.nodes) > _MAX_NODES:
            file.fail(f"wanted at most {_MAX_NODES} nodes, got {len(self.nodes)}; simplify the scene")
        self.parents = [-1] * len(self.nodes)
        self._children = [self._read_children(number) for number in range(len(self.nodes))]
        for number, children in enumerate(self._children):
            for child in children:
                if self.parents[child] >= 0:
                    file.fail(f"node {child} has two parents; export it again")
                self.parents[child] = number
        self.order = self._below([number for number, parent in enumerate(self.parents) if parent < 0])
        """Indices of all nodes, a parent before its children."""
        if len(self.order) < len(self.nodes):
            file.fail("a node is its own ancestor; export it again")
        self._parts = [self._read_parts(number) for number in range(len(self.nodes))]
        self.locals = [self._read_local(number) for number in range(len(self.nodes))]
        """[4, 4] per node, transform from the frame of the node to that of its parent, at rest."""

    def _read_children(self, number: int) -> list[int]:
        children = self.nodes[number].get("children", [])
        if not isinstance(children, list):
            self._file.fail(f"children of node {number} is not a list; export it again")
        return [self._file.checked_index(child, "nodes", f"a child of node {number}") for child in children]

    def _read_parts(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return translation [3], unit quaternion [4] and scale [3] of a node at rest."""
        node, what = self.nodes[number], f"node {number}"
        if "matrix" in node:  # the specification forbids shear here, and such nodes are not meant to be animated
            matrix = self._file.numbers(node, "matrix", (0.0,) * 16, what).reshape(4, 4).T
            scale = np.linalg.norm(matrix[:3, :3], axis=0)
            if np.linalg.det(matrix[:3, :3]) < 0:
                scale[0] = -scale[0]
            return matrix[:3, 3], _quaternion(matrix[:3, :3] / np.where(scale == 0, 1.0, scale)), scale
        rotation = self._file.numbers(node, "rotation", (0.0, 0.0, 0.0, 1.0), what)
        length = np.linalg.norm(rotation)
        if not length > 1e-12:
            self._file.fail(f"rotation of {what} is a zero quaternion; export it again")
        translation = self._file.numbers(node, "translation", (0.0, 0.0, 0.0), what)
        return translation, rotation / length, self._file.numbers(node, "scale", (1.0, 1.0, 1.0), what)

    def _read_local(self, number: int) -> NDArray[np.float64]:
        node = self.nodes[number]
        if "matrix" not in node:
            return compose(*self._parts[number])
        matrix = self._file.numbers(node, "matrix", (0.0,) * 16, f"node {number}").reshape(4, 4).T  # stored by columns
        matrix[3] = 0.0, 0.0, 0.0, 1.0
        return matrix

    def _below(self, roots: Iterable[int]) -> list[int]:
        """Return the nodes `roots` and all their descendants, a parent before its children."""
        found, waiting = [], list(reversed(list(roots)))
        while waiting:
            number = waiting.pop()
            found.append(number)
            waiting.extend(reversed(self._children[number]))
        return found

    def in_scene(self) -> list[int]:
        """Return the nodes of the default scene, or all nodes if the file has no scene.

        A scene should name nodes without a parent; some name others, which viewers show. They keep their place in the world.
        """
        file = self._file
        number = file.index(file.root, "scene", "scenes", "the file")
        scenes = file.items("scenes")
        if not scenes:
            return self.order
        roots = scenes[number or 0].get("nodes", [])
        if not isinstance(roots, list):
            file.fail(f"nodes of scene {number or 0} is not a list; export it again")
        roots = [file.checked_index(root, "nodes", f"a node of scene {number or 0}") for root in roots]
        named, below = set(roots), set()
        for number in self.order:
            if self.parents[number] in named or self.parents[number] in below:
                below.add(number)
        return self._below(dict.fromkeys(root for root in roots if root not in below))

    def shown_meshes(self) -> list[ShownMesh]:
        """Return the meshes of the default scene, in the order of `in_scene`.

        Raises:
            UserError: an index is out of range.
        """
        file, shown = self._file, []
        for number in self.in_scene():
            node, what = self.nodes[number], f"node {number}"
            mesh = file.index(node, "mesh", "meshes", what)
            if mesh is not None:
                shown.append(ShownMesh(number, mesh, file.index(node, "skin", "skins", what)))
        return shown

    def with_ancestors(self, numbers: Iterable[int]) -> list[int]:
        """Return these nodes and all their ancestors, a parent before its children."""
        wanted: set[int] = set()
        for number in numbers:
            while number >= 0 and number not in wanted:
                wanted.add(number)
                number = self.parents[number]
        return [number for number in self.order if number in wanted]

    def worlds(
        self,
        numbers: Iterable[int],
        animated: Mapping[int, Mapping[str, NDArray[np.float64]]] | None = None,
        *,
        keep_zero: bool = True,
    ) -> dict[int, NDArray[np.float64]]:
        """Return the transforms [T, 4, 4] from the frame of each node to the world; T is 1 for nodes that do not move.

        Args:
            numbers: node indices, as `with_ancestors` returns them.
            animated: per moving node, some of `translation` [T, 3], `rotation` [T, 4] and `scale` [T, 3] over time.
            keep_zero: False for a scale of 1e-4 instead of 0, by which artists hide parts; directions are then still known.
        """
        found: dict[int, NDArray[np.float64]] = {}
        for number in numbers:
            local = self.locals[number]
            moving = animated.get(number, {}) if animated else {}
            scale = moving.get("scale", self._parts[number][2])
            is_zero = np.abs(scale) < _ZERO
            if moving or (not keep_zero and is_zero.any()):
                scale = scale if keep_zero else np.where(is_zero, _HIDDEN_SCALE, scale)
                translation, rotation, _ = self._parts[number]
                local = compose(moving.get("translation", translation), moving.get("rotation", rotation), scale)
            parent = self.parents[number]
            found[number] = local.reshape(-1, 4, 4) if parent < 0 else found[parent] @ local
        return found


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (x, y, z, w) of the rotation nearest to a matrix [3, 3]."""
    u, _, v = np.linalg.svd(rotation)
    u[:, 2] *= np.sign(np.linalg.det(u @ v)) or 1.0
    return Rotation.from_matrix(u @ v).as_quat()
