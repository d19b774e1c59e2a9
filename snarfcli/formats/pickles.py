"""Read pickles as plain data (SMPL's body files, AIST++'s motions, CAPE's lists) without executing them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.formats.pickle_opcodes import read_tree
from snarfcli.formats.pickle_tree import PickleError
from snarfcli.formats.pickle_values import KNOWN_NAMES, plain_data

__all__ = ["read_pickle"]

# SMPL-X, the largest common file, takes about half a GiB.
_MAX_FILE_BYTES = 2 << 30
# Memory beyond the file: text as bytes as an array, then a selection of it, each as large as the file.
_BYTES_PER_FILE_BYTE = 4
_BYTES_ALWAYS = 64 << 20


def read_pickle(path: str | Path, what: str = "file") -> Any:
    """Read the plain data of a pickle, protocols 0 to 5, written by Python 2 or 3.

    Args:
        path: the file.
        what: name of the kind of file, for messages.

    Returns:
        dict, list, tuple, set, str, bytes, numbers, None, and NumPy arrays that own their memory. Strings of Python 2 are
        decoded as latin1. A chumpy object becomes the array of its value, a sparse matrix that of SciPy in the same format, and
        an array of objects the flat list of them.

    Raises:
        UserError: the file is missing, is not a pickle, is damaged, or contains a class that plain data does not need; the
            message names the class.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name a pickle file (.pkl)")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not path.is_file():
        raise UserError(f"{what} {path} is not a regular file; name a pickle file (.pkl)")
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UserError(f"{what} {path} is larger than {_MAX_FILE_BYTES >> 30} GiB; models and motions are smaller")
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{what} {path} cannot be opened ({error.strerror or error})") from None
    try:
        return plain_data(read_tree(data, KNOWN_NAMES), _BYTES_ALWAYS + _BYTES_PER_FILE_BYTE * len(data))
    except PickleError as error:
        raise UserError(f"{what} {path} {error}") from None
    except MemoryError:
        raise UserError(f"{what} {path} needs more memory than is available; close other programs") from None
