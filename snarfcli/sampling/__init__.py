"""Labelled points of posed meshes."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.sampling.cube import CUBE_PADDING, dequantise, pack_vertices, quantise, sampling_cube, unpack_vertices
from snarfcli.sampling.occupancy import (
    INSIDE_TESTS,
    check_mesh,
    count_boundary_edges,
    labels_differ,
    occupancies,
    ray_parity,
    winding_numbers,
)
from snarfcli.sampling.planar import in_turned_over, outline_samples
from snarfcli.sampling.points import (
    BrokenFrame,
    FrameSamples,
    MeshSequence,
    SamplingSettings,
    check_frames,
    frame_generator,
    recorded_settings,
    sample_frame,
    sample_frames,
)
from snarfcli.sampling.surface import (
    POISSON,
    choose_poisson,
    oriented_surface_samples,
    surface_samples,
    uniform_surface_samples,
)

__all__ = [
    "CUBE_PADDING",
    "INSIDE_TESTS",
    "POISSON",
    "BrokenFrame",
    "FrameSamples",
    "MeshSequence",
    "SamplingSettings",
    "check_frames",
    "check_mesh",
    "choose_poisson",
    "count_boundary_edges",
    "dequantise",
    "frame_generator",
    "in_turned_over",
    "labels_differ",
    "occupancies",
    "oriented_surface_samples",
    "outline_samples",
    "pack_vertices",
    "quantise",
    "ray_parity",
    "recorded_settings",
    "sample_frame",
    "sample_frames",
    "sampling_cube",
    "surface_samples",
    "uniform_surface_samples",
    "unpack_vertices",
    "winding_numbers",
]
