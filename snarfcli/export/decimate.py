"""Meshes with fewer triangles."""

from __future__ import annotations

import numpy as np

from snarfcli.meshing.mesh import Mesh

__all__ = ["decimate"]


def decimate(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh of at most so many triangles, without attributes; the mesh itself if it has no more.

    Edges are collapsed where that changes the surface least (Garland and Heckbert, Surface simplification using quadric error
    metrics, SIGGRAPH 1997), by MeshLab.

    Raises:
        ValueError: so few triangles are not enough for this surface.
    """
    if len(mesh.faces) <= triangles:
        return mesh
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices.astype(np.float64), mesh.faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=triangles,
        preservetopology=True,  # a hole or a hair-thin bridge would show when the mesh bends
        preservenormal=True,
        optimalplacement=True,
        planarquadric=True,  # evener triangles where the surface is flat, which bend better
        autoclean=True,
    )
    result = meshes.current_mesh()
    if result.face_number() > triangles:  # what keeps the topology has an end
        raise ValueError(
            f"the surface cannot have fewer than {result.face_number()} triangles without tearing, got triangles={triangles}"
        )
    return Mesh(result.vertex_matrix(), result.face_matrix())
