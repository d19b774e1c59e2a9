"""Reading of untrusted files without risk, and writing of files that appear complete or not at all."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import re
import secrets
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from snarfcli.errors import UserError, raise_system_error
from snarfcli.texts import one_line

__all__ = [
    "MAX_ARRAY_BYTES",
    "atomic_path",
    "file_digest",
    "find_temporaries",
    "flush_to_disk",
    "list_npz",
    "map_npy",
    "read_json",
    "read_npy",
    "read_npz",
    "remove_temporaries",
    "write_arrays",
    "write_json",
    "write_tensors",
]

MAX_ARRAY_BYTES = 2**30
"""Maximum total size of the arrays in one file, unless a reader sets another."""
_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{8}\.tmp((?:\.[^.]*)?)")
# Deflate compresses at most about 1030 to 1. Arrays of zeros, such as unused hands, come close, but no large file as a whole.
_BOMB_BYTES = 2**26
_BOMB_RATIO = 500
_MAX_HEADER_BYTES = 2**16
_MAX_JSON_BYTES = 2**25  # about 600 MiB when parsed
# The header is a Python dict with three entries; records have a list instead of a word as type.
_HEADER = (r"'descr':\s*'([^']*)'", r"'fortran_order':\s*(True|False)", r"'shape':\s*\(([\d\sL,]*)\)")


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


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


def remove_temporaries(folder: Path, *names: str) -> None:
    """Delete what killed processes have left of files that `atomic_path` was writing in a folder.

    Only the holder of the folder's lock may do so: the files of a running process look alike.

    Args:
        folder: the folder, which need not exist.
        names: names of the files that were being written; any if none is given.
    """
    for path in find_temporaries(folder, *names):
        path.unlink(missing_ok=True)


def find_temporaries(folder: Path, *names: str, recursive: bool = False) -> list[Path]:
    """Return the files that `remove_temporaries` deletes; with `recursive`, also those in the folders below."""
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
    """Write `content` as indented JSON, complete or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


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


def read_json(path: str | Path, what: str = "file") -> Any:
    """Read a JSON file.

    Raises:
        UserError: the file is missing, is not JSON or is larger than 32 MiB.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    _check_regular(path, what, "a")
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise UserError(f"{what} {path} is larger than {_MAX_JSON_BYTES // 2**20} MiB; name another file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # bad UTF-8, bad JSON, a number of over 4300 digits
        raise UserError(f"{what} {path} is not valid JSON ({one_line(error, 200)}); make it again") from None
    except RecursionError:
        raise UserError(f"{what} {path} is not valid JSON (nested too deeply); make it again") from None


def read_npz(
    path: str | Path,
    what: str = "file",
    *,
    only: Collection[str] | None = None,
    max_bytes: int = MAX_ARRAY_BYTES,
    objects: Callable[[bytes], Any] | None = None,
) -> dict[str, np.ndarray]:
    """Read the arrays of an `.npz` file. Nothing is unpickled; members that are not arrays are left out.

    Sizes are checked before anything is unpacked.

    Args:
        path: file.
        what: the kind of file, for messages.
        only: names of the arrays to read, or None for all. Members that are not read are not checked.
        max_bytes: maximum total size of the arrays.
        objects: returns the content of a pickle without executing it, for arrays of objects; without it, these are rejected.

    Raises:
        UserError: the file is missing, is not a zip archive, is truncated, damaged, encrypted, too large or a zip bomb; an
            array occurs twice, or holds pickled objects or records.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    _check_regular(path, what, "an .npz")
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise UserError(f"{what} {path} is not an .npz archive, or is truncated; copy or download it again")
            with zipfile.ZipFile(file) as archive:
                members = _members(archive, f"{what} {path}", only, max_bytes)
                arrays = {}
                for name, member in members.items():
                    with archive.open(member) as stream:
                        subject = f"{what} {path}: {name!r:.60}"
                        array = _read_array(cast(io.BufferedIOBase, stream), member.file_size, subject, objects)
                    if array is not None:
                        arrays[name] = array
                return arrays
    except UserError:
        raise
    except Exception as error:  # zipfile raises many kinds; tests/fuzz_targets.py found over ten
        raise_system_error(error, path)
        raise UserError(f"{what} {path} is damaged ({one_line(error, 200)}); copy or download it again") from None


