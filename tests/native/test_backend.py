"""The choice between CUDA kernels and the reference, on GPUs that do not exist: what runs if kernels cannot."""

from __future__ import annotations

import warnings

import pytest
import torch
from fake_gpus import FakeDriver, install_gpus
from torch._subclasses import FakeTensorMode

from snarfcli.cli.messages import user_message
from snarfcli.deformer import trilinear, variation
from snarfcli.native import backend, cuda, cuda_compile, cuda_driver
from snarfcli.native.backend import choose_backend, why_no_kernels
from snarfcli.networks import capsules, encoding

GPU = torch.device("cuda", 0)
LOG = "NVRTC 13.0 cannot compile gather.cu for sm_90:\nnvrtc: error: failed to open libnvrtc-builtins.so.13.0.\n  Make sure"


@pytest.fixture(autouse=True)
def forget():
    """Forget afterwards what was found out about the GPUs of a test."""
    yield
    for cached in (backend._why_no_cuda_kernels, backend._warn_once, cuda_driver._gpu):
        cached.cache_clear()


@pytest.fixture
def compiled(monkeypatch, tmp_path):
    """Yield the list of what is compiled, by a compiler that knows the architectures 75 to 120."""
    done = []
    monkeypatch.setattr(cuda_compile, "supported_architectures", lambda: [75, 90, 120])
    monkeypatch.setattr(cuda_compile, "nvrtc_version", lambda: "13.0")
    monkeypatch.setattr(cuda_compile, "compile_kernels", lambda *wanted: done.append(wanted) or b"code")
    for module in (cuda_compile, cuda):
        monkeypatch.setattr(module, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(cuda, "nvrtc_version", lambda: "13.0")
    return done


def fail_with(error: Exception):
    def fail(*_):
        raise error

    return fail


def test_the_smallest_kernel_is_compiled_once_and_kept(monkeypatch, compiled):
    driver = FakeDriver()
    install_gpus(monkeypatch, [(9, 0)], driver)
    assert choose_backend("auto", GPU) == choose_backend("native", GPU) == choose_backend("auto", "cuda") == "native"
    assert compiled == [("gather", torch.float32, "sm_90")]
    assert driver.called.count("cuModuleLoadData") == 1
    backend._why_no_cuda_kernels.cache_clear()
    cuda_driver._gpu.cache_clear()
    assert why_no_kernels(GPU) is None
    assert len(compiled) == 1, "it is in the cache on disk"


WRONG = {
    "an NVRTC that cannot compile": (
        lambda patch: patch.setattr(cuda_compile, "compile_kernels", fail_with(RuntimeError(LOG))),
        "NVRTC 13.0 cannot compile gather.cu for sm_90: nvrtc: error: failed to open libnvrtc-builtins.so.13.0. Make sure",
    ),
    "no NVRTC": (
        lambda patch: patch.setattr(cuda_compile, "supported_architectures", fail_with(RuntimeError("NVRTC was not found"))),
        "NVRTC was not found",
    ),
    "a GPU that is too old": (
        lambda patch: install_gpus(patch, [(5, 0)], FakeDriver()),
        "NVRTC 13.0 no longer supports compute capability 5.0",
    ),
    "a full GPU": (
        lambda patch: install_gpus(patch, [(9, 0)], FakeDriver(failing={"cuDevicePrimaryCtxRetain": 2})),
        "CUDA: error 2 of the driver",
    ),
    "a driver that does not know the code": (
        lambda patch: install_gpus(patch, [(9, 0)], FakeDriver(failing={"cuModuleLoadData": 222})),
        "CUDA: error 222 of the driver",
    ),
    "no driver": (
        lambda patch: install_gpus(patch, [(9, 0)], None),
        "libcuda.so.1: cannot open shared object file",
    ),
    "no GPU": (lambda patch: install_gpus(patch, [], FakeDriver()), "the NVIDIA driver reports no GPU"),
    "a PyTorch for another kind of GPU": (
        lambda patch: install_gpus(patch, [(9, 0)], FakeDriver(), cuda=None),
        "this PyTorch is built without CUDA",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_auto_falls_back_with_one_line_and_native_raises_one(case, monkeypatch, compiled):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    install_gpus(monkeypatch, [(9, 0)], FakeDriver())
    break_it, reason = WRONG[case]
    break_it(monkeypatch)
    with pytest.warns(RuntimeWarning) as caught:
        assert [choose_backend("auto", GPU) for _ in range(2)] == ["reference", "reference"]
    (warning,) = caught
    assert str(warning.message).endswith(f"many times slower than with its native kernels: {reason}")
    with pytest.raises(RuntimeError, match="backend native is not available: ") as raised:
        choose_backend("native", GPU)
    line = user_message(raised.value)
    assert line is not None
    assert reason in line
    assert line.endswith("backend auto uses the reference instead")
    status = cuda.cuda_status()
    assert status.startswith("not available")
    assert reason in status
    assert "\n" not in status


def test_each_gpu_is_judged_by_itself(monkeypatch, compiled):
    install_gpus(monkeypatch, [(9, 0), (5, 0), (12, 0)], FakeDriver())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chosen = [choose_backend("auto", torch.device("cuda", index)) for index in range(3)]
    assert chosen == ["native", "reference", "native"]
    assert [architecture for _, _, architecture in compiled] == ["sm_90", "sm_120"]
    status = cuda.cuda_status()
    assert status.startswith("available on GPU 0, GPU 2; compiled on first use by NVRTC 13.0, kept in ")
    assert status.endswith("; on cuda:1 the reference in PyTorch is used: NVRTC 13.0 no longer supports compute capability 5.0")


def test_a_missing_cache_is_told(monkeypatch, compiled):
    install_gpus(monkeypatch, [(9, 0)], FakeDriver())
    for module in (cuda_compile, cuda):
        monkeypatch.setattr(module, "cache_folder", lambda: None)
    assert cuda.cuda_status().endswith("kept in memory only, since there is no home folder")


CHOICES = {
    "segments": (capsules, lambda device: (torch.empty(4, 3, device=device), torch.empty(2, 2, 3, device=device))),
    "encoding": (encoding, lambda device: (torch.empty(4, 3, device=device), torch.empty(2, 1, device=device), [])),
    "variation": (variation, lambda device: (torch.empty(2, 2, 2, 3, device=device), torch.empty(3, device=device))),
    "interpolation": (trilinear, lambda device: (torch.empty(2, 2, 2, 3, device=device), torch.empty(4, 3, device=device))),
}


@pytest.mark.parametrize(("module", "arguments"), CHOICES.values(), ids=CHOICES)
def test_kernels_are_tried_on_the_gpu_of_the_tensors(monkeypatch, module, arguments):
    """Not on the current one, which may be another that can or cannot run them."""
    asked = []
    monkeypatch.setattr(module, "choose_backend", lambda backend, device: asked.append((backend, device)) or "reference")
    with FakeTensorMode():
        assert not module._has_kernel(*arguments("cuda:1"))
    assert asked == [("auto", torch.device("cuda", 1))]
