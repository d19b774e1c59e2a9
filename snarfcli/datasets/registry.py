"""All data sets by name."""

from __future__ import annotations

from typing import Protocol

from snarfcli.datasets import amass, builtin, cape, clothed, dfaust, meshes, poseprior, stick2d
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError, nearest

__all__ = ["DataSet", "find_dataset"]


class DataSet(Protocol):
    """Interface that each module for one data set implements."""

    def subjects(self, request: Request) -> tuple[str, ...]:
        """Return the ids of the available subjects.

        Raises:
            UserError: the folder of the data set is missing, or has no subject.
        """
        ...

    def load(self, subject: str, request: Request) -> SubjectData:
        """Return the data of one subject.

        Raises:
            UserError: the subject is missing or cannot be used.
        """
        ...


_DATASETS: dict[str, DataSet] = {
    "amass": amass,
    "builtin": builtin,
    "cape": cape,
    "clothed": clothed,
    "dfaust": dfaust,
    "meshes": meshes,
    "poseprior": poseprior,
    "stick2d": stick2d,
}


def find_dataset(name: str) -> DataSet:
    """Return the module that reads the data set with this name.

    Raises:
        UserError: there is no such data set.
    """
    if name not in _DATASETS:
        raise UserError(f"no data set '{name}'{nearest(name, _DATASETS)}; wanted one of {', '.join(_DATASETS)}")
    return _DATASETS[name]