def list_npz(path: str | Path, what: str = "file") -> tuple[str, ...]:
    """Return the names of the arrays of an `.npz` file, without reading them.

    Raises:
        UserError: the file is missing, or is not a zip archive.
        OSError: the system cannot read it.
    """
    path = Path(path)
    _check_regular(path, what, "an .npz")
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise UserError(f"{what} {path} is not an .npz archive, or is truncated; copy or download it again")
            with zipfile.ZipFile(file) as archive:
                return tuple(member.filename.removesuffix(".npy") for member in archive.infolist() if not member.is_dir())
    except UserError:
        raise
    except Exception as error:  # zipfile raises many kinds
        raise_system_error(error, path)
        raise UserError(f"{what} {path} is damaged ({one_line(error, 200)}); copy or download it again") from None


def read_npy(
    path: str | Path, what: str = "file", *, max_bytes: int = MAX_ARRAY_BYTES, objects: Callable[[bytes], Any] | None = None
) -> np.ndarray:
    """Read the array of an `.npy` file. Nothing is unpickled; the size is checked first.

    Args:
        path: file.
        what: the kind of file, for messages.
        max_bytes: maximum size of the file.
        objects: see `read_npz`.

    Raises:
        UserError: the file is missing, is not an `.npy` file, is truncated, too large, or holds pickled objects or records.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    _check_regular(path, what, "an .npy")
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise UserError(f"{what} {path} has {size / 2**20:,.0f} MiB, wanted at most {max_bytes / 2**20:,.0f}; split it")
        with path.open("rb") as file:
            array = _read_array(file, size, f"{what} {path}", objects)
    except OSError as error:
        raise_system_error(error, path)
        raise UserError(f"{what} {path} is damaged ({one_line(error, 200)}); copy or download it again") from None
    if array is None:
        raise UserError(f"{what} {path} is not an .npy file, or is truncated; copy or download it again")
    return array


def map_npy(path: str | Path, shape: tuple[int, ...], dtype: type, what: str = "file") -> np.ndarray:
    """Memory-map the array of an `.npy` file.

    Raises:
        UserError: the file is missing, damaged, or its array has another shape or type.
        OSError: the system cannot read it.
    """
    path = Path(path)
    _check_regular(path, what, "an .npy")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = _read_header(file, size, f"{what} {path}")
    wanted = (np.dtype(dtype), "C", shape)
    if head is None or head.offset + head.dtype.itemsize * math.prod(head.shape) != size:
        raise UserError(f"{what} {path} is not an .npy file, or is truncated")
    if head[:3] != wanted:
        raise UserError(f"{what} {path}: wanted {wanted[0]} {list(shape)}, got {head.dtype} {list(head.shape)[:9]}")
    if not math.prod(shape):
        return np.zeros(shape, dtype)
    return np.memmap(path, dtype, "r", head.offset, shape)


def _check_regular(path: Path, what: str, kind: str) -> None:
    """Check that a path is a regular file. (A pipe would block.)"""
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name {kind} file")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not path.is_file():
        raise UserError(f"{what} {path} is not a regular file; name {kind} file")


def _members(
    archive: zipfile.ZipFile, subject: str, only: Collection[str] | None, max_bytes: int
) -> dict[str, zipfile.ZipInfo]:
    """Return the members to read by name, after checks of their sizes and compression."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if member.is_dir() or (only is not None and name not in only):
            continue
        if name in members:
            raise UserError(f"{subject} contains {name!r:.60} twice; save it again")
        if member.flag_bits & 1:
            raise UserError(f"{subject} is damaged or encrypted; copy or download it again")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UserError(f"{subject} uses an unsupported compression; save it again with numpy.savez_compressed")
        members[name] = member
    total, packed = (sum(getattr(member, size) for member in members.values()) for size in ("file_size", "compress_size"))
    if total > max_bytes:
        raise UserError(f"{subject} unpacks to {total / 2**20:,.0f} MiB, wanted at most {max_bytes / 2**20:,.0f}; split it")
    if total > _BOMB_BYTES and total > _BOMB_RATIO * packed:
        raise UserError(
            f"{subject} unpacks to {total / 2**20:,.0f} MiB from {packed / 2**10:,.0f} KiB, which no real data does"
        )
    return members


