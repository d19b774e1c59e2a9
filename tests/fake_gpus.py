"""GPUs and a CUDA driver that do not exist, as PyTorch and the code that calls the driver see them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from snarfcli import devices
from snarfcli.native import backend, cuda_driver

__all__ = ["FakeDriver", "install_gpus"]


class FakeDriver:
    """Stands for the driver's library: every function succeeds, but for those in `failing`, by their error code."""

    def __init__(self, version: int = 13000, failing: dict[str, int] | None = None) -> None:
        self.version, self.failing = version, failing or {}
        self.called: list[str] = []

    def cuDriverGetVersion(self, version: Any) -> int:
        version._obj.value = self.version
        return 0

    def cuGetErrorString(self, code: int, text: Any) -> int:
        text._obj.value = b"error %d of the driver" % code
        return 0

    def __getattr__(self, name: str) -> Callable[..., int]:
        self.called.append(name)
        return lambda *arguments: self.failing.get(name, 0)


def install_gpus(
    monkeypatch: pytest.MonkeyPatch,
    capabilities: list[tuple[int, int]],
    driver: FakeDriver | None,
    cuda: str | None = "13.0",
) -> None:
    """Make PyTorch see GPUs named "GPU 0" and so on; with `cuda` it is built for that version, with None without CUDA.

    Args:
        capabilities: compute capability of each GPU.
        driver: the driver; None for a machine without one.
    """

    def load() -> FakeDriver:
        if driver is None:
            raise OSError("libcuda.so.1: cannot open shared object file")
        return driver

    def number(device: torch.device | int | None = None) -> int:
        return device if isinstance(device, int) else (device.index or 0) if device is not None else 0

    monkeypatch.setattr(torch.version, "cuda", cuda)
    for name, function in {
        "is_available": lambda: bool(capabilities),
        "device_count": lambda: len(capabilities),
        "current_device": lambda: 0,
        "get_device_capability": lambda device=None: capabilities[number(device)],
        "get_device_name": lambda device=None: f"GPU {number(device)}",
        "get_device_properties": lambda device: SimpleNamespace(
            name=f"GPU {number(device)}", total_memory=2**30, major=capabilities[number(device)][0], minor=0
        ),
        "device": lambda device: nullcontext(),
        "set_device": lambda device: None,
    }.items():
        monkeypatch.setattr(torch.cuda, name, function)
    for module in (devices, cuda_driver):
        monkeypatch.setattr(module, "cuda_driver", load)
    for cached in (backend._why_no_cuda_kernels, backend._warn_once, cuda_driver._gpu):
        cached.cache_clear()
