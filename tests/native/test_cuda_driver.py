"""Launching kernels through the driver: what is asked of it, with a driver that only takes notes."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import pytest
import torch
from fake_gpus import FakeDriver, install_gpus

from snarfcli.native import cuda_driver
from snarfcli.native.cuda_driver import Gpu


@pytest.fixture
def driver(monkeypatch) -> FakeDriver:
    driver = FakeDriver()
    install_gpus(monkeypatch, [(9, 0)], driver)
    monkeypatch.setattr(cuda_driver, "architecture_for", lambda capability: "sm_90")
    monkeypatch.setattr(cuda_driver, "load_kernels", lambda *asked: b"code")
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0))
    return driver


def test_large_shared_memory_is_asked_for_once(driver):
    gpu = Gpu(torch.device("cuda", 0), torch.float32)
    assert gpu.capability == (9, 0)

    class Nothing(ctypes.Structure):
        _fields_ = []

    for shared_bytes in (0, 48 * 1024):
        gpu.launch("source", "kernel", (1, 1), 32, Nothing(), shared_bytes)
    assert "cuFuncSetAttribute" not in driver.called
    for shared_bytes in (60_000, 50_000, 60_000, 70_000):
        gpu.launch("source", "kernel", (1, 1), 32, Nothing(), shared_bytes)
    assert driver.called.count("cuFuncSetAttribute") == 2
    assert driver.called.count("cuLaunchKernel") == 6
    assert driver.called.count("cuModuleLoadData") == 1


def test_kernels_are_loaded_as_a_capture_allows(driver, monkeypatch):
    """Strict modes refuse to load in any thread while one captures; the thread's own mode is set again afterwards."""
    mode, seen = [0], []

    def exchange(wanted):
        wanted._obj.value, mode[0] = mode[0], wanted._obj.value
        return 0

    def load(module, code):
        seen.append(mode[0])
        return len(seen) == 1  # an error the first time

    monkeypatch.setattr(driver, "cuThreadExchangeStreamCaptureMode", exchange, raising=False)
    monkeypatch.setattr(driver, "cuModuleLoadData", load, raising=False)
    gpu = Gpu(torch.device("cuda", 0), torch.float32)
    with pytest.raises(RuntimeError, match="CUDA: error 1 of the driver"):
        gpu.load("source", "kernel")
    gpu.load("source", "kernel")
    assert seen == [2, 2]
    assert mode == [0]
