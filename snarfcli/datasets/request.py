"""A request to a data set: settings and folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from snarfcli.datasets.settings import DataConfig

__all__ = ["DataRequest"]


@dataclass(frozen=True)
class DataRequest:
    """What to load, and from where."""

    config: DataConfig
    """Settings of the data set."""
    data_root: Path
    """The data folder."""
    body: str | None = None
    """File or folder of the body model; None: below `data_root`, or the body of the data set."""

    @property
    def folder(self) -> Path:
        """Folder with the files of the data set."""
        return Path(self.config.folder).expanduser() if self.config.folder is not None else self.data_root
