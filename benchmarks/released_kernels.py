"""Run the kernels of released_search.cu: on a GPU, or on a CPU where they are compiled as C++."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from ctypes import Structure, c_double, c_int, c_longlong, c_void_p
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from released_search import CONVERGED_M, DIVERGED_M, DUPLICATE_M, STEPS
from torch import Tensor

from snarfcli.deformer import CanonicalGrid
from snarfcli.native import cuda_compile, cuda_driver

__all__ = ["SOURCE", "PaddedRoots", "released_search_native"]

SOURCE = Path(__file__).resolve().parent / "released_search.cu"
_THREADS = 128


class _Released(Structure):
    """`Released` of released_search.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("points", "transforms", "starts", "lower", "upper")),
        *((name, c_void_p) for name in ("canonical", "jacobian_inverse", "valid")),
        *((name, c_longlong) for name in ("count", "pairs")),
        *((name, c_double) for name in ("converged", "diverged", "same")),
        ("nodes", c_int * 3),
        *((name, c_int) for name in ("start_count", "max_steps")),
    ]


class PaddedRoots(NamedTuple):
    """Roots of B N queries from I starts; what is not valid is undefined."""

    canonical: Tensor
    """[B, N, I, 3], metres."""
    jacobian_inverse: Tensor
    """[B, N, I, 3, 3]."""
    valid: Tensor
    """[B, N, I], bool."""


def released_search_native(
    points: Tensor, transforms: Tensor, starts: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int], steps: int = STEPS
) -> PaddedRoots:
    """Run the released search and its filter of duplicates; never waits for a GPU, and can be captured in a CUDA graph.

    Args:
        points: [B, N, 3], posed space, metres.
        transforms: [B, D * H * W, 12], blended at the nodes.
        starts: [B, I, 12], posed to canonical, one for each start bone.
        grid: box of the nodes.
        shape: D, H, W.
        steps: maximum number of Broyden steps.
    """
    launcher = _launcher_for(points)
    batch, count, start_count = *points.shape[:2], starts.shape[1]
    given = [value.contiguous() for value in (points, transforms, starts, grid.lower, grid.upper)]
    canonical = points.new_empty(batch, count, start_count, 3)
    jacobian_inverse = points.new_empty(batch, count, start_count, 3, 3)
    valid = torch.empty(batch, count, start_count, dtype=torch.bool, device=points.device)
    arguments = _Released(*(tensor.data_ptr() for tensor in (*given, canonical, jacobian_inverse, valid)))
    arguments.count, arguments.pairs, arguments.start_count = count, valid.numel(), start_count
    arguments.converged, arguments.diverged, arguments.same = CONVERGED_M, DIVERGED_M, DUPLICATE_M
    arguments.nodes[:], arguments.max_steps = shape[::-1], steps
    threads = launcher.threads(_THREADS)
    for kernel, items in (("search_from_bones", valid.numel()), ("filter_duplicates", batch * count)):
        if items:
            launcher.launch(SOURCE, kernel, (-(-items // threads), 1), threads, arguments)
    return PaddedRoots(canonical, jacobian_inverse, valid)


def _launcher_for(tensor: Tensor) -> cuda_driver.Gpu | _Emulated:
    """Return what runs the kernels on the device of a tensor, for numbers of its dtype."""
    return cuda_driver.gpu(tensor) if tensor.is_cuda else _Emulated(tensor.dtype)


class _Emulated:
    """A launcher that runs the kernels on the CPU, one thread after the other, with blocks of the usual size."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.library = _emulation(dtype)

    def threads(self, most: int) -> int:
        return most

    def launch(
        self, source: str | Path, kernel: str, blocks: tuple[int, int], threads: int, arguments: ctypes.Structure
    ) -> None:
        assert source == SOURCE
        assert self.library.emulate(kernel.encode(), ctypes.byref(arguments), *blocks, threads)


@cache
def _emulation(dtype: torch.dtype) -> ctypes.CDLL:
    """Compile the kernels as C++ for one type of numbers, and load them.

    Raises:
        RuntimeError: there is no C++ compiler, or it fails.
    """
    named = (os.environ.get("CXX"), "g++", "clang++", "c++")
    compiler = next((path for name in named if name and (path := shutil.which(name))), None)
    if compiler is None:
        raise RuntimeError("released_search.cu on a CPU: wanted a C++ compiler, found none; set CXX")
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "emulation.cpp", Path(folder) / "kernels.so"
        source.write_text(_EMULATION)
        command = [compiler, "-std=c++17", "-O2", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-Wno-psabi"]
        command += [f"-DSNARF_NUMBER={'float' if dtype == torch.float32 else 'double'}"]
        command += [f"-I{cuda_compile.cuda_sources() / 'include'}", f"-I{SOURCE.parent}", "-o", str(library), str(source)]
        built = subprocess.run(command, capture_output=True, text=True)
        if built.returncode:
            raise RuntimeError(f"{' '.join(command)}\n{built.stderr}")
        loaded = ctypes.CDLL(str(library), mode=ctypes.RTLD_LOCAL)
    assert loaded.released_bytes() == ctypes.sizeof(_Released)
    loaded.emulate.restype = ctypes.c_bool
    return loaded


# Enough of CUDA's language for kernels without shared memory and barriers.
_EMULATION = """
#include <string.h>
#define __global__
#define __launch_bounds__(threads)
#define __forceinline__ inline
struct Index { unsigned x; };
static Index threadIdx, blockIdx, blockDim;
#include "released_search.cu"
using namespace snarf::device;
extern "C" int released_bytes() { return sizeof(Released); }
extern "C" bool emulate(const char* name, const void* arguments, unsigned blocks, unsigned, unsigned threads) {
  const bool searches = !strcmp(name, "search_from_bones");
  if (!searches && strcmp(name, "filter_duplicates")) return false;
  blockDim.x = threads;
  for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
    for (threadIdx.x = 0; threadIdx.x < threads; ++threadIdx.x)
      (searches ? search_from_bones : filter_duplicates)(*(const Released*)arguments);
  return true;
}
"""
