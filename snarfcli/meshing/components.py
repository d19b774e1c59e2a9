"""Connected surfaces of a mesh, on any device."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from snarfcli.meshing.lattice import flat_indices

__all__ = ["connect_on_device", "connect_on_host", "count_components", "keep_components"]

# Rounds between two tests for the end. Bodies take 4 at 128 voxels, 5 at 256, and 5 or 6 at 512. On a CPU SciPy takes a third
# of the time.
_ROUNDS = 6


def keep_components(vertices: Tensor, faces: Tensor, share: float) -> tuple[Tensor, Tensor, int, int]:
    """Drop the connected surfaces with fewer faces than `share` of the largest one.

    Args:
        vertices: [V, 3].
        faces: [F, 3] int64, which use all vertices.
        share: 0 keeps all surfaces, 1 only the largest.

    Returns:
        The remaining vertices and faces, the number of surfaces found, and the number kept.
    """
    if not len(faces):
        return vertices, faces, 0, 0
    connect = connect_on_host if faces.device.type == "cpu" else connect_on_device
    labels = connect(faces, len(vertices))
    sizes = torch.zeros(len(vertices), dtype=torch.long, device=faces.device)
    sizes.index_add_(0, labels[faces[:, 0]], torch.ones_like(faces[:, 0]))
    keep = (sizes > 0) & (sizes.double() >= share * sizes.max().double())
    found, kept = torch.stack([(sizes > 0).sum(), keep.sum()]).tolist()
    if found == kept:
        return vertices, faces, found, kept
    used = keep[labels]
    numbers = used.cumsum(0) - 1
    left = faces[flat_indices(used[faces[:, 0]])]
    return vertices[flat_indices(used)], numbers[left], found, kept


def count_components(faces: np.ndarray, num_vertices: int) -> int:
    """Return the number of connected surfaces with faces [F, 3]."""
    labels = connect_on_host(torch.from_numpy(faces), num_vertices)
    return len(np.unique(labels[faces[:, 0]]))


def connect_on_host(faces: Tensor, num_vertices: int) -> Tensor:
    """Return a number for each vertex, [V] int64, below V, that two vertices share if and only if faces connect them."""
    first, second, third = faces.cpu().numpy().T
    start, end = np.concatenate([first, second]), np.concatenate([second, third])
    graph = coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(num_vertices, num_vertices))
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long().to(faces.device)


def connect_on_device(faces: Tensor, num_vertices: int) -> Tensor:
    """Return the same as `connect_on_host`, with other numbers, on a GPU; the host waits once in six rounds.

    Each vertex has a root, a vertex of the same surface with a number not above its own. In a round, the roots of the ends of
    each edge get the smaller one as their root; then each vertex gets the root of its root, twice. It ends when the ends of
    each edge have the same root, which is then the first vertex of the surface.
    """
    start, end = torch.cat([faces[:, 0], faces[:, 1]]), torch.cat([faces[:, 1], faces[:, 2]])
    root = torch.arange(num_vertices, device=faces.device)
    while True:
        for _ in range(_ROUNDS):
            root_a, root_b = root[start], root[end]
            smaller = torch.minimum(root_a, root_b)
            root = root.scatter_reduce(0, root_a, smaller, "amin").scatter_reduce(0, root_b, smaller, "amin")
            root = root[root]
            root = root[root]
        if bool((root[start] == root[end]).all()):
            return root
