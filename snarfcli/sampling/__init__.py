"""Points and occupancies of one posed mesh."""

from snarfcli.sampling.occupancy import (
    INSIDE_TESTS,
    check_mesh,
    count_boundary_edges,
    labels_differ,
    occupancies,
    ray_parity,
    winding_numbers,
)
from snarfcli.sampling.parallel import Worker, count_cores, interrupts_held_back, run_in_processes
from snarfcli.sampling.points import (
    CUBE_PADDING,
    BrokenFrame,
    FrameSamples,
    SamplingSettings,
    dequantise,
    frame_generator,
    quantise,
    sample_frame,
    sample_frames,
    sampling_cube,
    surface_samples,
    uniform_surface_samples,
)

__all__ = [
    "CUBE_PADDING",
    "INSIDE_TESTS",
    "BrokenFrame",
    "FrameSamples",
    "SamplingSettings",
    "Worker",
    "check_mesh",
    "count_boundary_edges",
    "count_cores",
    "dequantise",
    "frame_generator",
    "interrupts_held_back",
    "labels_differ",
    "occupancies",
    "quantise",
    "ray_parity",
    "run_in_processes",
    "sample_frame",
    "sample_frames",
    "sampling_cube",
    "surface_samples",
    "uniform_surface_samples",
    "winding_numbers",
]
