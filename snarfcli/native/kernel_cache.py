"""Compiled kernels on disk, in the user's cache folder. What cannot be read or written there is compiled again."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import time
from pathlib import Path

__all__ = ["cache_folder", "read_cached", "write_cached"]

_CHECKSUM_BYTES = 32
_UNFINISHED = ".part"
_ABANDONED_S = 3600.0  # age of an unfinished file whose writer has been killed; writing takes milliseconds


def cache_folder() -> Path | None:
    """Return the folder of compiled kernels, snarf/cuda in the user's cache folder, or None if the user has no such folder."""
    named = Path(os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME", ""))
    if not named.is_absolute():  # not set, or invalid (XDG Base Directory Specification)
        try:
            home = Path.home()
        except RuntimeError:  # neither in the environment nor among the system's users
            return None
        named = home / "AppData" / "Local" if sys.platform == "win32" else home / ".cache"
    return named / "snarf" / "cuda" if named.is_absolute() else None


def read_cached(path: Path) -> bytes | None:
    """Return the code in a file, or None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    checksum, code = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
    return code if code and hashlib.sha256(code).digest() == checksum else None


def write_cached(path: Path, code: bytes) -> None:
    """Write code into a file, which appears whole or not at all, also if the process is killed. Does nothing if it cannot."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(path.parent)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=_UNFINISHED)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise


def _remove_abandoned(folder: Path) -> None:
    """Delete what killed processes have left of files that they were writing."""
    for path in folder.glob(f"*{_UNFINISHED}"):
        with contextlib.suppress(OSError):  # another process may be deleting it
            if time.time() - path.stat().st_mtime > _ABANDONED_S:
                path.unlink()
