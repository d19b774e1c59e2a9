"""Read pickles as plain data (SMPL's body files, AIST++'s motions, CAPE's lists) without executing them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.formats.pickle_opcodes import read_tree
from snarfcli.formats.pickle_tensors import ESTIMATE_NAMES, EstimateReading
from snarfcli.formats.pickle_tree import PickleError
from snarfcli.formats.pickle_values import KNOWN_NAMES, plain_data
from snarfcli.formats.torch_files import storage_of

__all__ = ["estimate_of", "read_estimate", "read_pickle"]

# SMPL-X, the largest common file, takes about half a GiB.
_MAX_FILE_BYTES = 2 << 30
# Memory beyond the file: text as bytes as an array, then a selection of it, each as large as the file.
_BYTES_PER_FILE_BYTE = 4
_BYTES_ALWAYS = 64 << 20
# Results of video estimators: WHAM's are the largest, since they have the mesh of every frame, 83 kB each.
_MAX_ESTIMATE_BYTES = 1 << 28
_MAX_UNPACKED_BYTES = 3 << 26
_ESTIMATE_BYTES_ALWAYS = 4 << 20  # small, since one archive may have many such pickles
_COMPRESSED = (b"\x1f\x8b", b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda")  # gzip, and zlib at each level


def read_pickle(path: str | Path, what: str = "file") -> Any:
    """Read the plain data of a pickle, protocols 0 to 5, written by Python 2 or 3.

    Args:
        path: the file.
        what: name of the kind of file, for messages.

    Returns:
        dict, list, tuple, set, str, bytes, numbers, None, and NumPy arrays that own their memory. Strings of Python 2 are
        decoded as latin1. A chumpy object becomes the array of its value, a sparse matrix of SciPy a `SparseMatrix`, and an
        array of objects the flat list of them.

    Raises:
        UserError: the file is missing, is not a pickle, is damaged, or contains a class that plain data does not need; the
            message names the class.
    """

    def read(data: bytes) -> Any:
        return plain_data(read_tree(data, KNOWN_NAMES), _BYTES_ALWAYS + _BYTES_PER_FILE_BYTE * len(data))

    return _content(path, what, _MAX_FILE_BYTES, read)


def read_estimate(path: str | Path, what: str = "file") -> Any:
    """Read a pickle of a video estimator as plain data: also tensors, and what joblib writes, compressed with zlib or not.

    Args:
        path: the file, of at most 256 MiB, and 192 MiB when unpacked.
        what: name of the kind of file, for messages.

    Returns:
        As for `read_pickle`; tensors become arrays, and objects of unknown classes `Unknown`, which a log line names.

    Raises:
        UserError: the file is missing, too large, not a pickle, or damaged.
    """
    return _content(path, what, _MAX_ESTIMATE_BYTES, lambda data: estimate_of(_unpacked(data), Path(path)))


def estimate_of(data: bytes, path: Path) -> Any:
    """Return the plain data of a pickle of a video estimator, from its bytes.

    Args:
        data: bytes of the pickle.
        path: the file, for the log.

    Raises:
        PickleError: it cannot be read; the message is the end of a sentence.
    """
    reading = EstimateReading(_ESTIMATE_BYTES_ALWAYS + 2 * len(data), from_bytes=storage_of)
    content = reading.value(read_tree(data, ESTIMATE_NAMES), 0)
    reading.report(path)
    return content


def _unpacked(data: bytes) -> bytes:
    """Return the bytes that joblib compressed; others unchanged."""
    if not data.startswith(_COMPRESSED):
        return data
    unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)
    try:
        content = unpacker.decompress(data, _MAX_UNPACKED_BYTES)
    except zlib.error:
        raise PickleError("is compressed, and damaged or cut off; copy or download it again") from None
    if not unpacker.eof:
        raise PickleError(f"unpacks to over {_MAX_UNPACKED_BYTES >> 20} MiB, or is cut off; save the poses alone")
    return content


def _content(path: str | Path, what: str, limit: int, read: Callable[[bytes], Any]) -> Any:
    """Return what `read` makes of the bytes of a file; its PickleErrors become UserErrors that name the file."""
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name a pickle file (.pkl)")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not path.is_file():
        raise UserError(f"{what} {path} is not a regular file; name a pickle file (.pkl)")
    try:
        if path.stat().st_size > limit:
            raise UserError(f"{what} {path} is larger than {limit >> 20} MiB; models and motions are smaller")
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{what} {path} cannot be opened ({error.strerror or error})") from None
    try:
        return read(data)
    except PickleError as error:
        raise UserError(f"{what} {path} {error}") from None
    except MemoryError:
        raise UserError(f"{what} {path} needs more memory than is available; close other programs") from None
