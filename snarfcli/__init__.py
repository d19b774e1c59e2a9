"""Learn an animatable avatar of one subject from posed meshes (SNARF, ICCV 2021; Fast-SNARF, PAMI 2023)."""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from snarfcli.avatar import Avatar
    from snarfcli.bodies import load_body
    from snarfcli.deformer import find_correspondences

try:
    __version__ = version("snarf")
except PackageNotFoundError:  # a checkout that is on the path but not installed
    __version__ = "0+unknown"

__all__ = ["Avatar", "__version__", "find_correspondences", "load_body"]

_HOMES = {
    "Avatar": "snarfcli.avatar",
    "find_correspondences": "snarfcli.deformer",
    "load_body": "snarfcli.bodies",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import snarfcli` stays cheap."""
    if name not in _HOMES:
        raise AttributeError(f"module 'snarfcli' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
