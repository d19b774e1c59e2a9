"""GPUs that do not exist: which one a process uses, and what is told if it cannot be used."""

from __future__ import annotations

import warnings

import pytest
import torch
from fake_gpus import FakeDriver, install_gpus

from snarfcli import devices, runs
from snarfcli.errors import UserError
from snarfcli.runs import check_device, choose_device, machine_facts
from snarfcli.slots import SLOT_VARIABLE, current_slot, use_slot

FULL = "CUDA out of memory. Tried to allocate 2.00 MiB.\nCompile with `TORCH_USE_CUDA_DSA` to enable device-side assertions.\n"


@pytest.fixture
def four_gpus(monkeypatch):
    """Four GPUs, of which those in the list that is yielded are full."""
    monkeypatch.delenv(SLOT_VARIABLE, raising=False)
    install_gpus(monkeypatch, [(9, 0)] * 4, FakeDriver())
    full: list[int] = []
    real = torch.ones

    def ones(*size, device=None, **more):
        if device is not None and device.index in full:
            raise RuntimeError(FULL)
        return real(*size, **more)

    monkeypatch.setattr(torch, "ones", ones)
    return full


@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_processes_at_the_same_time_use_different_gpus(four_gpus, name):
    chosen = []
    for slot in range(6):
        with use_slot(slot):
            chosen.append(str(choose_device(name)))
    assert chosen == ["cuda:0", "cuda:1", "cuda:2", "cuda:3", "cuda:0", "cuda:1"]
    assert str(choose_device(name)) == "cuda:0"


def test_a_named_device_wins(four_gpus):
    with use_slot(3):
        assert str(choose_device("cuda:1")) == "cuda:1"
        assert str(choose_device("cpu")) == "cpu"


def test_a_gpu_that_is_full_is_passed_over(four_gpus, caplog):
    four_gpus += [2, 3]
    with use_slot(2):
        assert str(choose_device("auto")) == "cuda:0"
    wanted = r"^device: wanted cuda:2, got none, since cuda:2 cannot be used \(CUDA out of memory[^\n]*\.\); give device=cpu$"
    with pytest.raises(UserError, match=wanted):
        choose_device("cuda:2")
    four_gpus += [0, 1]
    with caplog.at_level("INFO"):
        assert choose_device("auto").type == "cpu"
    assert "device=auto: the CPU is used, since cuda:0 cannot be used (CUDA out of memory" in caplog.text
    with pytest.raises(UserError, match="device: wanted cuda, got none, since cuda:0 cannot be used"):
        choose_device("cuda")


def test_a_gpu_that_is_not_there_is_named(four_gpus):
    check_device("cuda:3")
    with pytest.raises(UserError, match="wanted cuda:4, got none, since PyTorch sees 4 GPUs, the last one cuda:3; give"):
        choose_device("cuda:4")


REASONS = {
    "no driver": (None, "there is no NVIDIA driver"),
    "an old driver": (
        FakeDriver(12020),
        "the NVIDIA driver supports CUDA 12.2, and this PyTorch needs 13.0; update the driver",
    ),
    "a hidden GPU": (FakeDriver(13000), "the NVIDIA driver reports no GPU (CUDA_VISIBLE_DEVICES=7 8)"),
}


@pytest.mark.parametrize("case", REASONS)
def test_without_a_usable_driver_auto_says_that_the_cpu_runs_and_cuda_what_is_missing(case, monkeypatch, caplog):
    driver, reason = REASONS[case]
    install_gpus(monkeypatch, [], driver)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7\n8")

    def is_available() -> bool:
        warnings.warn("The NVIDIA driver on your system is too old\nPlease update", UserWarning, stacklevel=2)
        return False

    monkeypatch.setattr(torch.cuda, "is_available", is_available)
    with warnings.catch_warnings(), caplog.at_level("INFO"):
        warnings.simplefilter("error")
        assert choose_device("auto").type == "cpu"
        with pytest.raises(UserError) as raised:
            choose_device("cuda")
    assert [record.getMessage() for record in caplog.records] == [f"device=auto: the CPU is used, since {reason}"]
    assert str(raised.value) == f"device: wanted cuda, got none, since {reason}; give device=cpu"


def test_a_pytorch_without_cuda_is_a_choice_that_nothing_is_said_about(monkeypatch, caplog):
    install_gpus(monkeypatch, [], FakeDriver(), cuda=None)
    with caplog.at_level("INFO"):
        assert choose_device("auto").type == "cpu"
    assert not caplog.records
    with pytest.raises(UserError, match="wanted cuda, got none, since this PyTorch is built without CUDA; give device=cpu"):
        choose_device("cuda")


def test_the_driver_s_version_is_read(monkeypatch):
    monkeypatch.setattr(devices, "cuda_driver", lambda: FakeDriver(12040))
    assert devices.driver_version() == (12, 4)


def test_the_gpu_of_a_result_is_the_one_that_computed_it(four_gpus):
    assert machine_facts(torch.device("cuda", 2))["machine"]["gpu"] == "GPU 2"
    for device in (torch.device("cpu"), None):
        assert "gpu" not in machine_facts(device)["machine"]


def test_slots_are_restored(monkeypatch):
    monkeypatch.setenv(SLOT_VARIABLE, "1")
    with use_slot(5):
        assert current_slot() == 5
    assert current_slot() == 1
    monkeypatch.setenv(SLOT_VARIABLE, "")
    assert current_slot() == 0


@pytest.mark.parametrize("text", ["-1", "two", "1" * 30, "\u0663"])
def test_a_slot_that_is_no_number_is_refused(four_gpus, monkeypatch, text):
    monkeypatch.setenv(SLOT_VARIABLE, text)
    with pytest.raises(UserError, match=r"^SNARF_GPU_SLOT: wanted a whole number from 0, got '[^\n]*'; correct or unset it$"):
        choose_device("auto")


def test_checking_a_device_starts_nothing(four_gpus, monkeypatch):
    monkeypatch.setattr(runs, "why_unusable", lambda gpu: pytest.fail("it was tried out"))
    for name in ("auto", "cpu", "cuda", "cuda:3"):
        check_device(name)
