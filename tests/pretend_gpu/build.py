"""Compile library.cpp against the installed PyTorch, or say why that cannot be done."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import torch
from cuda_emulation import host_compiler

__all__ = ["build_library", "why_no_pretend_gpu"]

_SOURCE = Path(__file__).with_name("library.cpp")
_TORCH = Path(torch.__file__).parent
_OLDEST = (2, 13)  # PyTorch whose interfaces library.cpp implements; older ones were not tried


@cache
def why_no_pretend_gpu() -> str | None:
    """Return why there is no pretend device here, in one line, or None if there is one."""
    if not sys.platform.startswith("linux"):
        return f"the pretend GPU needs Linux, where a library loaded first can replace functions; this is {sys.platform}"
    if torch.version.cuda or torch.version.hip:
        return "the pretend GPU needs a PyTorch without GPU support: a build with it registers a device of its own"
    if tuple(int(part) for part in torch.__version__.split(".")[:2]) < _OLDEST:
        return f"the pretend GPU needs PyTorch {'.'.join(map(str, _OLDEST))} or newer, this is {torch.__version__}"
    if host_compiler() is None:
        return "the pretend GPU needs a C++ compiler"
    if not (_TORCH / "include" / "c10").is_dir():
        return "the pretend GPU needs the C++ headers of PyTorch, which this installation lacks"
    return None


@cache
def build_library() -> Path:
    """Compile the library, in about two seconds, once per process, and return its file.

    Raises:
        RuntimeError: it does not compile; the message has the compiler's.
    """
    library = Path(_folder().name) / "pretend_gpu.so"
    command = [host_compiler() or "c++", "-std=c++20", "-O1", "-shared", "-fPIC", str(_SOURCE), "-o", str(library)]
    command += [flag for folder in ("include", "include/torch/csrc/api/include") for flag in ("-isystem", str(_TORCH / folder))]
    command += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}"]
    command += [f"-L{_TORCH / 'lib'}", f"-Wl,-rpath,{_TORCH / 'lib'}", "-lc10", "-ltorch_cpu"]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{built.stderr}")
    return library


@cache
def _folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="pretend_gpu_")  # removed when the process ends
