"""Raises `MissingPackage` when it is imported without the extra `commands`; the rooms that need this extra import it first."""

from __future__ import annotations

from snarfcli.extras import require_packages

__all__: list[str] = []

# The packages that are imported with the modules that use them. Others are imported when they are needed.
require_packages(
    "commands",
    {
        "filelock": "filelock",
        "hydra": "hydra-core",
        "igl": "libigl",
        "PIL": "pillow",
        "scipy": "scipy",
        "skimage": "scikit-image",
    },
)
