"""Read files of `torch.save` without executing anything in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from snarfcli.errors import UserError

__all__ = ["load_checkpoint"]


def load_checkpoint(path: str | Path, file_format: str, version: int, what: str) -> dict[str, Any]:
    """Read a dict written by `torch.save`, without executing anything in the file.

    Raises:
        UserError: the file is missing, damaged, of another kind or another version.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f'no {what} at {path}; train one with "snarf train" or name another file')
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception:  # damaged bytes raise many kinds: IndexError, UnicodeDecodeError, ...
        raise UserError(f"{what} {path} is truncated or is not a file of snarf; train it again or copy it again") from None
    if not isinstance(content, dict) or content.get("format") != file_format:
        raise UserError(f'{path} is not a snarf {what}; give the file that "snarf train" wrote')
    if content.get("version") != version:
        came = content.get("version")
        raise UserError(f"{what} {path}: wanted format version {version}, got {came}; train it again")
    return content
