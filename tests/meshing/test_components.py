from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from snarfcli.meshing.components import connect_on_device, connect_on_host, count_components, keep_components
from snarfcli.meshing.lattice import Lattice
from snarfcli.meshing.marching import march


def two_balls() -> tuple[torch.Tensor, torch.Tensor, trimesh.Trimesh]:
    small, large = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.icosphere(subdivisions=2)
    vertices = np.concatenate([small.vertices, large.vertices + 5])
    faces = np.concatenate([small.faces, large.faces + len(small.vertices)])
    return torch.from_numpy(vertices), torch.from_numpy(faces), large


@pytest.mark.parametrize("connect", [connect_on_host, connect_on_device])
def test_small_surfaces_are_dropped(connect, monkeypatch):
    monkeypatch.setattr("snarfcli.meshing.components.connect_on_host", connect)
    vertices, faces, large = two_balls()
    kept_vertices, kept_faces, found, kept = keep_components(vertices, faces, 0.5)
    assert (found, kept) == (2, 1)
    np.testing.assert_array_equal(kept_vertices[kept_faces], large.vertices[large.faces] + 5)
    assert len(kept_vertices) == len(large.vertices)
    all_vertices, all_faces, found, kept = keep_components(vertices, faces, 0.0)
    assert (found, kept) == (2, 2)
    assert all_vertices is vertices
    assert all_faces is faces


def test_no_faces_are_no_surfaces():
    assert keep_components(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long), 0.5)[2:] == (0, 0)
    assert count_components(np.zeros((0, 3), np.int32), 0) == 0


def partition(labels: torch.Tensor) -> np.ndarray:
    """Return labels numbered by the first vertex of each surface."""
    _, first, inverse = np.unique(labels.numpy(), return_index=True, return_inverse=True)
    return first[inverse]


@pytest.mark.parametrize("numbering", ["along", "mixed"])
def test_host_and_device_find_the_same_surfaces(numbering):
    """Hundreds of surfaces of noise, and long strips: with the worst numbering, labels move one vertex a round at first."""
    generator = torch.Generator().manual_seed(0)
    inside = torch.rand(30, 30, 30, generator=generator) > 0.8
    for axis in range(3):
        inside.select(axis, 0).fill_(False)
        inside.select(axis, -1).fill_(False)
    crossings = march(Lattice((0.0, 0.0, 0.0), 1.0, 1, (30, 30, 30)), inside, torch.where(inside, 1.0, -1.0).reshape(-1))
    count = len(crossings.axis)
    strip = torch.arange(5000)[:, None] + torch.tensor([0, 1, 2])
    faces = torch.cat([crossings.faces, count + strip, count + 5002 + strip])
    count += 2 * 5002
    if numbering == "mixed":
        faces = torch.randperm(count, generator=generator)[faces]
    on_host, on_device = connect_on_host(faces, count), connect_on_device(faces, count)
    np.testing.assert_array_equal(partition(on_host), partition(on_device))
    assert count_components(faces.numpy(), count) == len(on_host.unique()) > 100
