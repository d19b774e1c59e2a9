"""NVRTC, the CUDA compiler as a library: find it, load it and compile a source with it.

NVRTC comes with PyTorch's CUDA builds and needs neither nvcc nor a driver. It is called through ctypes and not through the
package cuda.bindings: that would be one more dependency, tied to a CUDA version, while this works with the NVRTC of PyTorch.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from ctypes import byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from pathlib import Path

import torch

__all__ = ["compile_source", "nvrtc_version", "supported_architectures"]


def compile_source(path: Path, architecture: str, options: Sequence[bytes]) -> bytes:
    """Compile a CUDA source to a CUBIN for the architecture sm_XY, or to PTX for compute_XY.

    Raises:
        RuntimeError: NVRTC is missing or cannot compile the source; the message contains its log.
    """
    # In a thread of its own, since NVRTC 11.8 to 12.4 leave the calling thread with the locale C, in which Python reads and
    # writes ASCII only.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(_compile, path, architecture, options).result()


def _compile(path: Path, architecture: str, options: Sequence[bytes]) -> bytes:
    nvrtc, program = _nvrtc(), c_void_p()
    given = [f"--gpu-architecture={architecture}".encode(), *options]
    _check(nvrtc.nvrtcCreateProgram(byref(program), path.read_bytes(), path.name.encode(), 0, None, None))
    try:
        if nvrtc.nvrtcCompileProgram(program, len(given), (c_char_p * len(given))(*given)):
            log = _text(program, "nvrtcGetProgramLog").rstrip(b"\0").decode(errors="replace").strip()
            raise RuntimeError(f"NVRTC {nvrtc_version()} cannot compile {path} for {architecture}:\n{log}")
        return _text(program, "nvrtcGetCUBIN" if architecture.startswith("sm_") else "nvrtcGetPTX")
    finally:
        nvrtc.nvrtcDestroyProgram(byref(program))


def supported_architectures() -> list[int]:
    """Return the compute capabilities that NVRTC compiles for, such as 90 for 9.0.

    Raises:
        RuntimeError: NVRTC cannot be found.
    """
    count = c_int()
    _check(_nvrtc().nvrtcGetNumSupportedArchs(byref(count)))
    known = (c_int * count.value)()
    _check(_nvrtc().nvrtcGetSupportedArchs(known))
    return list(known)


def nvrtc_version() -> str:
    """Return the version of NVRTC, such as 13.0.

    Raises:
        RuntimeError: NVRTC cannot be found.
    """
    major, minor = c_int(), c_int()
    _check(_nvrtc().nvrtcVersion(byref(major), byref(minor)))
    return f"{major.value}.{minor.value}"


# ---------------------------------------------------------------- finding it
@cache
def _nvrtc() -> ctypes.CDLL:
    """Load NVRTC; among several, the one of PyTorch's CUDA version, which fits the driver."""
    tried = []
    for name in _candidates():
        try:
            return _load(name)
        except OSError as error:
            tried.append(str(error))
    wanted = f"cu{torch.version.cuda.split('.')[0]}" if torch.version.cuda else "any version"
    raise RuntimeError(
        f"NVRTC was not found; PyTorch's CUDA builds contain it, otherwise run "
        f'"pip install nvidia-cuda-nvrtc" ({wanted}); tried: {"; ".join(tried)}'
    )


def _load(name: str) -> ctypes.CDLL:
    """Load NVRTC by its path, or by a name that the loader looks for."""
    # NVRTC loads its built-in headers by name. The loader finds a library of that name that is loaded already, but not always
    # one in the same folder: NVRTC 13.0 of the wheels has no RPATH, and Windows does not look there.
    for headers in _builtins_beside(Path(name)):
        with contextlib.suppress(OSError):
            ctypes.CDLL(str(headers))
    return ctypes.CDLL(name)


def _builtins_beside(path: Path) -> list[Path]:
    """Return the libraries with the built-in headers of NVRTC's major version that lie in its folder."""
    if len(path.parts) == 1:
        return []
    pattern = "nvrtc-builtins64_{}*.dll" if sys.platform == "win32" else "libnvrtc-builtins.so.{}.*"
    found = path.parent.glob(pattern.format(_major(path)))
    return sorted(file for file in found if ".alt." not in file.name)


def _candidates() -> list[str]:
    """Return file names of NVRTC to try, the most suitable first."""
    found = sorted(_installed(), key=_major, reverse=True)
    major = torch.version.cuda.split(".")[0] if torch.version.cuda else ""
    suitable = [str(path) for path in found if major in ("", str(_major(path)))]
    loader = [f"nvrtc64_{major}0_0.dll"] if sys.platform == "win32" else [f"libnvrtc.so.{major}".rstrip("."), "libnvrtc.so"]
    return [*suitable, *loader, *(str(path) for path in found if str(path) not in suitable)]


def _installed() -> list[Path]:
    """Return the files of NVRTC in NVIDIA's wheels, in PyTorch's and in a CUDA toolkit."""
    pattern = "nvrtc64_*_0.dll" if sys.platform == "win32" else "libnvrtc.so.*"
    wheels = importlib.util.find_spec("nvidia")
    folders = [Path(place) for place in (wheels.submodule_search_locations or [])] if wheels else []
    # nvidia/cu13/lib, nvidia/cuda_nvrtc/lib; on Windows nvidia/cu13/bin/x86_64, nvidia/cuda_nvrtc/bin
    found = [path for folder in folders for depth in ("*/*", "*/bin/*") for path in sorted(folder.glob(f"{depth}/{pattern}"))]
    found += sorted((Path(torch.__file__).parent / "lib").glob(pattern))
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        toolkit = os.environ.get(variable)
        if toolkit:  # lib64, bin; on Windows from CUDA 13 on bin/x64
            found += [path for depth in ("*", "bin/*") for path in sorted(Path(toolkit).glob(f"{depth}/{pattern}"))]
    return found


def _major(path: Path) -> int:
    """Return the major version in the name of NVRTC's file, such as 13 for libnvrtc.so.13 and nvrtc64_130_0.dll; else 0."""
    match = re.search(r"nvrtc64_(\d\d)|\.so\.(\d+)", path.name)
    return int(match[1] or match[2]) if match else 0


# ---------------------------------------------------------------- calling it
def _check(code: int) -> None:
    if code:
        function = _nvrtc().nvrtcGetErrorString
        function.restype = c_char_p
        raise RuntimeError(f"NVRTC: {function(code).decode()}")


def _text(program: c_void_p, function: str) -> bytes:
    """Return a text or code that NVRTC holds for a program, by the name of the function that copies it."""
    size = c_size_t()
    _check(getattr(_nvrtc(), f"{function}Size")(program, byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check(getattr(_nvrtc(), function)(program, buffer))
    return buffer.raw[: size.value]
