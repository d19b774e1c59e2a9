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
