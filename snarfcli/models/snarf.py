"""SNARF: forward skinning by a weight network that is searched itself, by Broyden's method from every bone (SNARF Sec. 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.settings import AvatarConfig
from snarfcli.models.system import MeshTemplate

__all__ = ["Snarf"]


class Snarf(FastSnarf):
    """Fast-SNARF without its grid: the field of `skinning` is a network, whose own roots are found.

    Arguments: as `FastSnarf`; `skinning.name` is "mlp" whatever is given, and `search.name` must be "broyden".
    """

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor,
        template: MeshTemplate | None = None,
        field: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        skinning = replace(config.skinning, name="mlp")
        super().__init__(replace(config, skinning=skinning), skeleton, grid, surface, template, field)
