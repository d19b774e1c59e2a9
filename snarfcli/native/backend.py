"""Choose between the native kernels and the reference in PyTorch, for the type of device that holds the tensors."""

from __future__ import annotations

import warnings
from functools import cache

from snarfcli.native.cuda_compile import nvrtc_version
from snarfcli.native.library import why_unavailable

__all__ = ["BACKENDS", "choose_backend", "why_no_kernels"]

BACKENDS = ("auto", "native", "reference")
"""Names of the backends."""


def choose_backend(backend: str, device_type: str = "cpu") -> str:
    """Return "native" or "reference" for "auto", "native" or "reference".

    "auto" gives "native" where there are native kernels for the device; elsewhere it warns once and gives "reference".

    Args:
        backend: one of `BACKENDS`.
        device_type: type of the device that holds the tensors, such as cpu or cuda.

    Raises:
        ValueError: unknown `backend`.
        RuntimeError: `backend` is "native" and there are no native kernels; the message states the reason.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: wanted {', '.join(BACKENDS[:-1])} or {BACKENDS[-1]}, got {backend!r}")
    if backend == "reference":
        return backend
    reason = why_no_kernels(device_type)
    if reason is None:
        return "native"
    if backend == "native":
        raise RuntimeError(f"backend native is not available: {reason}")
    _warn_once(reason)
    return "reference"


def why_no_kernels(device_type: str) -> str | None:
    """Return why there are no native kernels for a type of device, in one line, or None if there are."""
    if device_type == "cpu":
        return why_unavailable()
    if device_type == "cuda":
        return _why_no_cuda_kernels()
    return f"there are no kernels for tensors on {device_type}; move them to the CPU or to a CUDA device"


@cache
def _why_no_cuda_kernels() -> str | None:
    try:
        nvrtc_version()
    except (RuntimeError, OSError) as error:
        return str(error)
    return None


@cache
def _warn_once(reason: str) -> None:
    message = f"snarf computes with its references in PyTorch, many times slower than with its native kernels: {reason}"
    warnings.warn(message, RuntimeWarning, stacklevel=3)
