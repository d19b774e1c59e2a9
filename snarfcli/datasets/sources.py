"""Every data set by its name: which subjects it has, and how one is loaded."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError, nearest

__all__ = ["Request", "Source", "find_source"]

_MODULES = {
    "builtin": "builtin",
    "cape": "cape",
    "clothed": "clothed",
    "dfaust": "dfaust",
    "meshes": "meshes",
    "poseprior": "poseprior",
    "stick2d": "stick2d",
}


@dataclass(frozen=True)
class Request:
    """What a data set is asked for."""

    config: DataConfig
    """The choices."""
    data_root: Path
    """The data folder."""
    body: str | None = None
    """File or folder of the body model; None: looked for below `data_root`, or the data set's own."""

    @property
    def folder(self) -> Path:
        """Where the files of the data set are looked for."""
        return Path(self.config.folder).expanduser() if self.config.folder is not None else self.data_root


class Source(Protocol):
    """A module of this room that reads one data set."""

    def subjects(self, request: Request) -> tuple[str, ...]:
        """Return the ids of the subjects that are there."""
        ...

    def load(self, subject: str, request: Request) -> SubjectData:
        """Return one subject.

        Raises:
            UserError: it is not there, or what there is cannot be used.
        """
        ...


def find_source(name: str) -> Source:
    """Return the module that reads the data set of a name.

    Raises:
        UserError: there is no such data set.
    """
    if name not in _MODULES:
        raise UserError(f"no data set '{name}'{nearest(name, _MODULES)}; there is {', '.join(_MODULES)}")
    return importlib.import_module(f"snarfcli.datasets.{_MODULES[name]}")  # type: ignore[return-value]
