"""The versions that are recorded with every result: of packages, and of the code itself."""

from __future__ import annotations

import functools
import hashlib
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["RECORDED_PACKAGES", "installed_version", "recorded_code", "recorded_versions"]

_PACKAGE = Path(__file__).absolute().parent
_SOURCES = ("*.py", "*.yaml", "*.cpp", "*.h", "*.cu", "*.cuh")
_PATIENCE_S = 10.0

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


@functools.cache
def recorded_code() -> dict[str, str]:
    """Return the version of the code: `digest`, a hash of its files, and in a checkout `commit`, "-dirty" if it has changes.

    The digest covers Python files, configuration and native sources. It is the same for the same files in any folder, but an
    installed package has no native sources, so its digest differs from that of its checkout. The files are read once, so a
    command that works for long calls this when it begins.
    """
    commit = _commit(_PACKAGE.parent)
    return {"digest": _digest(_PACKAGE)} | ({} if commit is None else {"commit": commit})


def _digest(package: Path) -> str:
    """Return a hash of the names and contents of the sources in a package and, in a checkout, of conf/ and csrc/ beside it."""
    inside = package / "conf"
    folders = [package] if inside.is_dir() else [package, package.parent / "conf", package.parent / "csrc"]
    known = hashlib.sha256()
    for folder in folders:
        paths = (path for pattern in _SOURCES for path in folder.rglob(pattern) if path.is_file())
        for name, path in sorted((path.relative_to(folder.parent).as_posix(), path) for path in paths):
            known.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return known.hexdigest()[:12]


def _commit(checkout: Path) -> str | None:
    """Return the commit of a checkout; None if the folder is none, or git cannot tell."""
    if not (checkout / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
        return subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None
