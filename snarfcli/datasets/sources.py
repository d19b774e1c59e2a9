"""The settings and folders with which a data set is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from snarfcli.datasets.settings import DataConfig

__all__ = ["Request"]


@dataclass(frozen=True)
class Request:
    """Which data to load, and from which folders."""

    config: DataConfig
    """Settings of the data set."""
    data_root: Path
    """Folder with the data of all data sets."""
    body: str | None = None
    """File or folder of the body model; None searches below `data_root`, or uses the body that the data set includes."""

    @property
    def folder(self) -> Path:
        """Folder in which to look for the files of the data set: the setting `data.folder`, or else `data_root`."""
        return Path(self.config.folder).expanduser() if self.config.folder is not None else self.data_root
