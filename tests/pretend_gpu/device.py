"""A pretend GPU in a PyTorch without one: tensors that say cuda:0 and hold a tensor of the CPU.

Importing this module puts the device in place for the whole process, before which the library of `build` must have been loaded
(`run.run_on_pretend_gpu` does both). Every operator of PyTorch on such tensors, in the backward pass too, comes to `_dispatch`,
which notes what a GPU would do with it and computes it on the CPU. What a GPU refuses, tensors of different devices in one
operator, is noted while watched, and an error otherwise.

Operators of ours without a CUDA kernel run as they would on a GPU, as operators of PyTorch; for others see `kernels_of_ours`.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence, ValuesView
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from pretend_gpu import cuda_api, graphs, kernels_of_ours, pinned
from pretend_gpu.rules import bind, changed_by, copied_to_device, is_composite, kernels_of, takes_numbers, why_it_waits
from pretend_gpu.seen import Seen, current_line, is_watched, note, note_kernels, watching
from torch import Tensor
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["CUDA", "PretendTensor", "watch"]

CUDA = torch.device("cuda", 0)
"""The pretend device."""


class PretendTensor(Tensor):
    """A tensor that says it is on `CUDA`."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor, requires_grad: bool = False) -> PretendTensor:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        tensor = Tensor._make_wrapper_subclass(cls, inner.size(), **layout, device=CUDA, requires_grad=requires_grad)
        tensor.inner = inner
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _dispatch(func, args, kwargs or {})

    def __repr__(self, **options: Any) -> str:
        return f"{self.inner.detach()!r} on the pretend GPU"

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.dim() == 0 else repr(self)

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def __deepcopy__(self, memo: dict[int, Any]) -> PretendTensor:
        if id(self) not in memo:
            copied = PretendTensor(self.inner.detach().clone(), self.requires_grad)
            for name in vars(self).keys() - {"inner"}:
                setattr(copied, name, getattr(self, name))  # such as that it is a parameter
            memo[id(self)] = copied
        return memo[id(self)]

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.inner.detach().__reduce_ex__(protocol)  # in a file there is no difference


@contextmanager
def watch(name: str = "") -> Iterator[Seen]:
    """Note what happens on the device; at the end it becomes part of the report of `run_on_pretend_gpu`, under the name."""
    with watching(name) as seen:
        try:
            with torch.autograd.set_detect_anomaly(True, check_nan=False):  # keeps the lines of the forward pass
                yield seen
        finally:
            seen.append_to(os.environ.get("SNARF_PRETEND_GPU_REPORT"))


