"""Views of a body, by name or in degrees."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from snarfcli.errors import UserError, nearest

__all__ = ["VIEWS", "View", "parse_turntable", "parse_views"]

VIEWS = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0, "top": 0.0}
"""Degrees of the named views, from the front of the body towards its left; top looks down, with the front below."""

_TOP_RAD = math.radians(89.5)  # not 90, which would leave the rotation of the picture undefined
_MOST_VIEWS = 8
_TURN_DEG = 45.0  # per second: a turn takes eight seconds, slow enough to follow
_FASTEST_DEG = 720.0


@dataclass(frozen=True)
class View:
    """A side to look from."""

    label: str
    """Label below its picture."""
    azimuth_rad: float
    """Direction of the camera seen from the body: 0 is its front, a quarter turn its left."""
    elevation_rad: float
    """Angle by which the camera looks down."""

    @property
    def is_from_above(self) -> bool:
        """Whether the camera looks mostly down."""
        return abs(self.elevation_rad) > math.pi / 3


def parse_views(names: Sequence[str], azimuth_deg: float = 0.0, elevation_deg: float = 0.0) -> tuple[View, ...]:
    """Return views by their names.

    Args:
        names: names in `VIEWS`, or degrees such as 45 and -30.
        azimuth_deg: angle that is added to all views except top.
        elevation_deg: angle by which the camera looks down in all views except top.

    Raises:
        UserError: there are none or too many, or one is unknown or repeated.
    """
    if not 1 <= len(names) <= _MOST_VIEWS:
        raise UserError(f"views: wanted 1 to {_MOST_VIEWS} of {', '.join(VIEWS)} or degrees, got {len(names)}")
    views = []
    for name in names:
        name = str(name).strip()
        if name in VIEWS:
            label, degrees = name, VIEWS[name]
        elif re.fullmatch(r"[+-]?\d+(\.\d*)?", name) and abs(float(name)) <= 360:
            label, degrees = f"{float(name):g}°", float(name)
        else:
            hint = nearest(name, VIEWS)
            raise UserError(f"views: wanted {', '.join(VIEWS)} or degrees from -360 to 360, got '{name}'{hint}")
        if label in [view.label for view in views]:
            raise UserError(f"views: wanted each view once, got '{name}' twice; remove one")
        is_top = name == "top"
        azimuth_rad = math.radians(degrees if is_top else degrees + azimuth_deg)
        views.append(View(label, azimuth_rad, _TOP_RAD if is_top else math.radians(elevation_deg)))
    return tuple(views)


def parse_turntable(text: str) -> float:
    """Return the speed of a turntable in radians per second, from true, false or a number of degrees per second.

    Raises:
        UserError: it is none of them, or too fast.
    """
    word = str(text).strip().lower()
    if word in ("true", "false"):
        return math.radians(_TURN_DEG) if word == "true" else 0.0
    try:
        degrees = float(word)
    except ValueError:
        degrees = math.nan
    if not abs(degrees) <= _FASTEST_DEG:
        raise UserError(f"turntable: wanted true, false or degrees per second up to {_FASTEST_DEG:g}, got '{text}'")
    return math.radians(degrees)
