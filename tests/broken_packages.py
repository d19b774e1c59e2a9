"""Packages that are installed and cannot be used, as where a library of the system is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

__all__ = ["NO_LIBRARY", "install_broken"]

NO_LIBRARY = "libGL.so.1: cannot open shared object file: No such file or directory"


def install_broken(monkeypatch: pytest.MonkeyPatch, folder: Path, module: str, code: str = "") -> None:
    """Put a package with the name of another before it, until the test ends.

    Args:
        monkeypatch: undoes it.
        folder: an empty folder for the package.
        module: its name.
        code: what its import runs; by default it fails as for want of a library of the system.
    """
    (folder / module).mkdir(parents=True)
    (folder / module / "__init__.py").write_text(code or f"raise ImportError({NO_LIBRARY!r})\n")
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setitem(sys.modules, module, None)  # so that the broken one is forgotten afterwards
    monkeypatch.delitem(sys.modules, module)
