"""Surfaces of fields and avatars: coarse-to-fine evaluation, marching cubes, posed and skinned meshes, mesh files."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.meshing.extract import EmptySurface, FullSurface, extract_surface
from snarfcli.meshing.mesh import ExtractionStats, Mesh, vertex_normals
from snarfcli.meshing.posed import SURFACES, posed_mesh
from snarfcli.meshing.skinned import SkinnedSurface, skinned_surface
from snarfcli.meshing.surfaces import canonical_surface, field_surface

__all__ = [
    "SURFACES",
    "EmptySurface",
    "ExtractionStats",
    "FullSurface",
    "Mesh",
    "SkinnedSurface",
    "canonical_surface",
    "extract_surface",
    "field_surface",
    "posed_mesh",
    "skinned_surface",
    "vertex_normals",
]
