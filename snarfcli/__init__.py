"""Learn an animatable avatar of one subject from posed meshes (SNARF, ICCV 2021; Fast-SNARF, PAMI 2023).

The package is called `snarf` as well: `import snarf` and `import snarfcli` give the same modules and objects.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from snarfcli.extras import missing_packages

if TYPE_CHECKING:
    from snarfcli.avatar import Avatar
    from snarfcli.bodies import Body, Skeleton, builtin_body, load_body
    from snarfcli.deformer import (
        CanonicalGrid,
        Correspondences,
        ForwardDeformer,
        PresetWeights,
        SearchConfig,
        SkinningConfig,
        find_correspondences,
        find_correspondences_on_field,
        find_correspondences_on_map,
        skin,
    )
    from snarfcli.errors import UserError

try:
    __version__ = version("snarf")
except PackageNotFoundError:  # a checkout that is on the path but not installed
    __version__ = "0+unknown"

__all__ = [
    "Avatar",
    "Body",
    "CanonicalGrid",
    "Correspondences",
    "ForwardDeformer",
    "PresetWeights",
    "SearchConfig",
    "Skeleton",
    "SkinningConfig",
    "UserError",
    "__version__",
    "builtin_body",
    "find_correspondences",
    "find_correspondences_on_field",
    "find_correspondences_on_map",
    "load_body",
    "skin",
]

_HOMES = {
    "avatar": ("Avatar",),
    "bodies": ("Body", "Skeleton", "builtin_body", "load_body"),
    "deformer": (
        "CanonicalGrid",
        "Correspondences",
        "ForwardDeformer",
        "PresetWeights",
        "SearchConfig",
        "SkinningConfig",
        "find_correspondences",
        "find_correspondences_on_field",
        "find_correspondences_on_map",
        "skin",
    ),
    "errors": ("UserError",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
_MODULES = ["bodies", "deformer", "errors", "networks", "shape"]
if missing_packages("commands"):
    # For `import *` and help(); `from snarf import Avatar` says what to install.
    del __all__[__all__.index("Avatar")]  # pyright: ignore[reportUnsupportedDunderAll]
else:
    _MODULES += ["export", "meshing", "motions"]


def __getattr__(name: str) -> Any:
    """Import a public name or module on first use, so that `import snarfcli` stays cheap."""
    if name in _MODULES:
        return importlib.import_module(f"snarfcli.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'snarfcli' has no attribute {name!r}")
    return getattr(importlib.import_module(f"snarfcli.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES, *(name for name in globals() if name.startswith("__"))})
