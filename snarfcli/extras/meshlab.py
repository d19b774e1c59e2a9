"""MeshLab, which is optional: whether it can be used, and how to install it."""

from __future__ import annotations

from snarfcli.extras import why_not_imported

__all__ = ["INSTALL_MESHLAB", "MESHLAB_NEEDS", "why_no_meshlab"]

MESHLAB_NEEDS = "on Linux it needs libGL.so.1 and libOpenGL.so.0 (Debian and Ubuntu: apt install libgl1 libopengl0)"
INSTALL_MESHLAB = f"pip install pymeshlab (licence GPL-3); {MESHLAB_NEEDS}"
_FILTERS = ("generate_boolean_union", "generate_sampling_poisson_disk", "meshing_decimation_quadric_edge_collapse")


def why_no_meshlab() -> str | None:
    """Import MeshLab, which takes up to a second. Return why it cannot be used, as one line; None if it can.

    MeshLab's filters are plugins. It starts without those that miss a library of the system, and prints their names.
    """
    reason = why_not_imported("pymeshlab", "pymeshlab")
    if reason is not None:
        return reason
    import pymeshlab

    missing = [name for name in _FILTERS if not hasattr(pymeshlab.MeshSet, name)]  # pyright: ignore[reportAttributeAccessIssue]
    return f"pymeshlab could not load its plugin with {missing[0]}" if missing else None
