"""Functions of canonical points that users give: weight fields and forward maps, which may depend on the pose."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor, nn

__all__ = ["takes_pose", "with_pose"]

_POSE = "pose_index"


def takes_pose(function: Callable[..., Tensor]) -> bool:
    """Return whether a function has a parameter named `pose_index` that is not bound yet.

    Args:
        function: a function, method, callable object or functools.partial, or a module, also one that is compiled, scripted,
            traced, exported or wrapped for several devices. If its parameters are not known, it takes no pose.
    """
    return _POSE in _parameters(function)


def with_pose(function: Callable[..., Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a function of canonical points [K, 3] and the index of each one's pose, [K], long.

    Args:
        function: of the points and `pose_index`, or of the points alone (see `takes_pose`).
    """
    parameters = _parameters(function)
    if _POSE not in parameters:
        return lambda x, pose_index: function(x)
    if list(parameters)[1:2] == [_POSE] and parameters[_POSE]:  # by position, which also vmap and exported programs understand
        return function
    return lambda x, pose_index: function(x, pose_index=pose_index)


def _parameters(function: Any) -> dict[str, bool]:
    """Return the parameters that a caller can give, and whether by position; none if they cannot be known."""
    if isinstance(function, partial) and isinstance(function.func, nn.Module):
        free = list(_parameters(function.func).items())[len(function.args) :]
        return {name: by_position and not function.keywords for name, by_position in free if name not in function.keywords}
    if isinstance(function, nn.Module):
        inner = getattr(function, "_orig_mod", None)  # of torch.compile
        if inner is None and isinstance(function, nn.DataParallel | nn.parallel.DistributedDataParallel):
            inner = function.module
        return _parameters(function.forward if inner is None else inner)
    schema = getattr(function, "schema", None)  # of what TorchScript has compiled
    if schema is not None and hasattr(schema, "arguments"):
        return {argument.name: not argument.kwarg_only for argument in schema.arguments if argument.name != "self"}
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return {}
    bound = function.keywords if isinstance(function, partial) else {}
    named = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.VAR_KEYWORD)
    return {parameter.name: parameter.kind not in named for parameter in parameters if parameter.name not in bound}
