"""Reading untrusted files safely, and writing files that appear whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError

__all__ = ["atomic_path", "read_json", "read_npz", "write_json"]


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block succeeds and vanishes when it fails.

    Parent folders are made. The temporary name keeps the suffix, since many writers choose the format by it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, content: Any) -> None:
    """Write `content` as indented JSON, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


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
        UserError: the file is missing, is not a zip archive, is truncated, or holds pickled objects.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name an .npz file")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not zipfile.is_zipfile(path):
        raise UserError(f"{what} {path} is not an .npz archive, or is truncated; copy or download it again")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise UserError(f"{what} {path} holds pickled objects, which are never executed; save plain arrays") from None
        raise UserError(f"{what} {path} cannot be read ({error}); copy or download it again") from None
    except (zipfile.BadZipFile, EOFError, OSError, KeyError, zlib.error) as error:
        raise UserError(f"{what} {path} is damaged ({error}); copy or download it again") from None
