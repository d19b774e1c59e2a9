"""Piecewise: the rigid parts that SNARF compares with in its 2D experiment (SNARF Sec. 4.2-4.3)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from snarfcli.models.nasa import Nasa
from snarfcli.models.settings import AvatarConfig

__all__ = ["Piecewise"]


class Piecewise(Nasa):
    """NASA with parts that move rigidly and keep their shape.

    Arguments: as `Nasa`; `model.part_code` is 0 whatever is given.
    """

    def __init__(self, config: AvatarConfig, *others: Any, **named: Any) -> None:
        super().__init__(replace(config, model=replace(config.model, part_code=0)), *others, **named)
