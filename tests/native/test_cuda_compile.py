"""The CUDA kernels compiled by NVRTC, for several architectures and without a GPU, and the cache on disk."""

from __future__ import annotations

import re
import shutil

import pytest
import torch

from snarfcli.native import cuda, cuda_compile
from snarfcli.native.kernel_cache import read_cached

SOURCES = (
    "broyden",
    "candidates",
    "complete",
    "draws",
    "encoding",
    "gather",
    "implicit",
    "interpolate",
    "network",
    "optimizer",
    "parts",
    "segments",
    "variation",
)
FLOAT32_ONLY = ("network",)  # whatever the type of numbers of the others


def nvrtc_problem() -> str | None:
    try:
        cuda_compile.nvrtc_version()
    except RuntimeError as error:
        return str(error).split(";")[0]
    return None


needs_nvrtc = pytest.mark.skipif(nvrtc_problem() is not None, reason=str(nvrtc_problem()))


@needs_nvrtc
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_120"])
def test_nvrtc_compiles_every_kernel(architecture, dtype):
    for source in SOURCES if dtype == torch.float32 else [name for name in SOURCES if name not in FLOAT32_ONLY]:
        code = cuda_compile.compile_kernels(source, dtype, architecture)
        assert code[:4] == b"\x7fELF"
        text = (cuda_compile.cuda_sources() / "cuda" / f"{source}.cu").read_text()
        kernels = re.findall(r'extern "C" __global__ void .*\b(\w+)\(const', text)
        assert kernels
        assert all(f".text.{kernel}".encode() in code for kernel in kernels)


@needs_nvrtc
def test_structures_in_memory_have_no_padding_that_is_copied():
    """It would be copied byte by byte; nothing else here is, and initcheck would report reads of what nobody wrote."""
    code = cuda_compile.compile_kernels("candidates", torch.float32, "compute_80")
    assert b".entry search_cells" in code
    assert not re.findall(rb"\.v\d\.[bsu]8\b.*", code)


@needs_nvrtc
def test_the_network_compiles_without_tensor_cores():
    code = cuda_compile.compile_kernels("network", torch.float32, "sm_75")
    assert b".text.evaluate_float32_64" in code
    assert b"tf32" not in code


def test_every_source_is_compiled_and_opens_with_its_design():
    files = sorted((cuda_compile.cuda_sources() / "cuda").glob("*.cu"))
    assert [file.stem for file in files] == sorted(SOURCES)
    assert all("DESIGN" in file.read_text()[:1000] for file in files)


@needs_nvrtc
def test_architecture_is_the_device_s_own_or_the_newest_before_it():
    assert cuda_compile.architecture_for((9, 0)) == "sm_90"
    future = cuda_compile.architecture_for((99, 0))
    assert re.fullmatch(r"compute_\d+", future)
    assert cuda_compile.compile_kernels("gather", torch.float32, future).startswith(b"//")  # PTX, for the driver to finish
    with pytest.raises(RuntimeError, match=r"no longer supports compute capability 1.0"):
        cuda_compile.architecture_for((1, 0))


@needs_nvrtc
def test_compiled_kernels_are_kept_and_damaged_ones_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setattr(cuda_compile, "cache_folder", lambda: tmp_path / "snarf" / "cuda")
    wanted = ("gather", torch.float32, "sm_80")
    code = cuda_compile.load_kernels(*wanted)
    (file,) = (tmp_path / "snarf" / "cuda").iterdir()  # and no temporary one
    compiled = []
    original = cuda_compile.compile_kernels
    monkeypatch.setattr(cuda_compile, "compile_kernels", lambda *args: compiled.append(args) or original(*args))
    assert cuda_compile.load_kernels(*wanted) == code
    assert not compiled
    for damage in (b"", file.read_bytes()[:-1], file.read_bytes()[:100] + b"?" + file.read_bytes()[101:]):
        file.write_bytes(damage)
        assert len(cuda_compile.load_kernels(*wanted)) == len(code)
        assert read_cached(file) is not None  # replaced
    assert len(compiled) == 3
    cuda_compile.load_kernels("gather", torch.float64, "sm_80")
    cuda_compile.load_kernels("gather", torch.float32, "sm_90")
    assert len(compiled) == 5


@needs_nvrtc
def test_changed_sources_are_compiled_anew_and_errors_shown(tmp_path, monkeypatch):
    sources = tmp_path / "with blanks" / "csrc"
    shutil.copytree(cuda_compile.cuda_sources(), sources)
    before = cuda_compile._key("gather", torch.float32, "sm_80")
    monkeypatch.setattr(cuda_compile, "cuda_sources", lambda: sources)
    assert cuda_compile._key("gather", torch.float32, "sm_80") == before
    header = sources / "include" / "snarf" / "grid.h"
    header.write_text(header.read_text() + "// changed\n")
    assert cuda_compile._key("gather", torch.float32, "sm_80") != before
    cuda_compile.compile_kernels("gather", torch.float32, "sm_80")
    header.write_text(header.read_text() + "nonsense;\n")
    with pytest.raises(RuntimeError, match=r"cannot compile .*gather.cu for sm_80:\n(.*\n)*.*nonsense"):
        cuda_compile.compile_kernels("gather", torch.float32, "sm_80")


@needs_nvrtc
def test_a_cache_that_cannot_be_written_to_is_done_without(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(cuda_compile, "cache_folder", lambda: tmp_path / "file" / "cuda")
    assert cuda_compile.load_kernels("gather", torch.float32, "sm_80")


@needs_nvrtc
def test_without_a_cache_kernels_are_compiled_all_the_same(monkeypatch):
    monkeypatch.setattr(cuda_compile, "cache_folder", lambda: None)
    assert cuda_compile.load_kernels("gather", torch.float32, "sm_80").startswith(b"\x7fELF")


def test_status_is_one_line():
    status = cuda.cuda_status()
    assert "\n" not in status
    assert status.startswith("available" if torch.cuda.is_available() else "not available: ")
