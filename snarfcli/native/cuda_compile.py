"""Compile the CUDA kernels (csrc/cuda) with NVRTC on first use and keep the results on disk.

NVRTC comes with PyTorch's CUDA builds and needs neither nvcc nor a driver. It is called through ctypes and not through the
package cuda.bindings: that would be one more dependency, tied to a CUDA version, while this works with the NVRTC of PyTorch.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import sys
import tempfile
from ctypes import byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from pathlib import Path

import torch

__all__ = ["architecture_for", "cache_folder", "compile_kernels", "cuda_sources", "load_kernels", "nvrtc_version"]

# Full float32: no -use_fast_math. Functions without a marker, such as constexpr ones, are for the device.
_OPTIONS = ("--std=c++17", "--device-as-default-execution-space")
_NUMBERS = {torch.float32: "float", torch.float64: "double"}
_CHECKSUM_BYTES = 32


def load_kernels(source: str, dtype: torch.dtype, architecture: str) -> bytes:
    """Return the machine code of the kernels in `source`, from the cache on disk or freshly compiled.

    Args:
        source: file in csrc/cuda without its ending.
        dtype: float32 or float64, the type of all numbers.
        architecture: as `architecture_for` gives it.

    Raises:
        RuntimeError: NVRTC is missing or cannot compile the source; the message contains its log.
    """
    path = cache_folder() / f"{source}-{_NUMBERS[dtype]}-{architecture}-{_key(source, dtype, architecture)}.bin"
    code = _read(path)
    if code is None:
        code = compile_kernels(source, dtype, architecture)
        _write(path, code)
    return code


def compile_kernels(source: str, dtype: torch.dtype, architecture: str) -> bytes:
    """Compile as `load_kernels` does, without the cache: to a CUBIN for sm_XY, to PTX for compute_XY."""
    nvrtc = _nvrtc()
    options = [f"--gpu-architecture={architecture}", f"-DSNARF_NUMBER={_NUMBERS[dtype]}", *_OPTIONS]
    encoded = [option.encode() for option in options]
    encoded += [b"-I" + os.fsencode(folder) for folder in (cuda_sources() / "include", cuda_sources() / "cuda")]
    path = cuda_sources() / "cuda" / f"{source}.cu"
    program = c_void_p()
    _check(nvrtc.nvrtcCreateProgram(byref(program), path.read_bytes(), path.name.encode(), 0, None, None))
    try:
        if nvrtc.nvrtcCompileProgram(program, len(encoded), (c_char_p * len(encoded))(*encoded)):
            log = _text(program, "nvrtcGetProgramLog").rstrip(b"\0").decode(errors="replace").strip()
            raise RuntimeError(f"NVRTC {nvrtc_version()} cannot compile {path} for {architecture}:\n{log}")
        return _text(program, "nvrtcGetCUBIN" if architecture.startswith("sm_") else "nvrtcGetPTX")
    finally:
        nvrtc.nvrtcDestroyProgram(byref(program))


def architecture_for(capability: tuple[int, int]) -> str:
    """Return the architecture to compile for on a device of this compute capability.

    This is its machine code, sm_XY. If NVRTC is too old to know the device, it is the newest portable code, compute_XY, which
    the driver compiles to machine code.

    Raises:
        RuntimeError: NVRTC is missing or no longer supports the device.
    """
    wanted = 10 * capability[0] + capability[1]
    nvrtc, count = _nvrtc(), c_int()
    _check(nvrtc.nvrtcGetNumSupportedArchs(byref(count)))
    known = (c_int * count.value)()
    _check(nvrtc.nvrtcGetSupportedArchs(known))
    if wanted in known:
        return f"sm_{wanted}"
    older = [architecture for architecture in known if architecture < wanted]
    if not older:
        raise RuntimeError(f"NVRTC {nvrtc_version()} no longer supports compute capability {capability[0]}.{capability[1]}")
    return f"compute_{max(older)}"


def nvrtc_version() -> str:
    """Return the version of NVRTC, such as 13.0.

    Raises:
        RuntimeError: NVRTC cannot be found.
    """
    major, minor = c_int(), c_int()
    _check(_nvrtc().nvrtcVersion(byref(major), byref(minor)))
    return f"{major.value}.{minor.value}"


def cuda_sources() -> Path:
    """Return the folder with the sources `cuda` and `include`: in the package, or beside it in a checkout."""
    package = Path(__file__).parents[1]
    return next((folder for folder in (package / "csrc", package.parent / "csrc") if folder.is_dir()), package / "csrc")


def cache_folder() -> Path:
    """Return the folder of compiled kernels: snarf/cuda in the user's cache folder."""
    home = Path.home()
    fallback = home / "AppData" / "Local" if sys.platform == "win32" else home / ".cache"
    folder = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME")
    return (Path(folder) if folder else fallback) / "snarf" / "cuda"


# ---------------------------------------------------------------- cache
def _key(source: str, dtype: torch.dtype, architecture: str) -> str:
    """Return a hash of all that the machine code depends on."""
    digest = hashlib.sha256(repr((source, str(dtype), architecture, _OPTIONS, nvrtc_version())).encode())
    for folder in ("cuda", "include"):
        for path in sorted((cuda_sources() / folder).rglob("*")):
            if path.is_file():
                content = path.read_bytes()
                digest.update(repr((path.relative_to(cuda_sources()).as_posix(), len(content))).encode() + content)
    return digest.hexdigest()[:32]


def _read(path: Path) -> bytes | None:
    """Return a cached file's content, or None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    checksum, code = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
    return code if code and hashlib.sha256(code).digest() == checksum else None


def _write(path: Path, code: bytes) -> None:
    """Write a file into the cache atomically. If the folder cannot be written to, the next start compiles again."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise


# ---------------------------------------------------------------- NVRTC
@cache
def _nvrtc() -> ctypes.CDLL:
    """Load NVRTC; among several, the one of PyTorch's CUDA version, which fits the driver."""
    tried = []
    for name in _candidates():
        try:
            return ctypes.CDLL(name)
        except OSError as error:
            tried.append(str(error))
    wanted = f"cu{torch.version.cuda.split('.')[0]}" if torch.version.cuda else "any version"
    raise RuntimeError(
        f"NVRTC was not found; PyTorch's CUDA builds contain it, otherwise run "
        f'"pip install nvidia-cuda-nvrtc" ({wanted}); tried: {"; ".join(tried)}'
    )


def _candidates() -> list[str]:
    """Return file names of NVRTC to try, the most suitable first."""
    major = torch.version.cuda.split(".")[0] if torch.version.cuda else ""
    pattern = "nvrtc64_*_0.dll" if sys.platform == "win32" else "libnvrtc.so.*"
    wheels = importlib.util.find_spec("nvidia")
    folders = [Path(place) for place in (wheels.submodule_search_locations or [])] if wheels else []
    found = [path for folder in folders for path in sorted(folder.glob(f"*/*/{pattern}"), reverse=True)]
    found += sorted((Path(torch.__file__).parent / "lib").glob(pattern))
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(variable):
            found += sorted(Path(os.environ[variable]).glob(f"*/{pattern}"), reverse=True)
    suitable = [str(path) for path in found if f".so.{major}" in path.name or f"nvrtc64_{major}" in path.name]
    loader = [f"nvrtc64_{major}0_0.dll"] if sys.platform == "win32" else [f"libnvrtc.so.{major}".rstrip("."), "libnvrtc.so"]
    return [*suitable, *loader, *(str(path) for path in found if str(path) not in suitable)]


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
