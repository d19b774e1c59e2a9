"""The body that comes with the package."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch

from snarfcli.bodies.body import Body
from snarfcli.bodies.model_files import load_body

__all__ = ["builtin_body"]

_FILE = Path(__file__).with_name("body_cc0.npz")


@lru_cache(maxsize=2)
def builtin_body(dtype: torch.dtype = torch.float32) -> Body:
    """Return the body that comes with the package: 24 joints, 6890 vertices, closed surface, 10 shape parameters.

    Derived only from MakeHuman's CC0 data by `tools/make_body.py`, and itself CC0-1.0. It has the numbers of vertices
    and faces of SMPL's body, but it is not SMPL's mesh. Read once and shared: do not write into its tensors.
    """
    return load_body(_FILE, dtype=dtype)
