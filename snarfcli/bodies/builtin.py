"""The built-in body."""

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
    """Return the built-in body: 24 joints, 6890 vertices, closed surface, 10 shape parameters.

    `tools/make_body.py` derived it from MakeHuman's CC0 data only; its licence is CC0-1.0. It has as many vertices and faces as
    SMPL's body, but is not SMPL's mesh. It is read once and shared: do not modify its tensors.
    """
    return load_body(_FILE, dtype=dtype)
