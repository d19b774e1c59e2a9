"""Compile the CUDA kernels (csrc/cuda) with NVRTC on first use and keep the results on disk."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import torch

from snarfcli.native.kernel_cache import cache_folder, read_cached, write_cached
from snarfcli.native.nvrtc import compile_source, nvrtc_version, supported_architectures

__all__ = ["architecture_for", "compile_kernels", "cuda_sources", "load_kernels"]

# Full float32: no -use_fast_math. Functions without a marker, such as constexpr ones, are for the device.
_OPTIONS = ("--std=c++17", "--device-as-default-execution-space")
_NUMBERS = {torch.float32: "float", torch.float64: "double"}


def load_kernels(source: str | Path, dtype: torch.dtype, architecture: str) -> bytes:
    """Return the machine code of the kernels in `source`, from the cache on disk or freshly compiled.

    Args:
        source: file in csrc/cuda without its ending, or the path of a file elsewhere.
        dtype: float32 or float64, the type of all numbers.
        architecture: as `architecture_for` gives it.

    Raises:
        RuntimeError: NVRTC is missing or cannot compile the source; the message contains its log.
    """
    folder = cache_folder()
    if folder is None:
        return compile_kernels(source, dtype, architecture)
    path = folder / f"{_file_of(source).stem}-{_NUMBERS[dtype]}-{architecture}-{_key(source, dtype, architecture)}.bin"
    code = read_cached(path)
    if code is None:
        code = compile_kernels(source, dtype, architecture)
        write_cached(path, code)
    return code


def compile_kernels(source: str | Path, dtype: torch.dtype, architecture: str) -> bytes:
    """Compile as `load_kernels` does, without the cache: to a CUBIN for sm_XY, to PTX for compute_XY."""
    options = [option.encode() for option in (f"-DSNARF_NUMBER={_NUMBERS[dtype]}", *_OPTIONS)]
    options += [b"-I" + os.fsencode(folder) for folder in (cuda_sources() / "include", cuda_sources() / "cuda")]
    return compile_source(_file_of(source), architecture, options)


def architecture_for(capability: tuple[int, int]) -> str:
    """Return the architecture to compile for on a device of this compute capability.

    This is its machine code, sm_XY. If NVRTC is too old to know the device, it is the newest portable code, compute_XY, which
    the driver compiles to machine code.

    Raises:
        RuntimeError: NVRTC is missing or no longer supports the device.
    """
    wanted, known = 10 * capability[0] + capability[1], supported_architectures()
    if wanted in known:
        return f"sm_{wanted}"
    older = [architecture for architecture in known if architecture < wanted]
    if not older:
        raise RuntimeError(f"NVRTC {nvrtc_version()} no longer supports compute capability {capability[0]}.{capability[1]}")
    return f"compute_{max(older)}"


def cuda_sources() -> Path:
    """Return the folder with the sources `cuda` and `include`: in the package, or beside it in a checkout."""
    package = Path(__file__).parents[1]
    return next((folder for folder in (package / "csrc", package.parent / "csrc") if folder.is_dir()), package / "csrc")


def _file_of(source: str | Path) -> Path:
    return source if isinstance(source, Path) else cuda_sources() / "cuda" / f"{source}.cu"


def _key(source: str | Path, dtype: torch.dtype, architecture: str) -> str:
    """Return a hash of all that the machine code depends on."""
    digest = hashlib.sha256(repr((_file_of(source).stem, str(dtype), architecture, _OPTIONS, nvrtc_version())).encode())
    digest.update(_file_of(source).read_bytes())
    for folder in ("cuda", "include"):
        for path in sorted((cuda_sources() / folder).rglob("*")):
            if path.is_file():
                content = path.read_bytes()
                digest.update(repr((path.relative_to(cuda_sources()).as_posix(), len(content))).encode() + content)
    return digest.hexdigest()[:32]
