"""Files that appear complete or not at all, JSON files from anywhere, and digests; `array_files` reads arrays."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError
from snarfcli.texts import one_line

__all__ = [
    "atomic_path",
    "check_regular",
    "file_digest",
    "find_temporaries",
    "flush_to_disk",
    "read_json",
    "remove_temporaries",
    "write_arrays",
    "write_json",
    "write_tensors",
]

_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{8}\.tmp((?:\.[^.]*)?)")
_MAX_JSON_BYTES = 2**25  # about 600 MiB when parsed


@contextmanager
def atomic_path(path: str | Path, *, flush_name: bool = True) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; it replaces `path` if the block succeeds and is deleted if it fails.

    Parent folders are created. The temporary name keeps the suffix, by which many writers choose the format. The content is
    on the disk before the name changes, so that a power cut leaves the old file or the new one.

    Args:
        path: the file.
        flush_name: wait until the new name is on the disk too; half of the time for small files. Not needed for files of a
            series, if something is written at its end that waits for the names in the folder.

    Raises:
        OSError: the file cannot be written. It names `path`, also for a full disk, where the system names no file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        flush_to_disk(temporary)
        os.replace(temporary, path)
        if flush_name:
            flush_to_disk(path.parent)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporaries(folder: Path, *names: str, recursive: bool = False) -> None:
    """Delete what killed processes have left of files that `atomic_path` was writing in a folder.

    Only the holder of the folder's lock may do so: the files of a running process look alike.

    Args:
        folder: the folder, which need not exist.
        names: names of the files that were being written; any if none is given.
        recursive: whether in the folders below too.
    """
    for path in find_temporaries(folder, *names, recursive=recursive):
        path.unlink(missing_ok=True)


def find_temporaries(folder: Path, *names: str, recursive: bool = False) -> list[Path]:
    """Return the files that `remove_temporaries` deletes."""
    found = []
    for path in folder.glob("**/.*.tmp*" if recursive else ".*.tmp*"):
        match = _TEMPORARY.fullmatch(path.name)
        if match and (not names or match[1] + match[2] in names):
            found.append(path)
    return found


def flush_to_disk(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk, where the system can tell.

    Raises:
        OSError: the disk is full, or reports an error.
    """
    is_folder = path.is_dir()
    if is_folder and os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):  # some file systems of networks
            raise
    finally:
        os.close(descriptor)


def write_json(path: str | Path, content: Any) -> None:
    """Write `content` as indented JSON, complete or not at all; the same bytes on every system."""
    with atomic_path(path) as temporary:
        temporary.write_bytes((json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def write_tensors(path: str | Path, content: Any) -> None:
    """Write `content` with `torch.save`, complete or not at all.

    Raises:
        OSError: the file cannot be written. (For a full disk `torch.save` alone raises a RuntimeError without a reason.)
    """
    import torch  # takes seconds, which reading needs not

    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an `.npz` archive atomically."""
    with atomic_path(path) as temporary:
        np.savez(temporary, **arrays)  # pyright: ignore[reportArgumentType]  # stub: takes arrays for allow_pickle


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def check_regular(path: Path, what: str, kind: str) -> None:
    """Check that a path is a regular file. (A pipe would block.)"""
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name {kind} file")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not path.is_file():
        raise UserError(f"{what} {path} is not a regular file; name {kind} file")


def read_json(path: str | Path, what: str = "file") -> Any:
    """Read a JSON file.

    Raises:
        UserError: the file is missing, is not JSON or is larger than 32 MiB.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    check_regular(path, what, "a")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise UserError(f"{what} {path} is larger than {_MAX_JSON_BYTES // 2**20} MiB; name another file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # bad UTF-8, bad JSON, a number of over 4300 digits
        raise UserError(f"{what} {path} is not valid JSON ({one_line(error, 200)}); make it again") from None
    except RecursionError:
        raise UserError(f"{what} {path} is not valid JSON (nested too deeply); make it again") from None