def _read_array(
    stream: io.BufferedIOBase, size: int, subject: str, objects: Callable[[bytes], Any] | None
) -> np.ndarray | None:
    """Read one array in NumPy's `.npy` format, `size` bytes in total; return None for another format.

    NumPy's own reader trusts any length in the header, and evaluates the header as Python.
    """
    damaged = UserError(f"{subject} is damaged; copy or download the file again")
    head = _read_header(stream, size, subject)
    if head is None:
        return None
    if head.dtype.hasobject and objects is not None:
        return _boxed(objects(stream.read(size)))
    if head.dtype.hasobject:
        raise UserError(f"{subject} holds pickled objects, which are never executed; save plain arrays")
    count = math.prod(head.shape)
    if count * head.dtype.itemsize != size - head.offset or (head.dtype.itemsize == 0 and count > 1):
        raise damaged
    content = bytearray(count * head.dtype.itemsize)
    filled, view = 0, memoryview(content)
    while filled < len(content):
        got = stream.readinto(view[filled : filled + 2**20])
        if not got:
            raise damaged
        filled += got
    if stream.read(1):  # at the end of a member, zipfile compares the checksum
        raise damaged
    try:
        flat = np.frombuffer(content, head.dtype, count) if content else np.zeros(count, head.dtype)
        return flat.reshape(head.shape, order=head.order)
    except (ValueError, TypeError):  # such as too many dimensions
        raise damaged from None


class _Header(NamedTuple):
    """The header of an array."""

    dtype: np.dtype
    order: Literal["C", "F"]
    shape: tuple[int, ...]
    offset: int
    """Number of bytes before the values."""


def _read_header(stream: io.BufferedIOBase, size: int, subject: str) -> _Header | None:
    """Read the header of an array of `size` bytes in NumPy's `.npy` format; return None for another format."""
    damaged = UserError(f"{subject} is damaged; copy or download the file again")
    magic = stream.read(8)
    if magic[:6] != b"\x93NUMPY":
        return None
    if len(magic) < 8 or magic[6] not in (1, 2, 3):
        raise damaged
    width = 2 if magic[6] == 1 else 4
    length = int.from_bytes(stream.read(width), "little")
    if length > min(_MAX_HEADER_BYTES, size):
        raise damaged
    header = stream.read(length).decode("latin1")
    found = [match for pattern in _HEADER if (match := re.search(pattern, header))]
    if len(found) < len(_HEADER):
        if "'descr': [" in header:
            raise UserError(f"{subject} holds records; save plain arrays")
        raise damaged
    descr, order, shape = (match[1] for match in found)
    try:
        dtype = np.dtype(descr)
    except Exception:  # NumPy raises several kinds for a word that is not a type
        raise damaged from None
    numbers = [number.rstrip("L") for number in shape.replace(" ", "").split(",") if number]
    if not dtype.hasobject and any(len(number) > 18 for number in numbers):  # over 2^59
        raise damaged
    lengths = () if dtype.hasobject else tuple(int(number) for number in numbers)
    return _Header(dtype, "F" if order == "True" else "C", lengths, 8 + width + length)


def _boxed(value: Any) -> np.ndarray:
    """Return any value as an array of objects without axes."""
    box = np.empty((), object)
    box[()] = value
    return box
