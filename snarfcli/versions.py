"""The packages whose versions are recorded with every result."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

__all__ = ["RECORDED_PACKAGES", "installed_version", "recorded_versions"]

RECORDED_PACKAGES = ("snarf", "torch", "numpy", "scikit-image", "trimesh", "libigl", "pymeshlab", "embreex")
"""Packages that samples, avatars and measurements depend on."""


def installed_version(package: str) -> str | None:
    """Return the version of an installed package, or None. The package is not imported."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def recorded_versions() -> dict[str, str]:
    """Return the versions of Python and of the recorded packages; "not installed" for a missing one."""
    versions = {package: installed_version(package) or "not installed" for package in RECORDED_PACKAGES}
    return {"python": platform.python_version(), **versions}
