"""Licences of the data sets, for what is passed on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["DataLicense", "license_of"]


@dataclass(frozen=True)
class DataLicense:
    """Licence of the data of an avatar."""

    identifier: str
    """Name in the lists of model hubs: an SPDX identifier in lower case, or "other"."""
    text: str
    """What holds, in one sentence."""


_CC0 = DataLicense("cc0-1.0", "CC0 1.0: made from the built-in body and motions, which are in the public domain.")
_SMPL = "made from SMPL and AMASS, whose licences allow research only: https://smpl.is.tue.mpg.de, https://amass.is.tue.mpg.de."
_LICENSES = {
    "builtin": _CC0,
    "clothed": _CC0,
    "stick2d": _CC0,
    "dfaust": DataLicense("other", f"Not for redistribution: {_SMPL}"),
    "poseprior": DataLicense("other", f"Not for redistribution: {_SMPL}"),
    "cape": DataLicense("other", "Not for redistribution: made from CAPE, for research only: https://cape.is.tue.mpg.de."),
}
_UNKNOWN = DataLicense("other", "None is stated; that of the data from which it was made applies.")


def license_of(facts: dict[str, Any]) -> DataLicense:
    """Return the licence of the data that an avatar was trained on, from the facts that are saved with it."""
    return _LICENSES.get(str(facts.get("data")), _UNKNOWN)
