"""Fixed numbers that are kept on devices."""

from __future__ import annotations

import torch
from torch._subclasses import FakeTensorMode

from snarfcli import constants
from snarfcli.constants import constant

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


def test_constants_of_a_cpu_are_new_in_every_call():
    first, second = constant([1, 2], CPU), constant([1, 2], CPU)
    assert first is not second
    assert first.tolist() == [1, 2]
    assert first.dtype == torch.int64
    assert constant([0.5], CPU, torch.float64).dtype == torch.float64


def test_what_has_no_values_is_not_kept(monkeypatch):
    monkeypatch.setattr(constants, "_kept", {})
    with FakeTensorMode():
        assert constant([1, 2], CUDA).device == CUDA
    assert not constants._kept


def test_constants_of_another_device_are_kept_as_normal_tensors(monkeypatch):
    kept = {}
    monkeypatch.setattr(constants, "_kept", kept)
    made = torch.tensor
    monkeypatch.setattr(torch, "tensor", lambda values, dtype, device: made(values, dtype=dtype))  # there may be no GPU
    with torch.inference_mode():
        first = constant([1, 2], CUDA)
    assert not first.is_inference()
    assert constant([1, 2], CUDA) is first
    others = [constant([1, 2], CUDA, torch.float32), constant([2, 1], CUDA), constant([1, 2], torch.device("cuda", 1))]
    assert all(other is not first for other in others)
    assert len(kept) == 4
