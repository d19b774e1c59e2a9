"""Reduce the number of triangles of a mesh."""

from __future__ import annotations

import numpy as np

from snarfcli.meshing.mesh import Mesh

__all__ = ["decimate"]


def decimate(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh of at most `triangles` triangles, without attributes; the same mesh if it has no more.

    MeshLab collapses the edges that change the surface least (Garland and Heckbert, Surface simplification using quadric error
    metrics, SIGGRAPH 1997).

    Raises:
        ValueError: the surface cannot have so few triangles without changing its topology.
    """
    if len(mesh.faces) <= triangles:
        return mesh
    import pymeshlab

    # pymeshlab fills its module from a compiled one, which type checkers do not see.
    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
    corners = mesh.vertices.astype(np.float64)
    meshes.add_mesh(pymeshlab.Mesh(corners, mesh.faces))  # pyright: ignore[reportAttributeAccessIssue]
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=triangles,
        preservetopology=True,  # a hole or a thin bridge would show when the mesh bends
        preservenormal=True,
        optimalplacement=True,
        planarquadric=True,  # more regular triangles on flat parts, which bend better
        autoclean=True,
    )
    result = meshes.current_mesh()
    if result.face_number() > triangles:  # the topology needs more
        raise ValueError(
            f"triangles: wanted at least {result.face_number()} for this surface, got {triangles}; fewer would tear it"
        )
    return Mesh(result.vertex_matrix(), result.face_matrix())
