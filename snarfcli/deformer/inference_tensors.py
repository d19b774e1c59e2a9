"""Tensors made under torch.inference_mode(), made usable where autograd is needed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map_only

__all__ = ["NormalTensors"]


class NormalTensors(TorchFunctionMode):
    """Inside the block every function of PyTorch sees copies in the place of inference tensors, which autograd cannot save.

    A function that users give may hold such tensors, for example bone transforms, where a derivative by its points is needed.
    Each is copied once.
    """

    def __init__(self) -> None:
        super().__init__()
        self._copies: dict[int, tuple[Tensor, Tensor]] = {}  # by id; the first keeps the id from being given to another

    def __torch_function__(
        self, func: Callable, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        args = tree_map_only(Tensor, self._normal, tuple(args))
        return func(*args, **tree_map_only(Tensor, self._normal, dict(kwargs or {})))

    def _normal(self, tensor: Tensor) -> Tensor:
        if not tensor.is_inference():
            return tensor
        if id(tensor) not in self._copies:
            self._copies[id(tensor)] = tensor, tensor.clone()
        return self._copies[id(tensor)][1]
