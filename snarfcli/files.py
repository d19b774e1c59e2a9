"""Reading untrusted files safely, and writing files that appear whole or not at all."""

from __future__ import annotations

import io
import json
import os
import secrets
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError

__all__ = ["atomic_path", "read_json", "read_npz", "write_json", "write_tensors"]

# An archive of zeros can unpack to a thousand times its size. Poses and meshes shrink by less than ten.
_MAX_UNPACKED = 2**29
_MAX_UNPACKED_RATIO = 20


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block succeeds and vanishes when it fails.

    Parent folders are made. The temporary name keeps the suffix, since many writers choose the format by it.

    Raises:
        OSError: the file cannot be written; it names `path`, which the system does not do for a full disk.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, content: Any) -> None:
    """Write `content` as indented JSON, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_tensors(path: str | Path, content: Any) -> None:
    """Write `content` by `torch.save`, whole or not at all.

    Raises:
        OSError: the file cannot be written. (`torch.save` by itself reports a full disk as a RuntimeError without a reason.)
    """
    import torch

    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_json(path: str | Path, what: str = "file") -> Any:
    """Read a JSON file.

    Raises:
        UserError: the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text())
    except FileNotFoundError:
        raise UserError(f"no {what} at {path}") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserError(f"{what} {path} is not valid JSON ({error}); make it again") from None


def read_npz(path: str | Path, what: str = "file") -> dict[str, np.ndarray]:
    """Read every array of an `.npz` file without ever unpickling anything.

    Raises:
        UserError: the file is missing, cannot be opened, is not a zip archive, is truncated, holds pickled objects, or unpacks
            to an absurd size.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name an .npz file")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    try:
        with path.open("rb") as file:
            is_archive = zipfile.is_zipfile(file)
    except OSError as error:
        raise UserError(f"{what} {path} cannot be opened ({error.strerror or error})") from None
    if not is_archive:
        raise UserError(f"{what} {path} is not an .npz archive, or is truncated; copy or download it again")
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > max(_MAX_UNPACKED, _MAX_UNPACKED_RATIO * path.stat().st_size):
            raise UserError(f"{what} {path} unpacks to {unpacked / 2**30:.1f} GiB, far more than it should; get another copy")
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):  # the bytes of an .npy file in front of an archive
            raise UserError(f"{what} {path} is not an .npz archive; copy or download it again")
        with content as archive:
            arrays = {key: archive[key] for key in archive.files}
            return {key: array for key, array in arrays.items() if isinstance(array, np.ndarray)}  # others come as bytes
    except UserError:
        raise
    except Exception as error:  # numpy and zipfile let many kinds through; tests/fuzz_targets.py found over ten
        reason = str(error) or type(error).__name__
        if "allow_pickle" in reason:
            raise UserError(f"{what} {path} holds pickled objects, which are never executed; save plain arrays") from None
        raise UserError(f"{what} {path} is damaged ({_one_line(reason)}); copy or download it again") from None


def _one_line(reason: str) -> str:
    """Return the start of another library's message, without line ends, controls and whatever else cannot be printed."""
    return "".join(letter if letter.isprintable() else " " for letter in reason)[:200]