class _OnDevice(TorchDispatchMode):
    """Brings operators to the device that make tensors out of nothing, or out of tensors of the CPU."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None) -> Any:
        return _dispatch(func, args, kwargs or {})


# ---------------------------------------------------------------- operators
def _dispatch(operator: OpOverload, arguments: Sequence[Any], named: dict[str, Any]) -> Any:
    """Compute an operator on the CPU, and note what a GPU would have done."""
    _begin_in_thread()  # in a thread of autograd too
    tensors = list(_tensors((arguments, named.values())))
    mine = [tensor for tensor in tensors if isinstance(tensor, PretendTensor)]
    host = [tensor for tensor in tensors if not isinstance(tensor, PretendTensor)]
    values = bind(operator, arguments, named)
    to = None if values.get("device") is None else torch.device(values["device"]).type
    if pinned.concerns(operator, named):
        return pinned.run(operator, arguments, named)
    if not mine and to != "cuda":
        return operator(*arguments, **named)
    if is_composite(operator):
        with _OnDevice():
            return operator.decompose(*arguments, **named)
    if operator.namespace == "snarf" and (kernel := kernels_of_ours.kernel_on_device(operator, values)) is not None:
        with _OnDevice():
            return kernel(*arguments, **named)
    if operator._opname in ("_to_copy", "copy_"):
        _note_transfer(values, to)
    else:
        _note_devices(operator, values, mine, host)
        if mine and (reason := why_it_waits(operator, values)):
            _note("waits", f"{reason} {_sizes(mine[:1])}")
    arguments, named = _mapped(_on_host, arguments), {name: _mapped(_on_host, value) for name, value in named.items()}
    result = operator(*arguments, **named)
    if any(tensor.inner.shape != tensor.shape or tensor.inner.stride() != tensor.stride() for tensor in mine):
        raise NotImplementedError(f"{operator} changes the shape of a tensor in place, which the pretend GPU cannot do")
    if is_watched() or graphs.is_capturing():
        line = f"{operator.namespace}::{operator._opname}: {current_line()}"
        launches = kernels_of(operator, values, list(_tensors(result)))
        note_kernels(line, launches)
        graphs.record(partial(operator, *arguments, **named), (arguments, named), result, launches, line)
    stays = to != "cpu" and not (operator._opname == "copy_" and not isinstance(values["self"], PretendTensor))
    return _on_device(result, mine, host) if stays else result


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    """Return an argument or a result with `function` applied to what its lists and tuples hold."""
    return type(value)(_mapped(function, one) for one in value) if isinstance(value, list | tuple) else function(value)


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors of an argument or a result."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple | ValuesView):
        for one in value:
            yield from _tensors(one)


def _on_host(leaf: Any) -> Any:
    """Return the tensor that a tensor of the device holds; the CPU instead of the device; anything else as it is."""
    if isinstance(leaf, PretendTensor):
        return leaf.inner
    return torch.device("cpu") if isinstance(leaf, torch.device) and leaf.type == "cuda" else leaf


def _on_device(result: Any, mine: list[PretendTensor], host: list[Tensor]) -> Any:
    """Return the result of an operator as tensors of the device; arguments that it returns stay themselves."""
    given: dict[int, Tensor] = {id(tensor.inner): tensor for tensor in mine} | {id(tensor): tensor for tensor in host}

    def placed(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor):
            return leaf
        return given[id(leaf)] if id(leaf) in given else PretendTensor(leaf)

    return _mapped(placed, result)


# ---------------------------------------------------------------- what is noted
def _note(kind: str, what: str) -> None:
    """Note an event with the line that made it, or raise what a GPU raises, unless that is watched."""
    if not is_watched() and not graphs.is_capturing() and kind != "mixing":
        return
    line = f"{what}: {current_line()}"
    note(kind, line)
    if kind == "mixing" and not is_watched():
        raise RuntimeError(f"Expected all tensors to be on the same device: {line}")
    if kind != "mixing" and graphs.is_capturing():
        raise RuntimeError(f"CUDA error: operation not permitted when stream is capturing: {line}")


def _note_devices(operator: OpOverload, values: dict[str, Any], mine: list[PretendTensor], host: list[Tensor]) -> None:
    """Note tensors of both devices in one operator, where a GPU refuses them, and those that the operator copies itself."""
    copied, changed = copied_to_device(operator, values) if mine else [], changed_by(operator, values)
    for tensor in copied:
        _note("copies", f"{_sizes([tensor])} of the CPU in {operator._opname} of a tensor of the GPU")
    are_numbers = takes_numbers(operator)
    refused = [tensor for tensor in host if tensor.dim() or not are_numbers or any(tensor is one for one in changed)]
    refused = [tensor for tensor in refused if not any(tensor is one for one in copied)]
    if mine and refused:
        _note("mixing", f"{operator} of tensors {_sizes(mine)} of the GPU and {_sizes(refused)} of the CPU")
    generator = values.get("generator")
    if generator is not None and generator.device.type == "cpu":
        _note("mixing", f"{operator} for the GPU with a generator of the CPU")


def _note_transfer(values: dict[str, Any], to: str | None) -> None:
    """Note a copy between host and device, unless it is from or to pinned memory and the host goes on at once."""
    into, source = (values["self"], values["src"]) if "src" in values else (None, values["self"])
    from_device = isinstance(source, PretendTensor)
    to_device = isinstance(into, PretendTensor) if into is not None else (to or source.device.type) == "cuda"
    if from_device == to_device or not source.numel():
        return
    goes_on = values["non_blocking"]
    if from_device:
        if not goes_on or (into is not None and not pinned.is_pinned(into)):
            _note("waits", f"copy {_sizes([source])} to the CPU")
    elif not pinned.is_pinned(source):
        _note("copies", f"copy {_sizes([source])} to the GPU")
    elif not goes_on:
        _note("waits", f"copy {_sizes([source])} from pinned memory without non_blocking")


def _sizes(tensors: Sequence[Tensor]) -> str:
    return ", ".join(f"{str(tensor.dtype).removeprefix('torch.')}{list(tensor.shape)}" for tensor in tensors)


# ---------------------------------------------------------------- in place of a GPU
def _begin_in_thread() -> None:
    """Let torch.tensor(..., device=CUDA) make a tensor of the CPU and then copy it, in the thread that calls this."""
    torch._C._set_only_lift_cpu_tensors(True)


def _install() -> None:
    """Bring all operators of this process to `_dispatch`, in all its threads, and pretend that PyTorch sees a GPU."""
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # an ordinary parameter cannot become a PretendTensor
    cuda_api.install(lambda what: _note("waits", what))
    kernels_of_ours.install()
    _OnDevice().__enter__()
    _begin_in_thread()
    run = threading.Thread.run

    def run_on_device(self: threading.Thread) -> None:
        _begin_in_thread()
        with _OnDevice():
            run(self)

    threading.Thread.run = run_on_device


_install()
