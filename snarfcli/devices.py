"""GPUs: in which order a process tries them, and why one cannot be used."""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from ctypes import byref, c_int
from functools import cache

import torch

from snarfcli.errors import UserError
from snarfcli.slots import current_slot
from snarfcli.texts import one_line

__all__ = ["cuda_driver", "driver_version", "gpus_in_turn", "why_no_gpu", "why_unusable"]

_LONGEST = 300  # characters of an error of PyTorch


@cache
def cuda_driver() -> ctypes.CDLL:
    """Return the CUDA driver's library.

    Raises:
        OSError: it is not installed.
    """
    return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")


def driver_version() -> tuple[int, int] | None:
    """Return the newest CUDA version that the installed driver supports, such as (13, 0), or None without a driver."""
    version = c_int()
    try:
        code = cuda_driver().cuDriverGetVersion(byref(version))
    except (OSError, AttributeError):
        return None
    return None if code else (version.value // 1000, version.value % 1000 // 10)


def why_no_gpu() -> str | None:
    """Return why PyTorch sees no GPU, as a clause, or None if it sees one. Does not start CUDA."""
    with warnings.catch_warnings():  # what PyTorch prints about the driver, in several lines
        warnings.simplefilter("ignore")
        if torch.cuda.is_available():
            return None
    if not torch.version.cuda:
        return "this PyTorch is built without CUDA"
    version = driver_version()
    if version is None:
        return "there is no NVIDIA driver"
    if version[0] < int(torch.version.cuda.split(".")[0]):  # drivers run all programs of their major version
        supported = ".".join(map(str, version))
        return f"the NVIDIA driver supports CUDA {supported}, and this PyTorch needs {torch.version.cuda}; update the driver"
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    hidden = "" if visible is None else f" (CUDA_VISIBLE_DEVICES={one_line(visible, 60)})"
    return f"the NVIDIA driver reports no GPU{hidden}"


def why_unusable(gpu: torch.device) -> str | None:
    """Return why tensors cannot be computed with on a GPU, as a clause, or None if they can. Runs one operation there."""
    try:
        with warnings.catch_warnings():  # what PyTorch prints about an old GPU, in several lines
            warnings.simplefilter("ignore")
            torch.ones(1, device=gpu).add(1).item()
    except (RuntimeError, torch.cuda.DeferredCudaCallError) as error:
        # PyTorch has no code for the GPU, or the GPU is full, or another process has it to itself.
        text = str(error).partition("\n")[0]  # then follows advice for developers
        return f"{gpu} cannot be used ({one_line(text, _LONGEST)})"
    return None


def gpus_in_turn() -> list[torch.device]:
    """Return all GPUs, beginning with that of this process: cuda:N, where N is its slot modulo the number of GPUs.

    Raises:
        UserError: the environment variable of the slot is no number.
    """
    try:
        count, first = torch.cuda.device_count(), current_slot()
    except ValueError as error:
        raise UserError(str(error)) from None
    return [torch.device("cuda", (first + further) % count) for further in range(count)]
