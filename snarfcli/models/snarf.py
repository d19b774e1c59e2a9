"""SNARF: forward skinning by a weight network that is searched itself, by Broyden's method from every bone (SNARF Sec. 3)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.settings import AvatarConfig

__all__ = ["Snarf"]


class Snarf(FastSnarf):
    """Fast-SNARF without its grid: the field of `skinning` is a network, whose own roots are found.

    Arguments: as `FastSnarf`; `skinning.name` is "mlp" whatever is given, and `search.name` must be "broyden".
    """

    def __init__(self, config: AvatarConfig, *others: Any, **named: Any) -> None:
        super().__init__(replace(config, skinning=replace(config.skinning, name="mlp")), *others, **named)
