"""Load the native CPU library, and keep the reason if that fails."""

from __future__ import annotations

import ctypes
import json
import os
import struct
import sys
from functools import cache
from pathlib import Path
from typing import Any

__all__ = [
    "ABI_VERSION",
    "build_note",
    "instruction_set",
    "library_path",
    "native_library",
    "why_unavailable",
]

ABI_VERSION = 5
"""Version of the C interface (csrc/include/snarf/api.h) that this code uses."""

_ENDINGS = {"darwin": "dylib", "win32": "dll"}
_FILE_NAME = f"libsnarf_native.{_ENDINGS.get(sys.platform, 'so')}"
_VARIABLE = "SNARF_NATIVE_LIBRARY"
_COMPILERS = "Debian and Ubuntu: apt install g++; macOS: xcode-select --install; Windows: Visual Studio Build Tools with C++"


def native_library() -> ctypes.CDLL | None:
    """Return the native library, loaded on the first call, or None; then `why_unavailable` states the reason. Never raises.

    The environment variable SNARF_NATIVE_LIBRARY replaces the installed file by another.
    """
    return _load()[0]


def library_path() -> Path | None:
    """Return the file of the loaded library, or None if there is none."""
    return _load()[1]


def why_unavailable() -> str | None:
    """Return why the library could not be loaded and what to do, in one line, or None if it is loaded."""
    return _load()[2]


def instruction_set() -> str | None:
    """Return the instruction set that the library uses on this processor, such as avx2, or None without a library."""
    library = native_library()
    if library is None:
        return None
    function = library.snarf_instruction_set
    function.argtypes, function.restype = (), ctypes.c_char_p
    return function().decode()


def build_note() -> dict[str, Any]:
    """Return the note of the build: `built`, and `compiler` and `instruction_sets` or the `reason`; empty without a note."""
    for folder in _folders():
        try:
            note = json.loads((folder / "native_build.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(note, dict):
            return note
    return {}


@cache
def _load() -> tuple[ctypes.CDLL | None, Path | None, str | None]:
    """Return library, file and None, or None, None and the reason."""
    try:
        path = _find()
        _check_whole(path)
        library = ctypes.CDLL(str(path))
        _check_version(library, path)
    except _Unavailable as error:
        return None, None, str(error)
    except Exception as error:  # any damage of the file: the reference still works
        reason = " ".join(str(error).split()) or type(error).__name__
        return None, None, f"the native library cannot be loaded: {reason}; reinstall snarf"
    return library, path, None


class _Unavailable(Exception):
    """There is no library; the message states the reason and the next step."""


def _folders() -> list[Path]:
    """Return the folders of an installation: that of this file and, if this file is in a checkout, that in site-packages."""
    own = Path(__file__).parent
    package = sys.modules.get(__package__ or "")
    return list(dict.fromkeys([own, *map(Path, getattr(package, "__path__", ()))]))


def _find() -> Path:
    """Return the library's file."""
    named = os.environ.get(_VARIABLE)
    if named:
        path = Path(named).absolute()
        if not path.is_file():
            raise _Unavailable(f"{_VARIABLE} names {named}, which is not a file; correct or unset it")
        return path
    for folder in _folders():
        if (folder / _FILE_NAME).is_file():
            return folder / _FILE_NAME
    reason = build_note().get("reason")
    if reason:
        raise _Unavailable(f"{reason}; install a C++17 compiler ({_COMPILERS}), then reinstall snarf")
    raise _Unavailable(
        f"there is no {_FILE_NAME} in {_folders()[0]}: if Python was started in the folder of the sources, which hides the "
        "installed package, start it elsewhere; otherwise the library failed to build: reinstall snarf with a C++ compiler at "
        "hand (pip install -v shows what the compiler says)"
    )


def _check_whole(path: Path) -> None:
    """Raise for an ELF file that ends before its segments do: loading it would end the process with a bus error.

    The loaders of other systems check this. Offsets are those of the 64-bit ELF header (System V ABI, chapter 4).
    """
    with open(path, "rb") as file:
        head = file.read(64)
        if len(head) < 64 or head[:6] != b"\x7fELF\x02\x01":  # 64 bits, little-endian; the loader judges anything else
            return
        table, entry_size, entries = *struct.unpack_from("<Q", head, 32), *struct.unpack_from("<HH", head, 54)
        file.seek(table)
        rows = file.read(entry_size * entries)
    size = path.stat().st_size
    whole = len(rows) == entry_size * entries
    for start in range(0, len(rows) - 55, max(entry_size, 56)):
        offset, length = struct.unpack_from("<Q", rows, start + 8)[0], struct.unpack_from("<Q", rows, start + 32)[0]
        whole &= offset + length <= size
    if not whole:
        raise _Unavailable(f"{path} is damaged (it ends too early); reinstall snarf")


def _check_version(library: ctypes.CDLL, path: Path) -> None:
    """Raise for a library whose interface has another version."""
    try:
        function = library.snarf_abi_version
    except AttributeError:
        raise _Unavailable(f"{path} is not a library of snarf") from None
    function.argtypes, function.restype = (), ctypes.c_int
    version = function()
    if version != ABI_VERSION:
        raise _Unavailable(f"{path}: wanted version {ABI_VERSION} of the interface, got {version}; reinstall snarf")
