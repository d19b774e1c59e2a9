"""Avatars as folders that are passed on: `model.safetensors`, `config.json` and a model card, from a disk or from a hub.

Nothing in such a folder is executed. The configuration has the checksum of the tensors, so that files of two avatars are not
mixed.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.files import atomic_path, file_digest, read_json
from snarfcli.formats.safetensors import read_safetensors, safetensors_bytes
from snarfcli.models.checkpoint import check_format

__all__ = ["CARD_FILE", "CONFIG_FILE", "TENSORS_FILE", "is_pretrained", "read_pretrained", "write_pretrained"]

TENSORS_FILE = "model.safetensors"
CONFIG_FILE = "config.json"
CARD_FILE = "README.md"

_GROUPS = ("skeleton", "grid", "template", "state")
"""Parts of the description of an avatar that have tensors; the first word of the name of a tensor in the file."""
_PLAIN = ("format", "version", "config", "skeleton", "facts")
"""Parts of the description in `config.json`."""
_WEIGHTS = "weights"


def write_pretrained(folder: str | Path, content: Mapping[str, Any], card: str, *, overwrite: bool = False) -> None:
    """Write the folder of an avatar; each file is whole or absent.

    Args:
        folder: created if it does not exist; other files in it stay.
        content: from `TrainedField.to_dict`.
        card: the model card, Markdown.
        overwrite: whether files of these names are replaced.

    Raises:
        UserError: the folder is a file, or has such files.
        OSError: a file cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: wanted a folder, got a file; give another name")
    there = [name for name in (CONFIG_FILE, TENSORS_FILE, CARD_FILE) if (folder / name).exists()]
    if there and not overwrite:
        raise UserError(f"{folder / there[0]} exists already; give overwrite=True to replace it, or another folder")
    tensors = safetensors_bytes(_flat_tensors(content), {"format": "pt"})
    plain = {name: _plain(content[name]) for name in _PLAIN}
    plain[_WEIGHTS] = {"file": TENSORS_FILE, "sha256": hashlib.sha256(tensors).hexdigest()}
    parts = {
        CONFIG_FILE: (json.dumps(plain, indent=2, allow_nan=False) + "\n").encode(),
        TENSORS_FILE: tensors,
        CARD_FILE: card.encode(),
    }
    with ExitStack() as stack:  # all are written before the first gets its name, and the configuration gets it last
        for name, data in parts.items():
            stack.enter_context(atomic_path(folder / name)).write_bytes(data)


def is_pretrained(folder: Path) -> bool:
    """Return whether a folder has an avatar that `write_pretrained` has written."""
    return (folder / TENSORS_FILE).is_file() and (folder / CONFIG_FILE).is_file()


def read_pretrained(folder: str | Path, file_format: str, version: int) -> dict[str, Any]:
    """Read the folder of an avatar; the content is unchecked, as `TrainedField.from_dict` takes it.

    Args:
        folder: the folder.
        file_format, version: that its configuration must have.

    Raises:
        UserError: a file is missing, damaged or of another avatar.
        OSError, MemoryError: the system cannot read it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"no folder with an avatar at {folder}; give the one that save_pretrained has written")
    path = folder / CONFIG_FILE
    content = check_format(read_json(path, "configuration of the avatar"), file_format, version, "avatar", path)
    weights, skeleton = content.get(_WEIGHTS), content.get("skeleton")
    if not isinstance(weights, dict) or not isinstance(skeleton, dict):
        raise UserError(f"{path} does not describe the tensors and the skeleton of an avatar; get it again")
    arrays, _ = read_safetensors(folder / TENSORS_FILE, "avatar")
    if weights.get("sha256") != file_digest(folder / TENSORS_FILE):
        raise UserError(
            f"{folder / TENSORS_FILE} is not the file that {CONFIG_FILE} names (its checksum differs); get both again"
        )
    groups: dict[str, dict[str, Tensor]] = {name: {} for name in _GROUPS}
    for name, array in arrays.items():
        group, _, rest = name.partition(".")
        if group not in groups:
            raise UserError(f"{folder / TENSORS_FILE} has tensors that are not those of an avatar; give another folder")
        groups[group][rest] = torch.from_numpy(array)
    return {
        **content,
        **groups,
        "skeleton": {**content["skeleton"], **groups["skeleton"]},
        "template": groups["template"] or None,
    }


def _flat_tensors(content: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the tensors of a description by the names that they have in the file."""
    groups = {group: content[group] or {} for group in _GROUPS}
    return {
        f"{group}.{name}": value.detach().cpu().numpy()
        for group, entries in groups.items()
        for name, value in entries.items()
        if isinstance(value, Tensor)
    }


def _plain(value: Any) -> Any:
    """Return a description without tensors for JSON, which has no number that is not finite: None stands for it."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items() if not isinstance(one, Tensor)}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
