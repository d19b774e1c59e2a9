"""Choose between the native kernels and the reference in PyTorch, for the device that holds the tensors."""

from __future__ import annotations

import warnings
from functools import cache

import torch

from snarfcli.devices import why_no_gpu
from snarfcli.errors import UserError
from snarfcli.native.cuda_driver import try_kernels
from snarfcli.native.library import why_unavailable
from snarfcli.texts import one_line

__all__ = ["BACKENDS", "BackendUnavailable", "choose_backend", "why_no_kernels"]

BACKENDS = ("auto", "native", "reference")
"""Names of the backends."""

_LONGEST = 500  # characters of a reason; the log of a compiler may be long


class BackendUnavailable(UserError, RuntimeError):
    """The backend "native" was asked for, and there are no native kernels for the device."""


def choose_backend(backend: str, device: torch.device | str = "cpu") -> str:
    """Return "native" or "reference" for "auto", "native" or "reference".

    "auto" gives "native" where there are native kernels for the device; elsewhere it warns once and gives "reference".

    Args:
        backend: one of `BACKENDS`.
        device: device that holds the tensors, or its type; "cuda" stands for PyTorch's current GPU.

    Raises:
        ValueError: unknown `backend`.
        BackendUnavailable: `backend` is "native" and there are no native kernels; the message states the reason.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: wanted {', '.join(BACKENDS[:-1])} or {BACKENDS[-1]}, got {backend!r}")
    if backend == "reference":
        return backend
    reason = why_no_kernels(device)
    if reason is None:
        return "native"
    if backend == "native":
        raise BackendUnavailable(f"backend native is not available: {reason}; backend auto uses the reference instead")
    _warn_once(reason)
    return "reference"


def why_no_kernels(device: torch.device | str) -> str | None:
    """Return why there are no native kernels for a device, in one line, or None if there are.

    For a GPU the smallest kernel is compiled and loaded, once per process.
    """
    device = torch.device(device)
    if device.type == "cpu":
        return why_unavailable()
    if device.type == "cuda":
        return _why_no_cuda_kernels(device)
    return f"there are no kernels for tensors on {device.type}; move them to the CPU or to a CUDA device"


@cache
def _why_no_cuda_kernels(gpu: torch.device) -> str | None:
    if not torch.version.cuda:
        return "this PyTorch is built without CUDA"
    reason = why_no_gpu()
    if reason is not None:
        return reason
    try:
        try_kernels(gpu)
    except (RuntimeError, OSError) as error:
        return one_line(error, _LONGEST)
    return None


@cache
def _warn_once(reason: str) -> None:
    message = f"snarf computes with its references in PyTorch, many times slower than with its native kernels: {reason}"
    warnings.warn(message, RuntimeWarning, stacklevel=3)
