"""Learn an animatable avatar of one subject from posed meshes (SNARF, ICCV 2021; Fast-SNARF, PAMI 2023)."""

from __future__ import annotations

import importlib

__version__ = "0.1.0"
__all__ = ["Avatar", "__version__", "find_correspondences", "load_body"]

_HOMES = {
    "Avatar": "snarfcli.avatar",
    "find_correspondences": "snarfcli.deformer",
    "load_body": "snarfcli.bodies",
}


def __getattr__(name: str):
    """Load the public classes on first use, so that `import snarfcli` stays cheap."""
    if name not in _HOMES:
        raise AttributeError(f"module 'snarfcli' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
