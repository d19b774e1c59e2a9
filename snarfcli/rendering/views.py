"""The sides that a body is looked at from, by name or in degrees."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from snarfcli.errors import UserError, nearest

__all__ = ["VIEWS", "View", "parse_turntable", "parse_views"]

VIEWS = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0, "top": 0.0}
"""Degrees of the named views from straight ahead of the body towards its left; top looks down, its front below."""

_TOP_RAD = math.radians(89.5)  # not 90: then nothing would say which way the picture is turned
_MOST_VIEWS = 8
_TURN_DEG = 45.0  # a second: a turn takes eight seconds, slow enough to follow
_FASTEST_DEG = 720.0


@dataclass(frozen=True)
class View:
    """A side to look from."""

    label: str
    """What is written below its picture."""
    azimuth_rad: float
    """Where the camera stands, seen from the body: 0 is straight ahead of it, a quarter turn its left."""
    elevation_rad: float
    """How far the camera looks down."""

    @property
    def is_from_above(self) -> bool:
        """Whether the camera looks mostly down."""
        return abs(self.elevation_rad) > math.pi / 3


def parse_views(names: Sequence[str], azimuth_deg: float = 0.0, elevation_deg: float = 0.0) -> tuple[View, ...]:
    """Return the views of their names.

    Args:
        names: of `VIEWS`, or degrees such as 45 and -30.
        azimuth_deg: added to all, except top.
        elevation_deg: how far the camera looks down in all, except top.

    Raises:
        UserError: there are none, too many, or one is unknown or there twice.
    """
    if not 1 <= len(names) <= _MOST_VIEWS:
        raise UserError(f"views must be 1 to {_MOST_VIEWS} of {', '.join(VIEWS)} or degrees, got {len(names)}")
    views = []
    for name in names:
        name = str(name).strip()
        if name in VIEWS:
            label, degrees = name, VIEWS[name]
        elif re.fullmatch(r"[+-]?\d+(\.\d*)?", name) and abs(float(name)) <= 360:
            label, degrees = f"{float(name):g}°", float(name)
        else:
            hint = nearest(name, VIEWS)
            raise UserError(f"views must be {', '.join(VIEWS)} or degrees from -360 to 360, got '{name}'{hint}")
        if label in [view.label for view in views]:
            raise UserError(f"views has '{name}' twice; name each view once")
        is_top = name == "top"
        azimuth_rad = math.radians(degrees if is_top else degrees + azimuth_deg)
        views.append(View(label, azimuth_rad, _TOP_RAD if is_top else math.radians(elevation_deg)))
    return tuple(views)


def parse_turntable(text: str) -> float:
    """Return the radians a second that the camera goes round: of false, true, or degrees a second.

    Raises:
        UserError: it is none of them, or too fast to look at.
    """
    word = str(text).strip().lower()
    if word in ("true", "false"):
        return math.radians(_TURN_DEG) if word == "true" else 0.0
    try:
        degrees = float(word)
    except ValueError:
        degrees = math.nan
    if not abs(degrees) <= _FASTEST_DEG:
        raise UserError(f"turntable must be true, false or degrees a second up to {_FASTEST_DEG:g}, got '{text}'")
    return math.radians(degrees)
