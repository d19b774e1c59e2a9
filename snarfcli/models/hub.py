"""Get the folder of an avatar: a path, or the name of a repository on a model hub, which is asked only for such a name."""

from __future__ import annotations

import re
from pathlib import Path

from snarfcli.errors import UserError
from snarfcli.extras import require_packages
from snarfcli.models.pretrained import CARD_FILE, CONFIG_FILE, TENSORS_FILE
from snarfcli.texts import one_line

__all__ = ["pretrained_folder"]

_PREFIX = "hf://"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


def pretrained_folder(name: str | Path, revision: str | None = None) -> Path:
    """Return the folder of an avatar.

    Args:
        name: a folder, or a repository `owner/name` or `hf://owner/name` of the Hugging Face Hub. What exists is a folder, and
            so is what has a parent that exists: a slip in a path does not reach the network.
        revision: branch, tag or commit of the repository.

    Raises:
        MissingPackage: a repository is wanted, and the package huggingface-hub is not installed.
        UserError: there is no such folder, or the repository cannot be downloaded.
    """
    text = str(name)
    is_named = text.startswith(_PREFIX) and isinstance(name, str)
    repository = text.removeprefix(_PREFIX) if is_named else text
    path = Path(name)
    is_path = isinstance(name, Path) or path.exists() or path.parent.is_dir() or not _REPOSITORY.fullmatch(text)
    if is_path and not is_named:
        if revision is not None:
            raise UserError(f"revision: wanted with a repository of a hub only, got it with {one_line(text, 200)}")
        return path
    if not _REPOSITORY.fullmatch(repository):
        raise UserError(f"{one_line(text, 200)}: wanted hf://owner/name; give a folder or a repository")
    require_packages("hub")
    return _downloaded(repository, revision)


def _downloaded(repository: str, revision: str | None) -> Path:
    """Return the folder with the files of an avatar from the hub, or from the hub client's cache."""
    from huggingface_hub import snapshot_download  # pyright: ignore[reportMissingImports]

    try:
        return Path(snapshot_download(repository, revision=revision, allow_patterns=[CONFIG_FILE, TENSORS_FILE, CARD_FILE]))
    except Exception as error:  # of the network, the hub and its cache: many kinds
        reason = one_line(str(error).partition("\n")[0] or error, 200)
        raise UserError(f"{repository} could not be downloaded ({reason}); check the name and the network") from None
