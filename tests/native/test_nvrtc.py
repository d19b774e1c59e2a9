"""NVRTC is found in every place where it may be installed, and its versions compile the kernels, without a GPU."""

from __future__ import annotations

import locale
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from test_cuda_compile import SOURCES, needs_nvrtc

from snarfcli.native import cuda_compile, nvrtc

FOLDER = Path(os.environ.get("SNARF_TEST_NVRTC") or Path(__file__).parents[2] / "build" / "nvrtc")


@pytest.fixture
def fresh():
    """Forget which NVRTC was loaded, before the test and after it."""
    nvrtc._nvrtc.cache_clear()
    yield
    nvrtc._nvrtc.cache_clear()


@pytest.mark.parametrize("version", ["11.8", "12.4", "13.0"])
def test_the_versions_of_pytorch_s_builds_compile_every_kernel(version, fresh, monkeypatch):
    """13.0 does not find its built-in headers by itself; older ones change the locale, so that Python would read ASCII only."""
    files = sorted((FOLDER / version).glob("nvidia/*/lib/libnvrtc.so.*"))
    if not files:
        pytest.skip(f'no NVRTC {version} in {FOLDER}; "make test" or tools/fetch_nvrtc.sh puts it there')
    monkeypatch.setattr(nvrtc, "_candidates", lambda: [str(files[0])])
    assert cuda_compile.nvrtc_version() == version
    encoding = locale.getpreferredencoding()
    for source in SOURCES:  # sm_80 has TF32 and bfloat16, and every version knows it
        assert cuda_compile.compile_kernels(source, torch.float32, "sm_80").startswith(b"\x7fELF")
    assert locale.getpreferredencoding() == encoding


def wheels(root: Path, *files: str) -> Path:
    """Make empty files as NVIDIA's wheels put them; return the folder that the package `nvidia` is in."""
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).touch()
    return root


LINUX = (
    "nvidia/cuda_nvrtc/lib/libnvrtc.so.12",
    "nvidia/cuda_nvrtc/lib/libnvrtc.alt.so.12",
    "nvidia/cuda_nvrtc/lib/libnvrtc-builtins.so.12.8",
    "nvidia/cu13/lib/libnvrtc.so.13",
    "nvidia/cu13/lib/libnvrtc-builtins.so.13.0",
    "nvidia/cu13/lib/libnvrtc-builtins.alt.so.13.0",
    "nvidia/cu13/lib/libnvrtc-builtins.so.12.9",
)
WINDOWS = (
    "nvidia/cuda_nvrtc/bin/nvrtc64_120_0.dll",
    "nvidia/cuda_nvrtc/bin/nvrtc64_120_0.alt.dll",
    "nvidia/cuda_nvrtc/bin/nvrtc-builtins64_128.dll",
    "nvidia/cu13/bin/x86_64/nvrtc64_130_0.dll",
    "nvidia/cu13/bin/x86_64/nvrtc64_130_0.alt.dll",
    "nvidia/cu13/bin/x86_64/nvrtc-builtins64_130.dll",
)


@pytest.fixture(params=["linux", "win32"])
def installed(request, tmp_path, monkeypatch):
    """Yield the folder of the wheels for CUDA 12 and 13 on two systems, which are the only places with NVRTC."""
    monkeypatch.setattr(sys, "platform", request.param)
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(variable, raising=False)
    root = wheels(tmp_path, *(LINUX if request.param == "linux" else WINDOWS))
    spec = SimpleNamespace(submodule_search_locations=[str(root / "nvidia")])
    monkeypatch.setattr(nvrtc.importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setattr(torch, "__file__", str(root / "torch" / "__init__.py"))
    return root


def names(paths: list) -> list[str]:
    return [Path(path).name for path in paths]


@pytest.mark.parametrize(("cuda", "majors"), [("12.8", [12, 13]), ("13.0", [13, 12]), (None, [13, 12])])
def test_the_version_of_pytorch_comes_first_and_else_the_newest(installed, monkeypatch, cuda, majors):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    found = [path for path in nvrtc._candidates() if Path(path).is_file()]
    assert [nvrtc._major(Path(path)) for path in found] == majors
    assert all(re.fullmatch(r"libnvrtc\.so\.1[23]|nvrtc64_1[23]0_0\.dll", name) for name in names(found))


def test_a_toolkit_is_found_too(installed, tmp_path, monkeypatch):
    file = "toolkit/bin/x64/nvrtc64_130_0.dll" if sys.platform == "win32" else "toolkit/lib64/libnvrtc.so.13.0.88"
    monkeypatch.setenv("CUDA_PATH", str(wheels(tmp_path, file) / "toolkit"))
    assert str(tmp_path / file) in nvrtc._candidates()


def test_its_built_in_headers_are_loaded_before_it(installed, fresh, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    loaded = []
    monkeypatch.setattr(nvrtc.ctypes, "CDLL", lambda name: loaded.append(name) or name)
    nvrtc._nvrtc()
    windows = ["nvrtc-builtins64_130.dll", "nvrtc64_130_0.dll"]
    assert names(loaded) == (windows if sys.platform == "win32" else ["libnvrtc-builtins.so.13.0", "libnvrtc.so.13"])
    assert len({Path(name).parent for name in loaded}) == 1


def test_headers_that_cannot_be_loaded_are_left_to_nvrtc(installed, fresh, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "13.0")

    def load(name):
        if "builtins" in name:
            raise OSError("damaged")
        return name

    monkeypatch.setattr(nvrtc.ctypes, "CDLL", load)
    assert nvrtc._major(Path(str(nvrtc._nvrtc()))) == 13


def test_a_missing_nvrtc_is_named_with_what_to_do(fresh, monkeypatch):
    monkeypatch.setattr(nvrtc, "_candidates", lambda: ["libno_such_nvrtc.so"])
    with pytest.raises(RuntimeError, match=r"NVRTC was not found.*pip install nvidia-cuda-nvrtc"):
        nvrtc.nvrtc_version()


@needs_nvrtc
def test_supported_architectures_are_compute_capabilities():
    assert {80, 90, 120} <= set(nvrtc.supported_architectures())
