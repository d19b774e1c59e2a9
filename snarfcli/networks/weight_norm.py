"""Weight normalisation of linear layers (Salimans and Kingma 2016) that can be pickled."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["WeightNormLinear"]


class WeightNormLinear(nn.Linear):
    """A linear layer whose weight has a length per output and a direction, as parameters of their own.

    The same numbers and the same state as `torch.nn.utils.parametrizations.weight_norm(layer)`. Modules that PyTorch makes with
    it cannot be pickled, saved whole by torch.save or sent to a process that is spawned.

    Args:
        layer: the layer to normalise; its weight is that at the start. Not changed.
    """

    def __init__(self, layer: nn.Linear) -> None:
        nn.Module.__init__(self)  # not that of nn.Linear, which makes a weight
        self.in_features, self.out_features = layer.in_features, layer.out_features
        self.bias = None if layer.bias is None else nn.Parameter(layer.bias.detach().clone())
        self.parametrizations = _Parametrizations(layer.weight.detach())

    @property
    def direction(self) -> nn.Parameter:
        """[outputs, inputs], of any length."""
        return self.parametrizations.weight.original1

    @property
    def length(self) -> nn.Parameter:
        """[outputs, 1], of the rows of the weight."""
        return self.parametrizations.weight.original0

    @property
    def weight(self) -> Tensor:
        """[outputs, inputs], differentiable in both parameters."""
        pair = self.parametrizations.weight
        # No public function has the same bits. Its second derivative by both parameters is wrong (PyTorch 2.13); that by points
        # and one of them, as of a loss on the slope of a field, is exact.
        return torch._weight_norm(pair.original1, pair.original0, 0)  # pyright: ignore[reportPrivateImportUsage]


class _Parametrizations(nn.Module):
    """Gives the parameters the names that PyTorch's weight norm gives them in a state."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.weight = _Pair(weight)


class _Pair(nn.Module):
    """Length per output and direction of a weight [outputs, inputs]."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.original0 = nn.Parameter(torch.norm_except_dim(weight, 2, 0))
        self.original1 = nn.Parameter(weight.clone())
