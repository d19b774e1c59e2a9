"""Paths below the home folder, written with ~, in the settings of a command."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.texts import one_line

__all__ = ["expand_home"]


def expand_home(settings: Any, name: str = "") -> Any:
    """Return settings in which ~, ~/... and ~user/... at the start of a text are replaced by the home folder.

    The shell does so only for words that begin with ~, so not in output_root=~/results.

    Args:
        settings: the dataclass of a command, which is changed; lists, texts and other values inside it.
        name: dotted name of the setting, for messages.

    Raises:
        UserError: the user is unknown, or has no home folder.
    """
    if dataclasses.is_dataclass(settings):
        for field in dataclasses.fields(settings):
            value = expand_home(getattr(settings, field.name), f"{name}.{field.name}" if name else field.name)
            object.__setattr__(settings, field.name, value)  # some of them are frozen
        return settings
    if isinstance(settings, list):
        return [expand_home(one, name) for one in settings]
    return _expanded(settings, name) if isinstance(settings, str) else settings


def _expanded(text: str, name: str) -> str:
    """Return a text with the home folder in place of ~ at its start."""
    is_separator = [separator in text for separator in (os.sep, os.altsep) if separator]
    if not text.startswith("~") or not (text == "~" or any(is_separator)):
        return text
    try:
        return str(Path(text).expanduser())
    except RuntimeError:
        user = one_line(Path(text).parts[0], 60)
        raise UserError(
            f"{name}: there is no home folder {user}; give the whole path, or ./{user} for a folder of that name"
        ) from None
