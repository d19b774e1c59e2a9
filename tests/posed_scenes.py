"""Deformers of weights that are trained at the nodes or searched as a field, for tests of prepared poses."""

from __future__ import annotations

import torch
from skinning_scenes import unit_grid
from torch import nn

from snarfcli.deformer import (
    ForwardDeformer,
    SearchConfig,
    SkinningConfig,
)
from snarfcli.deformer.weights import GridWeights

__all__ = ["SHAPE", "Trained", "assert_same", "deformer_of", "field_deformer"]

SHAPE = (6, 7, 8)


class Trained(GridWeights):
    """Weights at the nodes that are optimised as they are; they need not sum to 1 for a gradient check."""

    def __init__(self, weights: torch.Tensor) -> None:
        super().__init__(unit_grid(weights.dtype), tuple(weights.shape[:3]))
        self.values = nn.Parameter(weights.reshape(-1, weights.shape[-1]).clone())

    def at_nodes(self, nodes=None):
        return self.values if nodes is None else self.values[nodes]


def deformer_of(weights: torch.Tensor, search: SearchConfig | str = "complete", cells=None) -> ForwardDeformer:
    depth, height, width, bones = weights.shape
    skinning = SkinningConfig("voxel", resolution=[width, height, depth])
    return ForwardDeformer(unit_grid(weights.dtype), bones, skinning, search, cells, field=Trained(weights))


def field_deformer(dtype=torch.float64) -> ForwardDeformer:
    """Return a deformer whose field is searched directly."""
    torch.manual_seed(0)
    skinning = SkinningConfig("mlp", resolution=[8, 7, 6], width=16, depth=2)
    return ForwardDeformer(unit_grid(torch.float32), 3, skinning, SearchConfig("broyden", max_steps=50, divergence=5.0)).to(
        dtype
    )


def assert_same(found, wanted, atol: float = 0.0) -> None:
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, rtol=0, atol=atol)
    torch.testing.assert_close(found.jacobian_inverse, wanted.jacobian_inverse, rtol=1e-3 if atol else 0, atol=atol)
