"""Read files of `torch.save` as plain data, without executing anything in them and without PyTorch's native readers.

Two formats: a zip archive (since PyTorch 1.6) with a pickle and one member per storage, and before that a row of pickles with
the storages behind them.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from snarfcli.errors import UserError, raise_system_error
from snarfcli.formats.pickle_opcodes import read_tree, read_tree_at
from snarfcli.formats.pickle_tensors import ESTIMATE_NAMES, PLAIN_NAMES, EstimateReading, PlainReading, value_size
from snarfcli.formats.pickle_tree import Call, PickleError, shown, text_of
from snarfcli.texts import one_line

__all__ = ["read_plain_torch", "read_torch", "storage_of"]

_MAX_FILE_BYTES = 1 << 28
# The magic number and the version of the old format, two pickles.
_OLD = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
# Tensors may be views of one storage, so that the result is larger than the file.
_BYTES_PER_FILE_BYTE = 2
_BYTES_ALWAYS = 4 << 20


def read_torch(path: str | Path, what: str = "file") -> Any:
    """Read the plain data of a file of `torch.save`, in the zip format or the one before.

    Args:
        path: the file, of at most 256 MiB.
        what: name of the kind of file, for messages.

    Returns:
        dict, list, tuple, set, str, bytes, numbers, None, and a NumPy array per tensor, which owns its memory; bfloat16 becomes
        float32. Objects of unknown classes become `Unknown`; a log line names the classes.

    Raises:
        UserError: the file is missing, of another format, damaged or too large.
        OSError, MemoryError: the system cannot read it.
    """
    path = _checked(path, what)
    with _told(path, what):
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UserError(f"{what} {path} is larger than {_MAX_FILE_BYTES >> 20} MiB; save the poses alone")
        with path.open("rb") as file:
            if file.read(len(_OLD)) == _OLD:
                return _old_content(path.read_bytes(), path)
            with _opened(file) as archive:
                return _Archive(archive, path.stat().st_size).content(path)


def read_plain_torch(path: str | Path, what: str = "file") -> Any:
    """Read a file of `torch.save` that holds nothing but plain data and dense tensors, in the zip format.

    The result is as large as the file: members are not compressed, and each tensor is made of bytes that the file holds.

    Args:
        path: the file.
        what: name of the kind of file, for messages.

    Returns:
        dict, list, tuple, str, bytes, numbers, None, and a NumPy array per tensor, of the tensor's type, which owns its memory.

    Raises:
        UserError: the file is missing, of another format or damaged, or names any other class or function.
        OSError, MemoryError: the system cannot read it.
    """
    path = _checked(path, what)
    with _told(path, what), path.open("rb") as file, _opened(file) as archive:
        return _Archive(archive, path.stat().st_size).plain_content()


def _checked(path: str | Path, what: str) -> Path:
    """Return the path of a regular file; a pipe would block."""
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{what} {path} is a folder; name a file of PyTorch (.pt)")
    if not path.exists():
        raise UserError(f"no {what} at {path}")
    if not path.is_file():
        raise UserError(f"{what} {path} is not a regular file; name a file of PyTorch (.pt)")
    return path


@contextmanager
def _told(path: Path, what: str) -> Iterator[None]:
    """Turn the errors of reading a damaged file into UserErrors that name it."""
    try:
        yield
    except UserError:
        raise
    except PickleError as error:
        raise UserError(f"{what} {path} {error}") from None
    except Exception as error:  # zipfile raises many kinds
        raise_system_error(error, path)
        raise UserError(f"{what} {path} is damaged ({one_line(error, 200)}); copy or download it again") from None


def _opened(file: IO[bytes]) -> zipfile.ZipFile:
    if not zipfile.is_zipfile(file):
        raise PickleError("is not a file of PyTorch, or is cut off; copy or download it again")
    return zipfile.ZipFile(file)


def storage_of(data: bytes, budget: int) -> Any:
    """Return the content of a file in the old format; a tensor in a plain pickle has its storage as such a file.

    Args:
        data: bytes of the file.
        budget: maximum number of bytes to create.

    Raises:
        PickleError: it cannot be read; the message is the end of a sentence.
    """
    if not data.startswith(_OLD):
        raise PickleError("has a tensor of an unknown form; it is damaged or made by another program")
    return _old_content(data, None, budget)


def _old_content(data: bytes, path: Path | None, budget: int | None = None) -> Any:
    """Return the content of the old format: system, object and keys as pickles; then per key the number of values, and them."""
    _, at = read_tree_at(data, ESTIMATE_NAMES, len(_OLD))
    tree, at = read_tree_at(data, ESTIMATE_NAMES, at)
    keys, at = read_tree_at(data, ESTIMATE_NAMES, at)
    keys = [text_of(key) for key in keys] if isinstance(keys, list) else [None]
    sizes = _value_sizes(tree)
    storages: dict[str, memoryview] = {}
    for key in keys:
        if not isinstance(key, str) or key not in sizes or at + 8 > len(data):
            raise PickleError("has storages that do not fit its tensors; it is damaged or cut off")
        (count,) = struct.unpack_from("<q", data, at)
        begin, at = at + 8, at + 8 + count * sizes[key]
        if count < 0 or at > len(data):
            raise PickleError("has storages that do not fit its tensors; it is damaged or cut off")
        storages[key] = memoryview(data)[begin:at]
    reading = EstimateReading(_budget(len(data)) if budget is None else budget, lambda key: _found(storages, key))
    content = reading.value(tree, 0)
    if path is not None:
        reading.report(path)
    return content


def _value_sizes(tree: Any) -> dict[str, int]:
    """Return the bytes per value of each storage that the tree refers to, by key."""
    sizes: dict[str, int] = {}
    seen: set[int] = set()
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, dict):
            nodes.extend(node.values())
        elif isinstance(node, (list, tuple)):
            nodes.extend(node)
        elif isinstance(node, Call) and node.name.kind != "stored":
            nodes.extend((*node.args, node.state, node.items))
        elif isinstance(node, Call) and len(node.args) == 1 and isinstance(node.args[0], tuple) and len(node.args[0]) > 2:
            what, kind, key = node.args[0][:3]
            if text_of(what) == "storage":
                sizes[str(text_of(key))] = value_size(kind)
    return sizes


class _Archive:
    """The zip format: <name>/data.pkl, one <name>/data/<key> per storage, and <name>/byteorder."""

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self.archive = archive
        self.members = {member.filename: member for member in archive.infolist()}
        self.size = self.left = size
        self.folder = ""
        self.storages: dict[str, memoryview] = {}

    def content(self, path: Path) -> Any:
        """Return the content of any file, with `Unknown` for objects of unknown classes, which are logged."""
        order = self.find()
        tree = read_tree(self.member("data.pkl"), ESTIMATE_NAMES)
        reading = EstimateReading(_budget(self.size), self.storage, order=order)
        content = reading.value(tree, 0)
        reading.report(path)
        return content

    def plain_content(self) -> Any:
        """Return the content of a file of plain data and tensors."""
        order = self.find()
        tree = read_tree(self.member("data.pkl"), PLAIN_NAMES)
        return PlainReading(_budget(self.size), self.storage, order=order).value(tree, 0)

    def find(self) -> str:
        """Find the folder of the content inside the archive, and return the byte order of the storages, `<` or `>`."""
        name = next((name for name in self.members if name.endswith("/data.pkl")), None)
        if name is None:
            raise PickleError("has no data.pkl, as files of torch.save have; give another file")
        self.folder = name.removesuffix("data.pkl")
        order = self.member("byteorder") if f"{self.folder}byteorder" in self.members else b"little"
        return ">" if order.strip() == b"big" else "<"

    def storage(self, key: str) -> memoryview:
        if key not in self.storages:
            self.storages[key] = memoryview(self.member(f"data/{key}"))
        return self.storages[key]

    def member(self, name: str) -> bytes:
        """Return the bytes of a part; parts may not overlap, so all together are not larger than the file."""
        member = self.members.get(self.folder + name)
        if member is None:
            raise PickleError(f"lacks its part {shown(name)}; it is damaged or cut off")
        self.left -= member.file_size
        if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1 or self.left < 0:
            raise PickleError(f"has a part {shown(name)} that PyTorch does not write; save it again with torch.save")
        return self.archive.read(member)


def _found(storages: dict[str, memoryview], key: str) -> memoryview:
    if key not in storages:
        raise PickleError("has storages that do not fit its tensors; it is damaged or cut off")
    return storages[key]


def _budget(size: int) -> int:
    return _BYTES_ALWAYS + _BYTES_PER_FILE_BYTE * size
