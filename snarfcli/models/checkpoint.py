"""Read files of `torch.save` without executing anything in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from snarfcli.errors import UserError
from snarfcli.formats.torch_files import read_plain_torch

__all__ = ["check_format", "load_checkpoint"]


def load_checkpoint(path: str | Path, file_format: str, version: int, what: str) -> dict[str, Any]:
    """Read a dict written by `torch.save`, without executing anything in the file.

    `torch.load` is not used: it unpacks compressed members of any size, and parses damaged archives in native code.

    Returns:
        Plain data, and tensors on the CPU that own their memory.

    Raises:
        UserError: the file is missing, damaged, of another kind or another version.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f'no {what} at {path}; train one with "snarf train" or name another file')
    return _with_tensors(check_format(read_plain_torch(path, what), file_format, version, what, path), {})


def check_format(content: Any, file_format: str, version: int, what: str, path: Path) -> dict[str, Any]:
    """Return the content of a file if it says that it is of a format and version.

    Raises:
        UserError: it is not; the message names the file `path`.
    """
    if not isinstance(content, dict) or type(content.get("format")) is not str or content["format"] != file_format:
        raise UserError(f'{path} is not a snarf {what}; give the file that "snarf train" wrote')
    came = content.get("version")
    if type(came) is not int or came != version:
        shown = came if type(came) is int else "none"
        raise UserError(f"{what} {path}: wanted format version {version}, got {shown}; train it again, or get it again")
    return content


def _with_tensors(content: Any, done: dict[int, Any]) -> Any:
    """Return nested containers with a tensor in place of each array; `done` has the results by the identity of the content."""
    if not isinstance(content, (np.ndarray, dict, list, tuple)):
        return content
    if id(content) not in done:
        if isinstance(content, np.ndarray):
            done[id(content)] = torch.from_numpy(content)
        elif isinstance(content, dict):
            done[id(content)] = {name: _with_tensors(value, done) for name, value in content.items()}
        else:
            done[id(content)] = type(content)(_with_tensors(value, done) for value in content)
    return done[id(content)]
